"""Initial-force rules: anything callable as rule(grasp, wrench) -> (N, 3) force, balanced and strictly feasible."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from grasp_env import core
from grasp_env._check import Array, ContactForces, Wrench, as_array, as_text, as_wrench, choice, is_a
from grasp_env.errors import GraspError, InfeasibleStartError, InvalidInputError, shown
from grasp_env.force.basis import OfflineBasis, starter
from grasp_env.force.objective import Objective, as_objective
from grasp_env.force.repair import Repair, start_replaced
from grasp_env.force.solution import STARTS, ForceSolution
from grasp_env.grasp.grasp import Grasp

if TYPE_CHECKING:
    from grasp_env._check import TypeIs

T = TypeVar("T")
SQUEEZE = 1.1
"""The factor by which single-value and Lagrange starts exceed the least feasible squeeze."""
LAGRANGE_WEIGHTS = np.array([1.0, 10.0, 10.0])
"""W of the Lagrange start, per contact: a tangential newton costs ten times a normal one."""


class InitialForceRule(Protocol):
    """A start: rule(grasp, wrench) -> force (N, 3) [N], balanced and strictly inside the cones; any function is one.

    It gets the `Grasp` and the external wrench (6,) [N, N m], and raises `InfeasibleStartError` where it has no such force.
    """

    def __call__(self, grasp: Grasp, wrench: Wrench, /) -> ContactForces:
        """(N, 3) [N]; raises `InfeasibleStartError` where the rule has no such force."""
        ...


@runtime_checkable
class LearnedRule(InitialForceRule, Protocol):
    """A rule whose predictions the core makes: start and method are one compiled call.

    Attributes:
        remembers: whether it also starts from the previous solution, where that has less Phi.
    """

    remembers: bool

    def model(self, grasp: Grasp, objective: Objective) -> core.Model:
        """What the core predicts with, for that Phi.

        Raises:
            InfeasibleStartError: contacts that the rule does not know.
        """
        ...


@dataclass(frozen=True)
class StartFrom:
    """Where a call of the core begins.

    Attributes:
        start: a place in `STARTS`.
        name: of a force that is given, for the solution; None: the start's own.
        replaced: whether the paper's combination took the place of what a rule had in mind.
        force: (N, 3) [N] that is given; torsion: (N,) [N m] with it.
        before: the solution to carry over.
    """

    start: int
    name: str | None = None
    replaced: bool = False
    force: ContactForces | None = None
    torsion: Array | None = None
    before: ForceSolution | None = None


def is_rule(value: object, kind: type[T]) -> TypeIs[T]:
    """Whether an object is of one of the protocols above; one whose attributes fail is of none."""
    try:
        return isinstance(value, kind)
    except Exception:
        return False


def rule_name(rule: Any) -> str:
    """What solutions call a start: a rule's own name, or that of a callable or its class."""
    text = as_text(rule)
    if text is not None:
        return text
    for name in ("name", "__name__"):
        with suppress(Exception):  # an attribute of somebody else's
            found = as_text(getattr(rule, name, None))
            if found:
                return found
    return type(rule).__name__


def call_rule(rule: Any, function: Callable[..., Any], *given: Any) -> Any:
    """Calls a user's rule; any failure becomes `InfeasibleStartError`.

    Raises:
        InfeasibleStartError: it fails, in whatever way; `__cause__` says which.
    """
    try:
        return function(*given)
    except GraspError:
        raise
    except Exception as error:
        raise InfeasibleStartError(
            f"initial-force rule {rule_name(rule)!r} fails with {type(error).__name__}: {str(error)[:200]}; a rule takes "
            "(grasp, wrench) and returns an (N, 3) force, or raises InfeasibleStartError"
        ) from error


@dataclass(frozen=True)
class LinearCombination:
    """The paper's start: non-negative combination of the 12 offline optima (Sec. III, Eqs. 32-34).

    As printed it vanishes with the wrench, where P is singular, so max(0, 1 - sum E_k) times the optimum at w = 0 is added.

    Attributes:
        objective: the Phi whose optima are combined.
        printed: leave that rest force out: no start at w = 0 then.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> start = LinearCombination()(grasp, wrench)
        >>> start.shape, grasp.cone_margin(start) > 0, grasp.residual(start, wrench) < 1e-12
        ((4, 3), True, True)
    """

    objective: Objective = field(default_factory=Objective)
    printed: bool = False

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        wrench = as_wrench(wrench)
        if self.printed and not wrench.any():
            raise InfeasibleStartError(
                "the printed linear combination is zero at w = 0, which is not inside the cones; "
                "use initial='linear_combination', which adds the rest force"
            )
        return OfflineBasis.of(grasp, self.objective).combine(wrench, self.printed)


@dataclass(frozen=True)
class SingleValue:
    """f_0 = -G^+ w + k f_rest, k = max(1.1 k_min, 1): the singular-value start (our definition: the paper gives none).

    k_min is the least factor that is strictly feasible, f_rest the optimum at w = 0. The floor of 1 matters only for small
    wrenches, where k_min vanishes and -G^+ w + 1.1 k_min f_rest would have a singular P.

    Attributes:
        objective: the Phi whose optimum at w = 0 it squeezes with.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(SingleValue()(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        rest = OfflineBasis.of(grasp, self.objective).cone_forces[12]
        particular = grasp.to_cone(-(grasp.pseudoinverse @ as_wrench(wrench)).reshape(-1, 3))
        low, _ = starter(grasp, self.objective).inside(particular, rest)
        return grasp.to_force(particular + max(SQUEEZE * low, 1.0) * rest)


@dataclass(frozen=True)
class Lagrange:
    """argmin (f - k n)^T W (f - k n) s.t. G f = -w by multipliers, W = diag(1, 10, 10) (our definition).

    n are the unit normal forces. The solution is affine in k, so the strictly feasible k form an interval, found in
    closed form: k = max(1.1 k_min, the normal force of f_rest), at most the middle of the interval.

    Attributes:
        objective: the Phi whose optimum at w = 0 is f_rest.

    Raises:
        InfeasibleStartError: no k is strictly feasible, which happens on many grasps.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(Lagrange()(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        rest = OfflineBasis.of(grasp, self.objective).cone_forces[12]
        scaled = grasp.matrix / np.tile(LAGRANGE_WEIGHTS, grasp.n_contacts)
        normals = np.tile([1.0, 0.0, 0.0], grasp.n_contacts)
        solve = scaled.T @ np.linalg.solve(
            scaled @ grasp.matrix.T, np.stack([as_wrench(wrench), grasp.matrix @ normals], axis=1)
        )
        point = grasp.to_cone((-solve[:, 0]).reshape(-1, 3))
        ray = grasp.to_cone((normals - solve[:, 1]).reshape(-1, 3))
        low, high = starter(grasp, self.objective).inside(point, ray)
        if not low < high:
            raise InfeasibleStartError(
                "the Lagrange start has no strictly feasible squeeze k for this grasp and wrench; "
                "use initial='linear_combination'"
            )
        floor = float((rest[0::3] / grasp.friction).mean())
        return grasp.to_force(point + min(max(SQUEEZE * low, floor), 0.5 * (low + high)) * ray)


@dataclass(frozen=True)
class PhaseOne:
    """The force deepest inside the cones, from an interior-point phase one: slow, needs no force closure.

    Attributes:
        objective: not used; every rule has one.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> grasp.cone_margin(PhaseOne()(grasp, [1, 0.5, -0.6, -0.1, 0.2, 0])) > 0
        True
    """

    objective: Objective = field(default_factory=Objective)

    def __call__(self, grasp: Grasp, wrench: Wrench) -> ContactForces:
        """The start (N, 3) [N]; see the class."""
        from grasp_env.force.feasibility import phase_one

        answer = phase_one(grasp, wrench)
        if answer.force is None:
            raise InfeasibleStartError("no force strictly inside the cones balances the wrench")
        return answer.force


@dataclass(frozen=True)
class StartRule:
    """An entry of `RULES`: makes the rule for a Phi.

    Attributes:
        label: for people.
        make: Objective -> the rule.
        needs: what the grasp must have: "closure" for the 12-basis, "wrench" where a force for the wrench is enough.
    """

    label: str
    make: Callable[[Objective], InitialForceRule] = field(repr=False)
    needs: str = "closure"

    def __call__(self, objective: Objective) -> InitialForceRule:
        """The rule for that Phi."""
        return self.make(objective)


RULES: dict[str, StartRule] = {
    "linear_combination": StartRule("12-basis (the paper, fixed at w = 0)", LinearCombination),
    "linear_combination_printed": StartRule(
        "12-basis, as printed", lambda objective: LinearCombination(objective, printed=True)
    ),
    "single_value": StartRule("single value", SingleValue),
    "lagrange": StartRule("Lagrange", Lagrange),
    "phase_one": StartRule("phase one, the deepest force", PhaseOne, needs="wrench"),
}
"""The start rules by name; "previous" lives in `ForceOptimizer`, which remembers."""


def initial_rule(name: str, objective: Objective | None = None) -> InitialForceRule:
    """The rule of that name for the given Phi.

    Args:
        name: a key of `RULES`.
        objective: Phi; None: the defaults.

    Raises:
        UnknownNameError: no rule of that name.

    Example:
        >>> initial_rule("single_value")
        SingleValue(objective=Objective(force_weight=1.0, barrier_weight=0.01))
        >>> initial_rule("newest")
        Traceback (most recent call last):
        grasp_env.errors.UnknownNameError: unknown initial-force rule 'newest': choose one of 'linear_combination', \
'linear_combination_printed', 'single_value', 'lagrange', 'phase_one'
    """
    return RULES[choice(name, "initial-force rule", RULES)](as_objective(objective))


def checked_initial(initial: Any) -> Any:
    """A start as `optimize_force` takes it, names as plain text.

    Raises:
        UnknownNameError, InvalidInputError: it is none.
    """
    named = as_text(initial)
    if named is not None:
        hint = "; a learned start is an object: policies.LearnedInitialForce.pretrained()" if "learn" in named else ""
        return choice(named, "initial-force rule", (*RULES, "internal_force", "previous"), hint)
    given = initial is None or is_a(initial, ForceSolution | np.ndarray | list | tuple)
    if not given and (is_a(initial, type) or not callable(initial)):
        raise InvalidInputError(
            f"initial must be a rule's name, a rule(grasp, wrench), an (N, 3) force or a ForceSolution, got {shown(initial)}"
        )
    return initial


def rule_start(initial: Any, grasp: Grasp, wrench: Wrench, objective: Objective) -> StartFrom:
    """The start that a rule or a force (N, 3) [N] gives.

    Raises:
        InfeasibleStartError: the rule fails, or what it returns is no force.
    """
    if is_a(initial, np.ndarray | list | tuple):
        return StartFrom(GIVEN, "given", force=_force("given", initial, grasp))
    name, force = rule_name(initial), call_rule(initial, initial, grasp, wrench.copy())
    if call_rule(initial, lambda: bool(getattr(initial, "objective", objective) != objective)):
        # made for another Phi, in which its guarantees hold: give them in this one
        force = Repair(objective)(grasp, wrench, force)
    made = _force(name, force, grasp)
    replaced = not is_a(initial, LinearCombination) and start_replaced(grasp, wrench, made)
    return StartFrom(GIVEN, name, replaced, made)


def _force(name: str, force: Any, grasp: Grasp) -> ContactForces:
    """A rule's force as the core reads it."""
    try:
        return np.ascontiguousarray(as_array(force, (grasp.n_contacts, 3), "initial force"))
    except InvalidInputError as error:
        told = "it returned None: does it end in a return?" if force is None else error
        raise InfeasibleStartError(f"initial-force rule {name!r}: {told}") from None


GIVEN = STARTS.index("given")
Initial = str | InitialForceRule | ForceSolution | np.ndarray
"""A rule's name, a rule, a solution to carry over, or an (N, 3) force to start from."""
