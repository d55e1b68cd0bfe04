"""The paper's offline part: the optimal forces of the 12 unit wrenches, and of no wrench."""

from __future__ import annotations

from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.basis_kernels import ACCEPTED_GAP, BASIS_ITERATIONS, BASIS_TOLERANCE, offline_basis
from grasp_env.force.feasibility import phase_one
from grasp_env.force.lanes import options, pack
from grasp_env.force.objective import Objective
from grasp_env.force.start_kernels import combine
from grasp_env.grasp.grasp import Grasp


@dataclass(frozen=True, eq=False)
class OfflineBasis:
    """argmin Phi for +e_1..+e_6, -e_1..-e_6 (1 N or 1 N m each) and for w = 0, of one grasp (paper, Sec. III).

    Every grasp with force closure has one; it balances only for that grasp's G: when contacts move, take `moved_to`.

    Attributes:
        cone_divisor: (N, 3) of the grasp it balances. (Not the grasp itself: a basis must not keep its grasp alive.)
        objective: the Phi whose optima it holds.
        cone_forces: (13, 3N) the optima in cone coordinates, unit wrenches first, rest last.
    """

    cone_divisor: Array
    objective: Objective
    cone_forces: Array = field(repr=False)

    @classmethod
    def compute(
        cls, grasp: Grasp, objective: Objective | None = None, warm: OfflineBasis | None = None
    ) -> OfflineBasis:
        """Solves the 13 problems (compiled Newton, relative gap 1e-10).

        Args:
            grasp: the grasp.
            objective: Phi; None: the defaults.
            warm: a basis of a nearby grasp with as many contacts, to start from.

        Raises:
            InfeasibleStartError: the grasp has no force closure, so some unit wrench has no force.
        """
        objective = objective or Objective()
        cone_pseudoinverse = grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]
        if warm is not None and len(warm.cone_divisor) == grasp.n_contacts:
            cone_forces = warm.cone_forces.copy()
            interior = np.zeros(3 * grasp.n_contacts)
            if _solve(cone_forces, True, interior, grasp, cone_pseudoinverse, objective):
                return cls(grasp.models.cone_divisor, objective, cone_forces)
        answer = phase_one(grasp, np.zeros(6))
        if answer.force is None:
            raise InfeasibleStartError(
                "the grasp has no force closure, so the offline basis does not exist; "
                "use initial='phase_one', which needs a force for this wrench only"
            )
        cone_forces = np.empty((13, 3 * grasp.n_contacts))
        if not _solve(cone_forces, False, grasp.to_cone(answer.force), grasp, cone_pseudoinverse, objective):
            raise InfeasibleStartError(
                f"the offline basis did not converge at barrier_weight={objective.barrier_weight}: raise it, or the grasp "
                "is too close to losing force closure"
            )
        return cls(grasp.models.cone_divisor, objective, cone_forces)

    @classmethod
    def of(cls, grasp: Grasp, objective: Objective | None = None) -> OfflineBasis:
        """`compute`, remembered as long as `grasp` lives."""
        objective = objective or Objective()
        known = _REMEMBERED.setdefault(grasp, {})
        if objective not in known:
            known[objective] = cls.compute(grasp, objective)
        return known[objective]

    def moved_to(self, grasp: Grasp) -> OfflineBasis:
        """The basis of a nearby grasp, each optimum carried over by the tangent correction and re-optimised.

        A basis that `grasp` already has is returned as it is, so that going back to a grasp gives the same bits.
        """
        known = _REMEMBERED.setdefault(grasp, {})
        if self.objective not in known:
            known[self.objective] = self.compute(grasp, self.objective, warm=self)
        return known[self.objective]

    @property
    def forces(self) -> Array:
        """(12, N, 3) the optimal forces of +e_1..+e_6, -e_1..-e_6 [N]."""
        return self.cone_forces[:12].reshape(12, -1, 3) / self.cone_divisor

    @property
    def rest(self) -> ContactForces:
        """(N, 3) argmin Phi at w = 0: the internal squeeze [N]."""
        return self.cone_forces[12].reshape(-1, 3) / self.cone_divisor

    def combine(self, wrench: Wrench, printed: bool = False) -> ContactForces:
        """Non-negative combination sum E_k f_k with w = sum E_k (+-e_k) (Eqs. 33 and 34): (N, 3) [N].

        As printed it vanishes with the wrench, where P is singular; unless `printed`, max(0, 1 - sum E_k) times the
        rest force is added. Balanced by linearity, strictly inside the cones by convexity.
        """
        x = np.empty(self.cone_forces.shape[1])
        combine(self.cone_forces, wrench, printed, x)
        return x.reshape(-1, 3) / self.cone_divisor


# weak keys: a basis goes with its grasp
_REMEMBERED: WeakKeyDictionary[Grasp, dict[Objective, OfflineBasis]] = WeakKeyDictionary()


def _solve(
    cone_forces: Array, warm: bool, interior: Array, grasp: Grasp, pseudoinverse: Array, objective: Objective
) -> bool:
    weights = objective.weights(grasp.n_contacts)
    worst = offline_basis(
        cone_forces,
        warm,
        interior,
        pack(grasp, interior, weights),
        grasp.cone_matrix.copy(),  # kernels take writable arrays only: one compiled signature
        pseudoinverse,
        grasp.models.cone_divisor.copy(),
        weights,
        options(grasp, BASIS_TOLERANCE, BASIS_ITERATIONS),
    )
    return bool(worst < ACCEPTED_GAP)
