"""Initial-force rules: rule(grasp, wrench) -> (N, 3) force, balanced and inside the cones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from grasp_env import core
from grasp_env.errors import InfeasibleStartError, InvalidInputError, shown
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.margin import ShiftedProblem
from grasp_env.force.objective import Objective
from grasp_env.force.options import Options
from grasp_env.force.record import REPLACED, START
from grasp_env.force.repair import Repair, start_replaced
from grasp_env.force.solution import COMBINATION, GIVEN, LEARNED, STARTS, ForceSolution, Names
from grasp_env.grasp.grasp import Grasp
from grasp_env.inputs.arguments import (
    Array,
    ContactForces,
    Wrench,
    as_array,
    as_wrench,
    call_user,
    choice,
)

BALANCE_TOLERANCE = 1e-8
"""Imbalance of a start, relative to its force and wrench, above which the error reports it."""


class InitialForceRule(Protocol):
    """An initial-force rule: any function (grasp, wrench) -> force (N, 3) [N].

    It receives the external wrench (6,) [N, N m]. The force is balanced and strictly inside the
    cones; a rule that finds none raises `InfeasibleStartError`.
    """

    def __call__(self, grasp: Grasp, wrench: Wrench, /) -> ContactForces:
        """See the class."""
        ...


@runtime_checkable
class CompiledRule(InitialForceRule, Protocol):
    """A rule whose network the core evaluates, so that start and method are one compiled call.

    Attributes:
        remembers: True to start from the previous solution when its Phi is smaller.
    """

    remembers: bool

    def model(self, grasp: Grasp, objective: Objective) -> core.Model:
        """Return the compiled network for that Phi.

        Raises:
            InfeasibleStartError: the rule does not support these contacts.
        """
        ...


@dataclass(frozen=True)
class StartRequest:
    """The start of one call of the core.

    Attributes:
        start: index into `STARTS`.
        name: name of the force in the solution; None: the name in `STARTS`.
        replaced: True if the paper's combination replaced a rule's force.
        force: (N, 3) [N], for the start "given".
        before: the solution to carry over in place of the last one.
    """

    start: int
    name: str | None = None
    replaced: bool = False
    force: ContactForces | None = None
    before: ForceSolution | None = None

    def request(self, optimum: float = float("nan"), trace: Array | None = None) -> core.Request:
        """Return the core's request, with `optimum` and `trace` of `ForceOptimizer.solve`."""
        return core.Request(
            start=self.start, force=self.force, previous=self.before, optimum=optimum, trace=trace
        )

    def mark(self, record: Array) -> None:
        """Note `replaced` in the record of a solution."""
        if self.replaced:
            record[START], record[REPLACED] = COMBINATION, 1.0


OWN_START = StartRequest(0)
"""The start of the optimizer itself."""


def rule_name(rule: Any) -> str:
    """Return the name of a rule for solutions: its `name`, its `__name__`, or that of its class."""
    if isinstance(rule, str):
        return rule
    names = getattr(rule, "name", None), getattr(rule, "__name__", None)
    return next((name for name in names if isinstance(name, str) and name), type(rule).__name__)


def call_rule(rule: Any, function: Callable[..., Any], *args: Any) -> Any:
    """Call a user's rule; any failure becomes an `InfeasibleStartError`."""
    takes = (
        "a rule takes (grasp, wrench) and returns an (N, 3) force, or raises InfeasibleStartError"
    )
    what = f"initial-force rule {rule_name(rule)!r}"
    return call_user(function, *args, what=what, takes=takes, fault=InfeasibleStartError)


@dataclass(frozen=True)
class LinearCombination:
    """The paper's start: non-negative combination of the 12 offline optima (Sec. III, Eqs. 32-34).

    The printed combination is zero at w = 0, where P is singular. Therefore max(0, 1 - sum E_k)
    times the optimum at w = 0 is added, unless `printed`.

    Attributes:
        objective: the Phi whose optima are combined.
        printed: True for the combination as printed.

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
        """Return the start (N, 3) [N]; see the class."""
        wrench = as_wrench(wrench)
        if self.printed and not wrench.any():
            raise InfeasibleStartError(
                "the printed linear combination is zero at w = 0, which is not inside the cones; "
                "use initial='linear_combination', which adds the rest force"
            )
        return OfflineBasis.of(grasp, self.objective).combine(wrench, self.printed)


def checked_initial(initial: Any) -> Any:
    """Return a checked `initial`, with a name as a plain str."""
    if isinstance(initial, str):
        hint = (
            "; a learned start is an object: policies.LearnedInitialForce.pretrained()"
            if "learn" in initial
            else ""
        )
        return choice(initial, "initial-force rule", NAMES, hint)
    is_force = initial is None or isinstance(initial, ForceSolution | np.ndarray | list | tuple)
    if not is_force and (not callable(initial) or isinstance(initial, type)):
        raise InvalidInputError(
            f"initial must be a rule's name, a rule(grasp, wrench), an (N, 3) force or a ForceSolution, got {shown(initial)}"
        )
    return initial


def rule_start(initial: Any, problem: ShiftedProblem, objective: Objective) -> StartRequest:
    """Return the start from a rule, which may have none, or from the user's force (N, 3) [N].

    A rule sees the shifted problem of the margin.
    """
    grasp, wrench, _ = problem
    if isinstance(initial, np.ndarray | list | tuple):
        return StartRequest(GIVEN, "given", force=_force("given", initial, grasp))
    name = rule_name(initial)
    force = call_rule(initial, initial, grasp, wrench.copy())
    if call_rule(initial, lambda: bool(getattr(initial, "objective", objective) != objective)):
        # the rule's guarantees hold for its own Phi only: establish them for this one
        force = Repair(objective)(grasp, wrench, force)
    start = _force(name, force, grasp)
    replaced = not isinstance(initial, LinearCombination) and start_replaced(grasp, wrench, start)
    return StartRequest(GIVEN, name, replaced, problem.outer(start))


def _force(name: str, force: Any, grasp: Grasp) -> ContactForces:
    """Return a rule's force (N, 3) as an array."""
    try:
        return as_array(force, (grasp.n_contacts, 3), "initial force")
    except InvalidInputError as error:
        reason = "it returned None: does it end in a return?" if force is None else error
        raise InfeasibleStartError(f"initial-force rule {name!r}: {reason}") from None


def names_of(initial: Any, options: Options) -> Names:
    """Return the names that the solutions of an optimizer show."""
    if options.method == "conic":
        return Names(options.method, "central")
    if initial is None:
        return Names(options.method, "linear_combination" if options.flows else "internal_force")
    if isinstance(initial, ForceSolution):
        return Names(options.method, "previous")
    name = "given" if isinstance(initial, np.ndarray | list | tuple) else rule_name(initial)
    if name in STARTS:
        return Names(options.method, name)
    return Names(options.method, name).of_start(
        LEARNED if isinstance(initial, CompiledRule) else GIVEN, name
    )


def refused_start(
    problem: ShiftedProblem, start: StartRequest, touching: Any
) -> InfeasibleStartError:
    """Return the error for a given force that a descent did not accept."""
    assert start.force is not None
    grasp, wrench, _ = problem
    force = problem.inner(start.force if touching is None else start.force[touching])
    missed = grasp.residual(force, wrench)
    scale = float(np.abs(force).max()) + float(np.abs(grasp.unit_frame @ wrench).max())
    if missed > BALANCE_TOLERANCE * scale:
        return InfeasibleStartError(
            f"initial-force rule {start.name!r} misses balance by {missed:.3g} N (G f + w = 0, w the wrench ON the object); "
            "add -G^+ (G f + w), or pass it through grasp_env.force.Repair"
        )
    return InfeasibleStartError(
        f"initial-force rule {start.name!r} leaves the friction cones (cone margin {grasp.cone_margin(force):.3g} N, within the optimizer's margin); "
        "pass it through grasp_env.force.Repair"
    )


NAMES = STARTS[STARTS.index("internal_force") : STARTS.index("given")]
"""Start names accepted as `initial`."""
Initial = str | InitialForceRule | ForceSolution | np.ndarray
"""A start: a rule's name, a rule, a previous solution, or a force (N, 3)."""
