"""Initial-force rules: anything callable as rule(grasp, wrench) -> (N, 3) force, balanced and strictly feasible."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from grasp_env import core
from grasp_env._check import ContactForces, Wrench, as_array, as_text, as_wrench, call_user, choice
from grasp_env.errors import InfeasibleStartError, InvalidInputError, shown
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.objective import Objective
from grasp_env.force.repair import Repair, start_replaced
from grasp_env.force.solution import GIVEN, STARTS, ForceSolution
from grasp_env.grasp.grasp import Grasp

if TYPE_CHECKING:
    from grasp_env._check import TypeIs

T = TypeVar("T")


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
        """The network for that Phi, which the core evaluates.

        Raises:
            InfeasibleStartError: contacts that the rule does not know.
        """
        ...


@dataclass(frozen=True)
class StartFrom:
    """The start of one call of the core.

    Attributes:
        start: a place in `STARTS`.
        name: of a force that is given, for the solution; None: the start's own.
        replaced: whether the paper's combination took the place of a rule's own force.
        force: (N, 3) [N] that is given.
        before: the solution to carry over.
    """

    start: int
    name: str | None = None
    replaced: bool = False
    force: ContactForces | None = None
    before: ForceSolution | None = None


def is_rule(value: object, kind: type[T]) -> TypeIs[T]:
    """Whether an object is of one of the protocols above; one whose attributes fail is of none."""
    try:
        return isinstance(value, kind)
    except Exception:
        return False


def rule_name(rule: Any) -> str:
    """The name of a start in solutions: a rule's own, or that of a callable or its class."""
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
    takes = "a rule takes (grasp, wrench) and returns an (N, 3) force, or raises InfeasibleStartError"
    what = f"initial-force rule {rule_name(rule)!r}"
    return call_user(function, *given, what=what, takes=takes, fault=InfeasibleStartError)


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


def checked_initial(initial: Any) -> Any:
    """A start as `optimize_force` takes it, names as plain text.

    Raises:
        UnknownNameError, InvalidInputError: it is none.
    """
    named = as_text(initial)
    if named is not None:
        hint = "; a learned start is an object: policies.LearnedInitialForce.pretrained()" if "learn" in named else ""
        return choice(named, "initial-force rule", NAMES, hint)
    given = initial is None or isinstance(initial, ForceSolution | np.ndarray | list | tuple)
    if not given and (isinstance(initial, type) or not callable(initial)):
        raise InvalidInputError(
            f"initial must be a rule's name, a rule(grasp, wrench), an (N, 3) force or a ForceSolution, got {shown(initial)}"
        )
    return initial


def rule_start(initial: Any, grasp: Grasp, wrench: Wrench, objective: Objective) -> StartFrom:
    """The start that a rule or a force (N, 3) [N] gives.

    Raises:
        InfeasibleStartError: the rule fails, or what it returns is no force.
    """
    if isinstance(initial, np.ndarray | list | tuple):
        return StartFrom(GIVEN, "given", force=_force("given", initial, grasp))
    name, force = rule_name(initial), call_rule(initial, initial, grasp, wrench.copy())
    if call_rule(initial, lambda: bool(getattr(initial, "objective", objective) != objective)):
        # made for another Phi, in which its guarantees hold: give them in this one
        force = Repair(objective)(grasp, wrench, force)
    made = _force(name, force, grasp)
    replaced = not isinstance(initial, LinearCombination) and start_replaced(grasp, wrench, made)
    return StartFrom(GIVEN, name, replaced, made)


def _force(name: str, force: Any, grasp: Grasp) -> ContactForces:
    """A rule's force as a C-contiguous array (N, 3)."""
    try:
        return np.ascontiguousarray(as_array(force, (grasp.n_contacts, 3), "initial force"))
    except InvalidInputError as error:
        told = "it returned None: does it end in a return?" if force is None else error
        raise InfeasibleStartError(f"initial-force rule {name!r}: {told}") from None


NAMES = STARTS[STARTS.index("internal_force") : STARTS.index("given")]
"""Starts that are asked for by name."""
Initial = str | InitialForceRule | ForceSolution | np.ndarray
"""A rule's name, a rule, a solution to carry over, or an (N, 3) force to start from."""
