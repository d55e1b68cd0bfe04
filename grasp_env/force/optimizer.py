"""`ForceOptimizer`, the control loop's form, and `optimize_force`, the same for one call."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import ranges
from grasp_env._check import ContactForces, as_text, as_wrench, choice, flag, instance, is_a, positive, together, whole
from grasp_env.errors import (
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    UnsupportedProblemError,
    shown,
)
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.initial import RULES, InitialForceRule, rule_name
from grasp_env.force.limits import ForceLimits, as_limits
from grasp_env.force.method import CRITERIA, Settings, readable
from grasp_env.force.methods import METHODS, make_method
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.record import CODE, CONVERGED, LIMITS_EXCEEDED, REFUSED, record_size
from grasp_env.force.repair import CORRECTIONS, Correction
from grasp_env.force.solution import ForceSolution
from grasp_env.force.step_size import StepRule, checked_rule
from grasp_env.grasp.advice import warn_of
from grasp_env.grasp.grasp import Grasp, as_grasp

if TYPE_CHECKING:
    from grasp_env.force.program import ForceProgram

MAX_ITERATIONS = 20_000
TOLERANCE = 1e-4
"""Default relative gap of the descents on Phi."""
CONIC_TOLERANCE = 1e-6
"""Default relative gap of the conic problem."""

_empty = np.empty
Initial = str | InitialForceRule | ForceSolution | np.ndarray
"""A rule's name, a rule, a solution to carry over, or an (N, 3) force to start from."""


class ForceOptimizer:
    """Optimises grasp forces again and again: holds the offline basis, the core's solver and the previous solution.

    One optimizer belongs to one thread; several may run at once.

    Example:
        >>> from grasp_env.grasp import presets
        >>> optimizer = ForceOptimizer(presets.paper_cuboid(), initial="previous")
        >>> first = optimizer.solve([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> again = optimizer.solve([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> first.status.name, again.iterations
        ('OPTIMAL', 0)
        >>> exact = ForceOptimizer(presets.paper_cuboid(), method="conic").solve([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> round(exact.objective, 4), exact.optimality_gap < 1e-6
        (8.5847, True)
    """

    def __init__(
        self,
        grasp: Grasp,
        *,
        initial: Initial | None = None,
        method: str = "reduced_flow",
        criterion: str = "sum",
        limits: ForceLimits | None = None,
        force_weight: Weight = 1.0,
        barrier_weight: Weight = 0.01,
        tolerance: float | None = None,
        max_iterations: int = MAX_ITERATIONS,
        step_rule: StepRule | None = None,
        correction: Correction = "tangent",
        elastic: bool = False,
    ) -> None:
        """Prepares the method for the grasp.

        Args:
            grasp: the contacts of now; `move_to` gives others.
            initial: where every call starts, as in `optimize_force`; or "previous": where the last one ended.
            method, criterion, limits, force_weight, barrier_weight, tolerance, max_iterations, step_rule, elastic: see `optimize_force`.
            correction: how `initial="previous"` restores balance, "tangent" or "pseudoinverse".
        """
        checked = together(
            lambda: choice(method, "method", METHODS),
            lambda: choice(criterion, "criterion", CRITERIA),
            lambda: as_limits(limits),
            lambda: Objective(force_weight, barrier_weight),
            lambda: _tolerance(tolerance, method),
            lambda: whole(max_iterations, "max_iterations", 0, ranges.ITERATIONS),
            lambda: checked_rule(step_rule),
            lambda: choice(correction, "correction", CORRECTIONS),
            lambda: flag(elastic, "elastic"),
            lambda: as_grasp(grasp),
            lambda: checked_initial(initial),
        )
        self.settings = Settings(*checked[:9])
        self.objective = self.settings.objective
        if elastic and limits is None:
            raise InvalidInputError("elastic=True says what to do with limits that no force keeps: give limits")
        method, criterion, initial = self.settings.method, self.settings.criterion, checked[10]
        if criterion != "sum" and method != "conic":
            raise UnsupportedProblemError(f"criterion {criterion!r} belongs to method 'conic', got method {method!r}")
        if initial is not None and method in ("conic", "linear"):
            raise InvalidInputError(f"method {method!r} starts from its own centre, got initial={shown(initial)}")
        # a solution is where the first call starts; the next ones start from their own previous one
        self._previous: ForceSolution | None = initial if is_a(initial, ForceSolution) else None
        self._initial: Initial | None = "previous" if is_a(initial, ForceSolution) else initial
        warn_of(grasp)
        self._set_grasp(grasp, self.settings)

    @property
    def grasp(self) -> Grasp:
        """The contacts as they are now; to set them is to `move_to` them."""
        return self._grasp

    @grasp.setter
    def grasp(self, grasp: Grasp) -> None:
        self.move_to(grasp)

    def __repr__(self) -> str:
        start = "its own start" if self._initial is None else rule_name(self._initial)
        return f"ForceOptimizer({self.grasp.n_contacts} contacts, {self.method} from {start})"

    @property
    def initial(self) -> Initial | None:
        """The start of every call that has none of its own."""
        return self._initial

    @property
    def method(self) -> str:
        """The method's name."""
        return self.settings.method

    @property
    def tolerance(self) -> float:
        """Relative certified gap at which a solve stops."""
        return self.settings.tolerance

    @property
    def max_iterations(self) -> int:
        """Most accepted steps."""
        return self.settings.max_iterations

    @property
    def step_rule(self) -> StepRule:
        """The flows' step rule."""
        return self.settings.step_rule

    @property
    def previous(self) -> ForceSolution | None:
        """The last solution, where `initial="previous"` starts; None: forgotten, or none yet."""
        return self._previous

    @previous.setter
    def previous(self, solution: ForceSolution | None) -> None:
        self._previous = instance(solution, ForceSolution, "previous", or_none=True)

    @property
    def limit_labels(self) -> tuple[str, ...]:
        """What each entry of a solution's `limit_multipliers` belongs to."""
        return getattr(self._method, "limit_labels", ())

    def move_to(self, grasp: Grasp, limits: ForceLimits | None = None) -> None:
        """The contacts moved: re-optimise the offline basis from the old one, keep the previous solution.

        Args:
            grasp: the contacts of now; with another number of them the previous solution is forgotten.
            limits: those of now, such as with the Jacobian of now; None: as they were.

        Raises:
            UnsupportedProblemError, InvalidInputError: as at the start; the optimizer stays where it was.
        """
        as_grasp(grasp)
        settings = self.settings if limits is None else replace(self.settings, limits=as_limits(limits))
        if self.grasp.n_contacts == grasp.n_contacts and self._method.uses_basis:
            # a grasp without force closure has no basis; rules that need one will say so
            with suppress(InfeasibleStartError):
                OfflineBasis.of(self.grasp, self.objective).moved_to(grasp)
        changed = self.grasp.n_contacts != grasp.n_contacts
        self._set_grasp(grasp, settings)
        if changed:
            self._previous = None

    def solve(
        self,
        wrench: ArrayLike,
        *,
        initial: Initial | None = None,
        optimum: float | None = None,
        trace: bool = False,
    ) -> ForceSolution:
        """The optimal grasp force that balances `wrench`; see `optimize_force`.

        Args:
            wrench: (6,) external wrench on the object [N, N m], object frame.
            initial: a start for this call only.
            optimum: a known min Phi: stop at the relative gap to it instead of the certified one (for studies).
            trace: keep Phi of every iterate in `objective_trace`.
        """
        loop = self._loop
        if loop is not None and initial is None and optimum is None and trace is False:
            # the control loop's path: one compiled call, which reads the array as it is or refuses it
            record = _empty(self._size)
            if not loop.remembers or self._previous is None:
                code, name = loop.call(wrench, None, record), loop.name
            else:
                code, name = loop.call(wrench, self._previous._record, record), loop.carried
            if code == CONVERGED:
                self._previous = solution = loop.solution(record, self._name, name)
                return solution
            if code != REFUSED:
                self._previous = solution = loop.stopped(record, self._name, name)
                return solution
            if not readable(wrench):
                return self.solve(as_wrench(wrench))
        load, known, _ = together(
            lambda: as_wrench(wrench),
            lambda: float("nan") if optimum is None else positive(optimum, "optimum"),
            lambda: flag(trace, "trace"),
        )
        try:
            start = self._method.start(load, self._checked_initial(initial), self._before(initial))
            self._previous = solution = self._method.run(load, start, known, trace)
        except InfeasibleWrenchError:
            limits = self.settings.limits
            if limits is None or not self.settings.elastic:
                raise
            if self._elastic is None:
                from grasp_env.force.program import ForceProgram

                self._elastic = ForceProgram(self.grasp, limits, elastic=True)
            record = self._elastic.least_excess(load)
            if record[CODE] != LIMITS_EXCEEDED:
                raise
            self._previous = solution = ForceSolution(record, self.method, "central")
        return solution

    def start(self, wrench: ArrayLike, *, initial: Initial | None = None) -> ContactForces:
        """The initial force (N, 3) [N] that `solve` would start from.

        Args:
            wrench: (6,) external wrench [N, N m].
            initial: a start for this call only.

        Raises:
            UnsupportedProblemError: the method starts from its own centre.
        """
        start = None
        if self._method.takes_start:
            start = self._method.start(as_wrench(wrench), self._checked_initial(initial), self._before(initial))
        if start is None:
            raise UnsupportedProblemError(f"method {self.method!r} takes no initial force")
        return start.force

    def _checked_initial(self, initial: Initial | None) -> Any:
        """The start of a call: its own where it has one; "previous" for a solution."""
        initial = self._initial if initial is None else checked_initial(initial)
        return "previous" if is_a(initial, ForceSolution) else initial

    def _before(self, initial: Initial | None) -> ForceSolution | None:
        return initial if is_a(initial, ForceSolution) else self._previous

    def _set_grasp(self, grasp: Grasp, settings: Settings) -> None:
        # everything that may refuse the grasp first: an optimizer is never half moved
        method = make_method(grasp, settings)
        self.settings, self._grasp, self._method, self._size = settings, grasp, method, record_size(grasp.n_contacts)
        self._elastic: ForceProgram | None = None  # made where it is needed
        self._loop, self._name = method.loop(self._initial), self.settings.method

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_method", "_loop", "_elastic")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._set_grasp(self._grasp, self.settings)  # compiled solvers are made anew


def checked_initial(initial: Any) -> Any:
    """A start as `optimize_force` takes it, names as plain text.

    Raises:
        UnknownNameError, InvalidInputError: it is none.
    """
    named = as_text(initial)
    if named is not None:
        hint = "; a learned start is an object: policies.LearnedInitialForce.pretrained()" if "learn" in named else ""
        return choice(named, "initial-force rule", (*RULES, "previous"), hint)
    given = initial is None or is_a(initial, ForceSolution | np.ndarray | list | tuple)
    if not given and (is_a(initial, type) or not callable(initial)):
        raise InvalidInputError(
            f"initial must be a rule's name, a rule(grasp, wrench), an (N, 3) force or a ForceSolution, got {shown(initial)}"
        )
    return initial


def _tolerance(given: float | None, method: str) -> float:
    if given is None:
        return CONIC_TOLERANCE if as_text(method) == "conic" else TOLERANCE
    return positive(given, "tolerance", ranges.TOLERANCE)


def optimize_force(
    grasp: Grasp,
    wrench: ArrayLike,
    *,
    initial: Initial | None = None,
    method: str = "reduced_flow",
    criterion: str = "sum",
    limits: ForceLimits | None = None,
    force_weight: Weight = 1.0,
    barrier_weight: Weight = 0.01,
    tolerance: float | None = None,
    max_iterations: int = MAX_ITERATIONS,
    step_rule: StepRule | None = None,
    optimum: float | None = None,
    trace: bool = False,
    elastic: bool = False,
) -> ForceSolution:
    """The grasp force of least Phi that balances a wrench: by default the paper's method.

    Args:
        grasp: the contacts.
        wrench: (6,) external wrench ON the object, force [N] and moment about the object origin [N m], object
            frame; balanced as G f + wrench = 0.
        initial: "linear_combination" (the paper; the default), "linear_combination_printed", "single_value",
            "lagrange", "phase_one" (the default without force closure, or by torsion alone), any callable
            rule(grasp, wrench) -> (N, 3), an (N, 3) force, or a previous `ForceSolution` to carry over. Not for
            `conic` and `linear`, which start from their own centre.
        method: "reduced_flow" (the paper's flow on 3N numbers), "full_flow" (dense, N <= 8), "newton" (Phi, a dozen
            steps), "conic" (exact: no Phi, least normal forces), "linear" (friction pyramids, for comparison).
        criterion: of `conic`: "sum" or "max" of the normal forces.
        limits: on normal forces and joint torques, for `newton`, `conic` and `linear`.
        force_weight: omega, the price of squeezing, 1e-4 to 1e4; one for all contacts or one each.
        barrier_weight: lambda, the price of closeness to a cone [N^2 at omega = 1], 1e-16 to 1e6; one or one each.
        tolerance: relative certified gap at which to stop, at most 1; None: 1e-4, for `conic` 1e-6.
        max_iterations: most accepted steps, 0 to 10,000,000.
        step_rule: the flows' `FixedStep`, `ArmijoStep`, `AdaptiveStep`, `BarzilaiBorweinStep` or `ExactStep`; None: `AdaptiveStep()`.
        optimum: see `ForceOptimizer.solve`.
        trace: see `ForceOptimizer.solve`.
        elastic: where no force keeps the limits, return the balanced one inside the cones whose largest excess, as a part of the
            limit, is least (within 1 % of the least possible, or 1e-6), with status LIMITS_EXCEEDED, instead of an error. Its
            `limit_excess` is the objective, `lower_bound` what no force stays below.

    Raises:
        InvalidInputError: input of another type or shape, not finite, or out of range (`grasp_env/ranges.py`).
        UnknownNameError: unknown method, criterion or rule.
        UnsupportedProblemError: a method that does not know these contacts, limits or options.
        InfeasibleWrenchError: no force strictly inside the cones and limits balances the wrench; carries the proof.
        InfeasibleStartError: the rule has no balanced, strictly feasible force here.

    Example:
        >>> from grasp_env.grasp import presets
        >>> solution = optimize_force(presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> solution.status.name, round(solution.total_normal_force, 1)
        ('OPTIMAL', 9.4)
        >>> weak = ForceLimits(max_normal=2.0)
        >>> solution = optimize_force(presets.paper_cuboid(), solution.wrench, method="newton", limits=weak, elastic=True)
        >>> solution.status.name, round(solution.limit_excess, 1)
        ('LIMITS_EXCEEDED', 1.3)
    """
    optimizer = ForceOptimizer(
        grasp,
        initial=initial,
        method=method,
        criterion=criterion,
        limits=limits,
        force_weight=force_weight,
        barrier_weight=barrier_weight,
        tolerance=tolerance,
        max_iterations=max_iterations,
        step_rule=step_rule,
        elastic=elastic,
    )
    return optimizer.solve(wrench, optimum=optimum, trace=trace)
