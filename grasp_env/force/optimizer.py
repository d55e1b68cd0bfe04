"""`ForceOptimizer`, the control loop's form, and `optimize_force`, the same for one call."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import ContactForces, Wrench, as_array, as_wrench, positive
from grasp_env.errors import (
    InfeasibleStartError,
    InvalidInputError,
    UnknownNameError,
    UnsupportedProblemError,
)
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.descent_kernels import CONVERGED, STALLED
from grasp_env.force.feasibility import answer
from grasp_env.force.initial import RULES, CompiledRule, InitialForceRule, initial_rule
from grasp_env.force.limits import ForceLimits
from grasp_env.force.method import Settings, Start, infeasible_error
from grasp_env.force.methods import METHODS, Conic, Flow, Newton, make_method
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.program import CRITERIA, ForceProgram
from grasp_env.force.program_methods import ProgramNewton
from grasp_env.force.record import CODE, FORCE, record_size
from grasp_env.force.repair import CORRECTIONS, Correction, Repair, carry_over
from grasp_env.force.solution import ForceSolution
from grasp_env.force.step_size import StepRule, checked_rule
from grasp_env.grasp.grasp import Grasp, as_grasp

MAX_ITERATIONS = 20_000
TOLERANCE = 1e-4
"""Default relative gap of the descents on Phi."""
CONIC_TOLERANCE = 1e-6
"""Default relative gap of the conic problem."""
NAN = float("nan")

Initial = str | InitialForceRule | ForceSolution | np.ndarray
"""A rule's name, a rule, a solution to carry over, or an (N, 3) force to start from."""


class ForceOptimizer:
    """Optimises grasp forces again and again: holds the offline basis, the kernels' data and the previous solution.

    Kernels are compiled, or loaded from the disk cache, on construction. One optimizer belongs to one thread; several
    may run at once.

    Attributes:
        grasp: the contacts as they are now.
        previous: the last solution; set it to None to forget.

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
    ) -> None:
        """See `optimize_force` for the arguments.

        Args:
            correction: how `initial="previous"` restores balance, "tangent" or "pseudoinverse".
        """
        as_grasp(grasp)
        if method not in METHODS:
            raise UnknownNameError("method", method, METHODS)
        if criterion not in CRITERIA:
            raise UnknownNameError("criterion", criterion, CRITERIA)
        if not isinstance(max_iterations, int | np.integer) or isinstance(max_iterations, bool) or max_iterations < 0:
            raise InvalidInputError(f"max_iterations must be an integer >= 0, got {max_iterations!r}")
        if correction not in CORRECTIONS:
            raise UnknownNameError("correction", correction, CORRECTIONS)
        if not isinstance(limits, ForceLimits | None):
            raise InvalidInputError(f"limits must be a ForceLimits or None, got {limits!r}")
        if criterion != "sum" and method != "conic":
            raise UnsupportedProblemError(f"criterion {criterion!r} belongs to method 'conic', got method {method!r}")
        if tolerance is None:
            tolerance = CONIC_TOLERANCE if method == "conic" else TOLERANCE
        self.objective = Objective(force_weight, barrier_weight)
        self.settings = Settings(
            method,
            criterion,
            limits,
            self.objective,
            positive(tolerance, "tolerance"),
            int(max_iterations),
            checked_rule(step_rule),
            correction,
        )
        if initial is not None:
            _check_name(initial)
            if method in ("conic", "linear"):
                raise InvalidInputError(f"method {method!r} starts from its own centre, got initial={initial!r}")
        # a solution is where the first call starts; the next ones start from their own previous one
        self.previous: ForceSolution | None = initial if isinstance(initial, ForceSolution) else None
        self.initial: Initial | None = "previous" if isinstance(initial, ForceSolution) else initial
        self._rules: dict[str, InitialForceRule] = {}
        self._set_grasp(grasp)
        self._warm_up()

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
    def limit_labels(self) -> tuple[str, ...]:
        """What each entry of a solution's `limit_multipliers` belongs to."""
        program = getattr(self._method, "program", None)
        return program.labels if isinstance(program, ForceProgram) and self.method != "linear" else ()

    def move_to(self, grasp: Grasp) -> None:
        """The contacts moved: re-optimise the offline basis from the old one, keep the previous solution."""
        as_grasp(grasp)
        if self.grasp.n_contacts == grasp.n_contacts and self._uses_basis:
            # a grasp without force closure has no basis; rules that need one will say so
            with suppress(InfeasibleStartError):
                OfflineBasis.of(self.grasp, self.objective).moved_to(grasp)
        changed = self.grasp.n_contacts != grasp.n_contacts
        self._set_grasp(grasp)
        if changed:
            self.previous = None

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
        direct = self._direct
        if (
            direct != ""
            and initial is None
            and optimum is None
            and not trace
            and type(wrench) is np.ndarray
            and wrench.dtype is _FLOAT
            and wrench.shape == _SIX
            and wrench.flags.carray
        ):
            # the control loop's path: one compiled call, which checks that the numbers are finite
            method: Any = self._method
            if direct == "central":
                record = method.direct(wrench)
            elif direct == "rule":
                record, before = np.empty(self._size), self.previous if self._remembers else None
                if before is not None and len(before._record) != self._size:
                    before = None  # of another number of contacts
                direct = self._bound(wrench, _NO_FORCE if before is None else before._record[FORCE:], record)
                if direct:
                    self.previous = solution = ForceSolution(record, self.settings.method, direct)
                    return solution
                record = None
            else:
                before = self.previous if direct == "previous" else None
                direct = "previous" if before is not None else "linear_combination"
                record = method.direct(wrench, None if before is None else before._record)
            if record is not None and record[CODE] <= self._final:
                solution = ForceSolution(record, self.settings.method, direct)
                self.previous = solution
                return solution
        solution = self._solve(as_wrench(wrench), initial, optimum, trace)
        self.previous = solution
        return solution

    def start(self, wrench: ArrayLike, *, initial: Initial | None = None) -> ContactForces:
        """The initial force (N, 3) [N] that `solve` would start from.

        Raises:
            UnsupportedProblemError: the method starts from its own centre.
        """
        start = self._start(as_wrench(wrench), self.initial if initial is None else initial)
        if start is None and isinstance(self._method, ProgramNewton):
            start = self._method.deepest(as_wrench(wrench))
        if start is None:
            raise UnsupportedProblemError(f"method {self.method!r} takes no initial force")
        return start.force

    def _solve(self, wrench: Wrench, initial: Initial | None, optimum: float | None, trace: bool) -> ForceSolution:
        known = NAN if optimum is None else positive(optimum, "optimum")
        if not self._method.needs_start and initial is not None:
            raise InvalidInputError(f"method {self.method!r} starts from its own centre, got initial={initial!r}")
        start = self._start(wrench, self.initial if initial is None else initial)
        return self._method.run(wrench, start, known, trace)

    def _start(self, wrench: Wrench, initial: Initial | None) -> Start | None:
        if not self._method.needs_start:
            return None
        if isinstance(initial, np.ndarray | list | tuple):
            return self._given("given", initial)
        previous = initial if isinstance(initial, ForceSolution) else self.previous
        name = "previous" if isinstance(initial, ForceSolution) else initial
        if name is not None:
            _check_name(name)
        if name == "previous" and previous is None:
            name = None  # nothing to carry over yet
        if isinstance(self._method, ProgramNewton):
            return self._program_start(self._method, wrench, name, previous)
        if name is None:
            name = "linear_combination"  # the paper's start
        try:
            if name == "previous":
                assert previous is not None
                if previous.n_contacts != self.grasp.n_contacts:
                    raise InfeasibleStartError(
                        f"the previous solution has {previous.n_contacts} contacts, the grasp {self.grasp.n_contacts}"
                    )
                correction = self.settings.correction
                return Start("previous", carry_over(self.grasp, wrench, previous.force, self.objective, correction))
            if isinstance(name, str):
                return Start(name, self._rule(name)(self.grasp, wrench))
            if isinstance(name, CompiledRule):
                return self._given(*name.start(self.grasp, wrench, self.objective, previous))
            force = name(self.grasp, wrench)
            if getattr(name, "objective", self.objective) != self.objective:
                # made for another Phi, in which its guarantees hold: give them in this one
                force = Repair(self.objective)(self.grasp, wrench, force)
            return self._given(getattr(name, "name", None) or getattr(name, "__name__", type(name).__name__), force)
        except InfeasibleStartError as error:
            found = answer(ForceProgram(self.grasp), wrench)
            if found.certificate is not None:
                raise infeasible_error(self.grasp, wrench, self.method, str(name), found.certificate) from error
            raise

    def _program_start(
        self, method: ProgramNewton, wrench: Wrench, name: str | InitialForceRule | None, previous: ForceSolution | None
    ) -> Start | None:
        if name is None or name == "phase_one":
            return None
        if name == "previous":
            assert previous is not None
            return method.carried(wrench, previous)
        if not isinstance(name, str):
            return self._given(getattr(name, "__name__", type(name).__name__), name(self.grasp, wrench))
        raise UnsupportedProblemError(
            f"initial={name!r} knows hard contacts without further limits; use 'phase_one' or 'previous', or leave it out"
        )

    def _given(self, name: str, force: ArrayLike) -> Start:
        try:
            return Start(name, as_array(force, (self.grasp.n_contacts, 3), "initial force"))
        except InvalidInputError as error:
            raise InfeasibleStartError(f"initial-force rule {name!r}: {error}") from None

    def _rule(self, name: str) -> InitialForceRule:
        if name not in self._rules:
            self._rules[name] = initial_rule(name, self.objective)
        return self._rules[name]

    @property
    def _uses_basis(self) -> bool:
        return self._method.needs_start and not isinstance(self._method, ProgramNewton)

    def _set_grasp(self, grasp: Grasp) -> None:
        # everything that may refuse the grasp first: an optimizer is never half moved
        method = make_method(grasp, self.settings, getattr(self, "_method", None))
        # which of the compiled calls `solve` may take without looking further; "" for none
        direct = ""
        if isinstance(method, Conic):
            direct = "central"
        elif isinstance(method, Newton | Flow) and method.has_basis and self.settings.correction == "tangent":
            initial = self.initial if isinstance(self.initial, str) else "linear_combination" * (self.initial is None)
            direct = initial if initial in ("linear_combination", "previous") else ""
            if isinstance(self.initial, CompiledRule):
                # contacts that the rule does not know are refused by the general path, in words
                with suppress(InfeasibleStartError):
                    self._bound = self.initial.bind(grasp, self.objective, self.settings.tolerance, method.descend)
                    self._remembers, direct = self.initial.remembers, "rule"
        self.grasp, self._method, self._direct, self._size = grasp, method, direct, record_size(grasp.n_contacts)
        # a flow that ended short would end so again
        self._final = STALLED if isinstance(method, Flow) else CONVERGED

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_bound"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._set_grasp(self.grasp)  # a bound rule is a closure: made anew

    def _warm_up(self) -> None:
        """Compiles, or loads, the kernels of the control loop's path before the first call that counts."""
        method: Any = self._method
        if self._direct == "central":
            method.direct(np.zeros(6))
        elif self._direct == "rule":
            record = np.empty(self._size)
            self._bound(np.zeros(6), _NO_FORCE, record)
            count = 3 * self.grasp.n_contacts
            method.descend(record[FORCE + count : FORCE + 2 * count].copy(), np.zeros(6), record)
        elif self._direct:
            method.direct(np.zeros(6), None)


_FLOAT, _SIX = np.dtype(np.float64), (6,)
_NO_FORCE = np.empty(0)


def _check_name(initial: object) -> None:
    allowed = (*RULES, "previous")
    if isinstance(initial, str) and initial not in allowed:
        hint = "; a learned start is an object: policies.LearnedInitialForce.pretrained()" if "learn" in initial else ""
        raise UnknownNameError("initial-force rule", initial, allowed, hint)
    if not (isinstance(initial, str | ForceSolution | np.ndarray | list | tuple) or callable(initial)):
        raise InvalidInputError(
            f"initial must be a rule's name, a rule(grasp, wrench), an (N, 3) force or a ForceSolution, got {initial!r}"
        )


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
) -> ForceSolution:
    """The grasp force of least Phi that balances a wrench: by default the paper's method.

    Args:
        grasp: the contacts.
        wrench: (6,) external wrench ON the object, force [N] and moment about the object origin [N m], object
            frame; balanced as G f + wrench = 0.
        initial: "linear_combination" (the paper; the default), "linear_combination_printed", "single_value",
            "lagrange", "phase_one" (the default with soft contacts or further limits), any callable
            rule(grasp, wrench) -> (N, 3), an (N, 3) force, or a previous `ForceSolution` to carry over. Not for
            `conic` and `linear`, which start from their own centre.
        method: "reduced_flow" (the paper's flow on 3N numbers), "full_flow" (dense, N <= 8), "newton" (Phi, a dozen
            steps), "conic" (exact: no Phi, least normal forces), "linear" (friction pyramids, for comparison).
        criterion: of `conic`: "sum" or "max" of the normal forces.
        limits: on normal forces and joint torques, for `newton`, `conic` and `linear`.
        force_weight: omega, the price of squeezing; one for all contacts or one each.
        barrier_weight: lambda, the price of closeness to a cone [N^2 at omega = 1]; one or one each.
        tolerance: relative certified gap at which to stop; None: 1e-4, for `conic` 1e-6.
        max_iterations: most accepted steps.
        step_rule: the flows' `FixedStep`, `ArmijoStep`, `AdaptiveStep`, `BarzilaiBorweinStep` or `ExactStep`; None: `AdaptiveStep()`.
        optimum: see `ForceOptimizer.solve`.
        trace: see `ForceOptimizer.solve`.

    Raises:
        InvalidInputError: non-finite or wrongly shaped input.
        UnknownNameError: unknown method, criterion or rule.
        UnsupportedProblemError: a method that does not know these contacts, limits or options.
        InfeasibleWrenchError: no force strictly inside the cones and limits balances the wrench; carries the proof.
        InfeasibleStartError: the rule has no balanced, strictly feasible force here.

    Example:
        >>> from grasp_env.grasp import presets
        >>> solution = optimize_force(presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> solution.status.name, round(solution.total_normal_force, 1)
        ('OPTIMAL', 9.4)
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
    )
    return optimizer.solve(wrench, optimum=optimum, trace=trace)
