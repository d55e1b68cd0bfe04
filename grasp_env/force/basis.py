"""The paper's offline part: the optimal forces for the 12 unit wrenches and for zero wrench."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from grasp_env import core
from grasp_env.errors import InfeasibleStartError
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.record import STARTED
from grasp_env.force.solution import COMBINATION
from grasp_env.grasp.checks import rank_error
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs.arguments import Array, ContactForces, Wrench, as_wrench, flag, instance


@dataclass(frozen=True, eq=False)
class OfflineBasis:
    """The 12-basis of a grasp: argmin Phi for +e_1..+e_6, -e_1..-e_6 [N, N m] and for w = 0.

    It is that of the paper's Sec. III, and exists for every grasp with force closure. Its forces
    are balanced for that grasp only; if contacts move, use `moved_to`.

    Attributes:
        cone_divisor: (N, 3) `grasp.models.cone_divisor`; the grasp itself would be kept alive.
        objective: the Phi of the optima.
        cone_forces: (13, 3N) the optima in cone coordinates: 12 unit wrenches, then zero wrench.

    Example:
        >>> from grasp_env.grasp import presets
        >>> basis = OfflineBasis.of(presets.paper_cuboid())
        >>> basis.forces.shape, basis.combine([1, 0.5, -0.6, -0.1, 0.2, 0]).shape
        ((12, 4, 3), (4, 3))
    """

    cone_divisor: Array
    objective: Objective
    cone_forces: Array = field(repr=False)

    @classmethod
    def compute(
        cls, grasp: Grasp, objective: Objective | None = None, warm: OfflineBasis | None = None
    ) -> OfflineBasis:
        """Solve the 13 problems by Newton to a gap of 1e-10; `objective` None: the defaults.

        A `warm` basis of a nearby grasp saves iterations.

        Raises:
            InfeasibleStartError: the grasp has no force closure, so some unit wrenches have no
                force; or Newton does not converge.
        """
        objective = as_objective(objective)
        if warm is not None:
            instance(warm, OfflineBasis, "warm")
        solver = _compiled(grasp, objective)
        forces = np.empty((13, 3 * grasp.n_contacts))
        if warm is not None and len(warm.cone_divisor) == grasp.n_contacts:
            forces[:] = warm.cone_forces
            if solver.make_basis(forces, warm=True) < core.ACCEPTED_GAP:
                return cls(grasp.models.cone_divisor, objective, forces)
        gap = solver.make_basis(forces, warm=False)
        if np.isnan(gap):
            raise InfeasibleStartError(
                "the grasp has no force closure, so the offline basis does not exist; "
                "use initial='phase_one', which needs a force for this wrench only"
            )
        if not gap < core.ACCEPTED_GAP:
            raise InfeasibleStartError(
                f"the offline basis did not converge at barrier_weight={objective.barrier_weight}: raise it, or the grasp "
                "is too close to losing force closure"
            )
        return cls(grasp.models.cone_divisor, objective, forces)

    @classmethod
    def of(cls, grasp: Grasp, objective: Objective | None = None) -> OfflineBasis:
        """Return the basis of a grasp for an `objective`; it is cached as long as `grasp` lives."""
        return cls._cached(grasp, as_objective(objective), None)

    @staticmethod
    def known(grasp: Grasp) -> list[OfflineBasis]:
        """Return the cached bases of `grasp`, one for each Phi."""
        return list(_CACHE.get(as_grasp(grasp), {}).values())

    def moved_to(self, grasp: Grasp) -> OfflineBasis:
        """Return the basis of a nearby grasp, whose optima start from the tangent correction.

        A cached basis of `grasp` is returned unchanged.
        """
        return self._cached(grasp, self.objective, self)

    @classmethod
    def _cached(cls, grasp: Grasp, objective: Objective, warm: OfflineBasis | None) -> OfflineBasis:
        known = _CACHE.setdefault(as_grasp(grasp), {})
        if objective not in known:
            known[objective] = cls.compute(grasp, objective, warm)
        return known[objective]

    @property
    def forces(self) -> Array:
        """(12, N, 3) the optimal forces of +e_1..+e_6, -e_1..-e_6 [N]."""
        return self.cone_forces[:12].reshape(12, -1, 3) / self.cone_divisor

    @property
    def rest(self) -> ContactForces:
        """(N, 3) argmin Phi at w = 0: the optimal internal force [N]."""
        return self.cone_forces[12].reshape(-1, 3) / self.cone_divisor

    def combine(self, wrench: Wrench, printed: bool = False) -> ContactForces:
        """Return the non-negative combination sum E_k f_k (N, 3) [N] with w = sum E_k (+-e_k).

        These are Eqs. 33 and 34; see `LinearCombination` for `printed`. The result balances
        `wrench` by linearity and lies strictly inside the cones by convexity.
        """
        x = np.empty(self.cone_forces.shape[1])
        core.combine(self.cone_forces, as_wrench(wrench), flag(printed, "printed"), x)
        return x.reshape(-1, 3) / self.cone_divisor


def core_contacts(grasp: Grasp, objective: Objective) -> core.Contacts:
    """Return the hard contacts of a grasp with the weights of Phi, for the core's solvers.

    Raises:
        RankDeficientGraspError: rank(G) < 6.
    """
    omega = as_objective(objective).force_weight
    lam = objective.barrier_weight
    contacts = as_grasp(grasp).contacts
    uniform = type(omega) is float and type(lam) is float
    weights = (omega, lam) if uniform else (objective.weights(contacts.count),)
    try:
        return contacts.weighed(*weights)
    except ValueError:
        hint = "; torsions of soft contacts do not count here" if grasp.rank == 6 else ""
        raise rank_error(min(grasp.rank, 5), contacts.count, hint) from None


def starter(
    grasp: Grasp, objective: Objective, model: core.Model | None = None
) -> core.ForceOptimizer:
    """Return a compiled optimizer with the grasp's 12-basis, the fallback of repairs and models."""
    basis = OfflineBasis.of(grasp, objective)
    optimizer = _compiled(grasp, objective, start=COMBINATION, model=model)
    optimizer.set_basis(basis.cone_forces)
    return optimizer


def start_of(
    optimizer: core.ForceOptimizer, start: int, wrench: Wrench, force: ContactForces | None
) -> ContactForces | None:
    """Return the start (N, 3) [N] of a `starter` by its index in `STARTS`, or None."""
    solution: Any = optimizer.start(wrench, None, core.Request(start=start, force=force))
    return solution.initial_force.copy() if solution.code == STARTED else None


def _compiled(grasp: Grasp, objective: Objective, **options: Any) -> core.ForceOptimizer:
    problem = core.Problem(core_contacts(grasp, objective), objective.weights(grasp.n_contacts))
    return core.ForceOptimizer(problem, core.Options(**options))


# weak keys: a basis is dropped with its grasp
_CACHE: WeakKeyDictionary[Grasp, dict[Objective, OfflineBasis]] = WeakKeyDictionary()
