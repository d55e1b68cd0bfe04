"""`LearnedInitialForce`: a start that a network predicts, never worse in Phi than the paper's."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError, UnknownNameError
from grasp_env.force import ForceSolution, Objective, OfflineBasis
from grasp_env.force.lanes import options
from grasp_env.force.record import CODE, FORCE, REFUSED, STALLED, record_size
from grasp_env.grasp import Grasp
from policies import kernels
from policies.checkpoint import Checkpoint

PRETRAINED = Path(__file__).parent / "pretrained"
MODELS = ("any_grasp", "four_finger")
OUTSIDE = " (outside its training range)"
_NOTHING = np.empty(0)


class LearnedInitialForce(ABC):
    """An initial-force rule: rule(grasp, wrench) -> (N, 3) force [N], balanced and strictly feasible.

    Two kinds: `FixedGraspForce` knows one grasp, a network from the wrench to null-space coordinates, polished by learned Newton layers;
    `AnyGraspForce` reads the grasp, a few learned Newton layers from the 12-basis' combination. Both only ever lower Phi:
    never worse than the 12-basis of the grasp AS IT IS NOW, per call, by construction, at any wrench.

    Attributes:
        checkpoint: weights, normalisation, training range and model card.
        objective: Phi, that of training unless `with_objective` set another.
        remembers: whether it also starts from the previous solution, where that has less Phi.

    Example:
        >>> from grasp_env.force import optimize_force
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> optimize_force(grasp, wrench).iterations > 10
        True
        >>> optimize_force(grasp, wrench, initial=LearnedInitialForce.pretrained("four_finger")).iterations
        0
        >>> anywhere = LearnedInitialForce.pretrained()
        >>> optimize_force(presets.five_finger_cuboid(), wrench, initial=anywhere).iterations < 3
        True
    """

    _kernel: Any

    def __init__(self, checkpoint: Checkpoint, objective: Objective | None = None, remembers: bool = False) -> None:
        self.checkpoint = checkpoint
        self.objective = objective or Objective()
        self.remembers = remembers
        self._prepared: tuple[Grasp, Array, tuple[Any, ...]] | None = None

    @staticmethod
    def load(path: str | Path, *, remembers: bool = False) -> LearnedInitialForce:
        """The model saved at `path` (either file or their stem), of either kind.

        Args:
            path: of a model that `grasp fit` saved.
            remembers: start from the previous solution where that is better: for control loops.

        Raises:
            ModelFileError: missing, truncated, changed, of another schema, or not what its kind asks for.
        """
        from policies.any_grasp import AnyGraspForce
        from policies.fixed_grasp import FixedGraspForce

        checkpoint = Checkpoint.load(path)
        kinds = {"fixed_grasp": FixedGraspForce, "any_grasp": AnyGraspForce}
        return kinds[checkpoint.kind](checkpoint, remembers=remembers)

    @staticmethod
    def pretrained(name: str = "any_grasp", *, remembers: bool = False) -> LearnedInitialForce:
        """A model that ships with the package.

        Args:
            name: "any_grasp": three to five hard contacts anywhere; "four_finger": the contacts of `presets.paper_cuboid()`,
                three quarters of the time per call.
            remembers: see `load`.

        Raises:
            UnknownNameError: another name.
        """
        if name not in MODELS:
            raise UnknownNameError("pretrained model", name, MODELS)
        return LearnedInitialForce.load(PRETRAINED / name, remembers=remembers)

    @property
    def name(self) -> str:
        """What solutions say of their start."""
        return f"learned_{self.checkpoint.kind}{'_previous' if self.remembers else ''}"

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N].

        Raises:
            InfeasibleStartError: contacts that this model does not know, a grasp without force closure, or a wrench that
                is not finite.
        """
        return self.start(grasp, wrench, self.objective)[1]

    def with_objective(self, objective: Objective) -> LearnedInitialForce:
        """The same model for another Phi, exact up to scale: Phi knows forces in units of sqrt(lambda / omega) only."""
        other = copy(self)
        other.objective, other._prepared = objective, None
        return other

    def bind(
        self, grasp: Grasp, objective: Objective, tolerance: float, descend: Callable[[Array, Array, Array], None]
    ) -> Callable[[Array, Array, Array], str]:
        """The compiled solve of `ForceOptimizer`: one call where the start is certified already, `descend` goes on elsewhere.

        Args:
            grasp: the contacts.
            objective: Phi of the optimizer.
            tolerance: relative gap at which a start is a solution.
            descend: (start (3N,) [N], wrench, record) -> None, the optimizer's method.

        Returns:
            solve(wrench, previous, record) -> the start's name, "" where only the general path can say what is wrong;
            previous: (>= 3N,) force [N] or (0,).
        """
        rule = self if objective == self.objective else self.with_objective(objective)
        start, network = type(rule)._kernel, rule._network(grasp)
        numbers = rule._numbers(grasp, tolerance)
        name, outside, count = self.name, self.name + OUTSIDE, 3 * grasp.n_contacts
        names = (name, outside, name, outside, "")

        def solve(wrench: Array, previous: Array, record: Array) -> str:
            answer = start(wrench, previous, numbers, *network, record)
            if answer >= kernels.OPEN:
                if answer == REFUSED:
                    return ""
                descend(record[FORCE + count : FORCE + 2 * count].copy(), wrench, record)
                if not record[CODE] <= STALLED:
                    return ""
            return names[answer]

        return solve

    def start(
        self, grasp: Grasp, wrench: Wrench, objective: Objective, previous: ForceSolution | None = None
    ) -> tuple[str, ContactForces]:
        """The start's name, which says when wrench or grasp are outside the training range, and its force (N, 3) [N].

        Args:
            grasp: the contacts.
            wrench: (6,) [N, N m].
            objective: Phi.
            previous: a solution to start from where that has less Phi, if this rule remembers; one of another number of
                contacts is not used.

        Raises:
            InfeasibleStartError: see `__call__`.
        """
        rule = self if objective == self.objective else self.with_objective(objective)
        prepared = rule._prepared  # one tuple, read once: threads may share a rule
        if prepared is None or prepared[0] is not grasp:
            prepared = rule._prepared = grasp, rule._numbers(grasp, 0.0), rule._network(grasp)
        _, numbers, network = prepared
        known = self.remembers and previous is not None and previous.n_contacts == grasp.n_contacts
        before = np.array(previous.force).reshape(-1) if known and previous is not None else _NOTHING
        record = np.empty(record_size(grasp.n_contacts))
        answer = type(rule)._kernel(np.array(wrench, dtype=np.float64), before, numbers, *network, record)
        if answer == REFUSED:
            raise InfeasibleStartError(f"a wrench needs finite numbers, got {np.asarray(wrench).tolist()}")
        return self.name + OUTSIDE * (answer & kernels.OUTSIDE), record[FORCE : FORCE + 3 * grasp.n_contacts].reshape(
            -1, 3
        )

    def covers(self, grasp: Grasp, wrench: Wrench) -> bool:
        """Whether grasp and wrench lie in the training range; elsewhere the start is still safe, and solutions say so."""
        return not self.start(grasp, wrench, self.objective)[0].endswith(OUTSIDE)

    @abstractmethod
    def raw(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The network's own force (N, 3) [N], balanced, perhaps outside the cones."""

    @abstractmethod
    def _limit(self, grasp: Grasp) -> tuple[float, ...]:
        """Length and centre [m] of the frame in which training measured wrenches, their largest size [N]; see `kernels`."""

    @abstractmethod
    def _network(self, grasp: Grasp) -> tuple[Any, ...]:
        """What the compiled start reads besides the numbers."""

    def _numbers(self, grasp: Grasp, tolerance: float) -> Array:
        """What the compiled start reads of a grasp, see `kernels.split_contacts`."""
        if set(grasp.models.names) != {"hard"}:
            raise InfeasibleStartError(
                f"this model knows hard contacts, the grasp has {grasp.models.names}: use initial='linear_combination'"
            )
        parts = (
            np.array([tolerance, *self._limit(grasp)]),
            options(grasp, tolerance, 0),
            grasp.cone_matrix,
            grasp.unit_frame @ grasp.cone_matrix,
            grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None],
            grasp.models.cone_divisor,
            self.objective.weights(grasp.n_contacts),
            OfflineBasis.of(grasp, self.objective).cone_forces,
        )
        return np.concatenate([part.ravel() for part in parts])

    def __reduce__(self) -> tuple[Any, ...]:
        # the prepared grasp is a cache; sub-process environments get the checkpoint
        return type(self), (self.checkpoint, self.objective, self.remembers)
