"""Initial-force rules: anything callable as rule(grasp, wrench) -> (N, 3) force, balanced and strictly feasible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError, InvalidInputError, UnknownNameError
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.feasibility import phase_one
from grasp_env.force.layer_kernels import FEATURES
from grasp_env.force.objective import Objective
from grasp_env.force.solution import ForceSolution
from grasp_env.force.start_kernels import ray_interval
from grasp_env.grasp.grasp import Grasp

SQUEEZE = 1.1
"""The factor by which single-value and Lagrange starts exceed the least feasible squeeze."""
LAGRANGE_WEIGHTS = np.array([1.0, 10.0, 10.0])
"""W of the Lagrange start, per contact: a tangential newton costs ten times a normal one."""


class InitialForceRule(Protocol):
    """A start: rule(grasp, wrench (6,)) -> force (N, 3) [N]."""

    def __call__(self, grasp: Grasp, wrench: Wrench, /) -> ContactForces:
        """(N, 3) [N]; raises `InfeasibleStartError` where the rule has no such force."""
        ...


@runtime_checkable
class CompiledRule(InitialForceRule, Protocol):
    """A rule that also knows other Phis, the previous solution, and how to start and descend in one compiled call.

    Attributes:
        remembers: whether the previous solution is handed to it.
    """

    remembers: bool

    def start(
        self, grasp: Grasp, wrench: Wrench, objective: Objective, previous: ForceSolution | None
    ) -> tuple[str, ContactForces]:
        """The start's name and force (N, 3) [N], for that Phi."""
        ...

    def bind(
        self, grasp: Grasp, objective: Objective, tolerance: float, descend: Callable[[Array, Array, Array], None]
    ) -> Callable[[Array, Array, Array], str]:
        """solve(wrench, previous, record) -> the start's name, "" where the general path has to say what is wrong.

        It writes `record` (`record.py`).

        Args:
            grasp: the contacts; raises `InfeasibleStartError` where the rule does not know them.
            objective: Phi.
            tolerance: relative gap at which a start is a solution.
            descend: (start (3N,) [N], wrench, record) -> None: the method, where the start is none.
        """
        ...


@runtime_checkable
class LayeredRule(CompiledRule, Protocol):
    """A rule made of learned Newton layers (`layer_kernels.refine`), which a `ForcePipeline` compiles in.

    Attributes:
        name: of the start. layers: (K, numbers) float32. width: of their hidden layers.
    """

    name: str
    layers: NDArray[np.float32]
    width: int


def check_layers(layers: NDArray[np.float32], width: int) -> None:
    """Raises `InvalidInputError` unless kernels can read these learned layers."""
    numbers = 2 * width * width + (FEATURES + 5) * width + 3
    fits = isinstance(layers, np.ndarray) and layers.dtype == np.float32 and layers.ndim == 2 and layers.flags.carray
    if not (fits and width > 0 and layers.shape[1] == numbers):
        raise InvalidInputError(
            f"learned layers must be a C-contiguous float32 array (K, {numbers}) for width {width}, got "
            f"{getattr(layers, 'dtype', type(layers).__name__)} {getattr(layers, 'shape', '')}"
        )


@dataclass(frozen=True)
class LinearCombination:
    """The paper's start: non-negative combination of the 12 offline optima (Sec. III, Eqs. 32-34).

    `printed=True` leaves out the rest force that keeps it away from P = 0 at small wrenches; it then has no start
    at w = 0.
    """

    objective: Objective = field(default_factory=Objective)
    printed: bool = False

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        if self.printed and not wrench.any():
            raise InfeasibleStartError(
                "the printed linear combination is zero at w = 0, which is not inside the cones; "
                "use initial='linear_combination', which adds the rest force"
            )
        return OfflineBasis.of(grasp, self.objective).combine(wrench, self.printed)


@dataclass(frozen=True)
class SingleValue:
    """f_0 = -G^+ w + k f_rest, k = max(1.1 k_min, 1): the singular-value start (our definition, see README).

    k_min is the least factor that is strictly feasible. The floor of 1 matters only for small wrenches, where
    k_min vanishes and -G^+ w + 1.1 k_min f_rest would have a singular P.
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        rest = OfflineBasis.of(grasp, self.objective).cone_forces[12]
        particular = grasp.to_cone(-(grasp.pseudoinverse @ wrench).reshape(-1, 3))
        low, _ = ray_interval(particular, rest)
        return grasp.to_force(particular + max(SQUEEZE * low, 1.0) * rest)


@dataclass(frozen=True)
class Lagrange:
    """argmin (f - k n)^T W (f - k n) s.t. G f = -w by multipliers, W = diag(1, 10, 10) (our definition).

    n are the unit normal forces. The solution is affine in k, so the strictly feasible k form an interval, found in
    closed form: k = max(1.1 k_min, the normal force of f_rest), at most the middle of the interval.

    Raises:
        InfeasibleStartError: no k is strictly feasible, which happens on many grasps.
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        rest = OfflineBasis.of(grasp, self.objective).cone_forces[12]
        scaled = grasp.matrix / np.tile(LAGRANGE_WEIGHTS, grasp.n_contacts)
        normals = np.tile([1.0, 0.0, 0.0], grasp.n_contacts)
        solve = scaled.T @ np.linalg.solve(scaled @ grasp.matrix.T, np.stack([wrench, grasp.matrix @ normals], axis=1))
        point = grasp.to_cone((-solve[:, 0]).reshape(-1, 3))
        ray = grasp.to_cone((normals - solve[:, 1]).reshape(-1, 3))
        low, high = ray_interval(point, ray)
        if not low < high:
            raise InfeasibleStartError(
                "the Lagrange start has no strictly feasible squeeze k for this grasp and wrench; "
                "use initial='linear_combination'"
            )
        floor = float((rest[0::3] / grasp.friction).mean())
        return grasp.to_force(point + min(max(SQUEEZE * low, floor), 0.5 * (low + high)) * ray)


@dataclass(frozen=True)
class PhaseOne:
    """Any strictly feasible force, from an interior-point phase one: slow, needs no force closure."""

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        answer = phase_one(grasp, wrench)
        if answer.force is None:
            raise InfeasibleStartError("no force strictly inside the cones balances the wrench")
        return answer.force


RULES: dict[str, Callable[[Objective], InitialForceRule]] = {
    "linear_combination": LinearCombination,
    "linear_combination_printed": lambda objective: LinearCombination(objective, printed=True),
    "single_value": SingleValue,
    "lagrange": Lagrange,
    "phase_one": PhaseOne,
}
"""Names of the start rules; "previous" lives in `ForceOptimizer`, which remembers."""


def initial_rule(name: str, objective: Objective | None = None) -> InitialForceRule:
    """The rule of that name for the given Phi.

    Raises:
        UnknownNameError: no rule of that name.

    Example:
        >>> initial_rule("newest")
        Traceback (most recent call last):
        grasp_env.errors.UnknownNameError: unknown initial-force rule 'newest': choose one of 'linear_combination', \
'linear_combination_printed', 'single_value', 'lagrange', 'phase_one'
    """
    if name not in RULES:
        raise UnknownNameError("initial-force rule", name, RULES)
    return RULES[name](objective or Objective())
