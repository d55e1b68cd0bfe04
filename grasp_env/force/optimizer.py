"""`ForceOptimizer`, the control loop's form, and `optimize_force`, the same for one call."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import Array, ContactForces, Wrench, as_array, as_wrench, positive
from grasp_env.errors import (
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    UnknownNameError,
)
from grasp_env.force import descent_kernels
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.feasibility import phase_one
from grasp_env.force.initial import RULES, InitialForceRule, initial_rule
from grasp_env.force.kernels import cone_slack, phi, worst_residual
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.oracle import full_flow
from grasp_env.force.reduced_flow import reduced_projector
from grasp_env.force.repair import CORRECTIONS, Correction, Repair, carry_over
from grasp_env.force.solution import ForceSolution, Status
from grasp_env.force.step_size import AdaptiveStep
from grasp_env.grasp.grasp import Grasp

METHODS = ("reduced_flow", "full_flow", "newton")
MAX_ITERATIONS = 20_000
BALANCE_TOLERANCE = 1e-8
"""A start may miss balance by this much of the wrench and force it carries; the rest is an error of the rule."""

Initial = str | InitialForceRule | ForceSolution | np.ndarray
"""A rule's name, a rule, a solution to carry over, or an (N, 3) force to start from."""
_STATUS = (Status.OPTIMAL, Status.ITERATION_LIMIT, Status.STALLED)


class ForceOptimizer:
    """Optimises grasp forces again and again: holds the offline basis, Q_bar and the previous solution.

    Example:
        >>> from grasp_env.grasp import presets
        >>> optimizer = ForceOptimizer(presets.paper_cuboid(), initial="previous")
        >>> first = optimizer.solve([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> again = optimizer.solve([1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> first.status.name, again.iterations
        ('OPTIMAL', 0)
    """

    def __init__(
        self,
        grasp: Grasp,
        *,
        initial: Initial = "linear_combination",
        method: str = "reduced_flow",
        force_weight: Weight = 1.0,
        barrier_weight: Weight = 0.01,
        tolerance: float = 1e-4,
        max_iterations: int = MAX_ITERATIONS,
        step_rule: AdaptiveStep | None = None,
        correction: Correction = "tangent",
    ) -> None:
        """See `optimize_force` for the arguments.

        Args:
            correction: how `initial="previous"` restores balance, "tangent" or "pseudoinverse".
        """
        if method not in METHODS:
            raise UnknownNameError("method", method, METHODS)
        if not isinstance(max_iterations, int | np.integer) or isinstance(max_iterations, bool) or max_iterations < 0:
            raise InvalidInputError(f"max_iterations must be an integer >= 0, got {max_iterations!r}")
        if not isinstance(step_rule, AdaptiveStep | None):
            raise InvalidInputError(f"step_rule must be an AdaptiveStep or None, got {step_rule!r}")
        if correction not in CORRECTIONS:
            raise UnknownNameError("correction", correction, CORRECTIONS)
        self.objective = Objective(force_weight, barrier_weight)
        self.method = method
        self.tolerance = positive(tolerance, "tolerance")
        self.max_iterations = int(max_iterations)
        self.step_rule = step_rule or AdaptiveStep()
        self.correction: Correction = correction
        _check_name(initial)
        # a solution is where the first call starts; the next ones start from their own previous one
        self.previous: ForceSolution | None = initial if isinstance(initial, ForceSolution) else None
        self.initial: Initial = "previous" if isinstance(initial, ForceSolution) else initial
        self._rules: dict[str, InitialForceRule] = {}
        self.grasp = grasp
        self._set_grasp(grasp)

    def move_to(self, grasp: Grasp) -> None:
        """The contacts moved: re-optimise the offline basis from the old one, keep the previous solution."""
        if self.grasp.n_contacts == grasp.n_contacts:
            # a grasp without force closure has no basis; rules that need one will say so
            with suppress(InfeasibleStartError):
                OfflineBasis.of(self.grasp, self.objective).moved_to(grasp)
        else:
            self.previous = None
        self._set_grasp(grasp)

    def solve(
        self,
        wrench: ArrayLike,
        *,
        initial: Initial | None = None,
        optimum: float | None = None,
        trace: bool = False,
    ) -> ForceSolution:
        """The grasp force that minimises Phi and balances `wrench`; see `optimize_force`.

        Args:
            wrench: (6,) external wrench on the object [N, N m], object frame.
            initial: a start for this call only.
            optimum: a known min Phi: stop at the relative gap to it instead of the certified one (for studies).
            trace: keep Phi of every iterate in `objective_trace`.
        """
        wrench = as_wrench(wrench)
        name, start = self._start(wrench, self.initial if initial is None else initial)
        x = self._checked_start(start, wrench, name)
        known = float("nan") if optimum is None else positive(optimum, "optimum")
        solution = self._descend(x, wrench, name, known, trace)
        self.previous = solution
        return solution

    def start(self, wrench: ArrayLike, *, initial: Initial | None = None) -> ContactForces:
        """The initial force (N, 3) [N] that `solve` would start from."""
        return self._start(as_wrench(wrench), self.initial if initial is None else initial)[1]

    def _start(self, wrench: Wrench, initial: Initial) -> tuple[str, ContactForces]:
        if isinstance(initial, np.ndarray | list | tuple):
            return "given", np.asarray(initial)
        previous = initial if isinstance(initial, ForceSolution) else self.previous
        name = "previous" if isinstance(initial, ForceSolution) else initial
        _check_name(name)
        if name == "previous" and previous is None:
            name = "linear_combination"  # nothing to carry over yet: the paper's start
        try:
            if name == "previous":
                assert previous is not None
                if previous.force.shape[0] != self.grasp.n_contacts:
                    raise InfeasibleStartError(
                        f"the previous solution has {previous.force.shape[0]} contacts, the grasp {self.grasp.n_contacts}"
                    )
                return "previous", carry_over(self.grasp, wrench, previous.force, self.objective, self.correction)
            if isinstance(name, str):
                return name, self._rule(name)(self.grasp, wrench)
            force = name(self.grasp, wrench)
            if getattr(name, "objective", self.objective) != self.objective:
                # made for another Phi, in which its guarantees hold: give them in this one
                force = Repair(self.objective)(self.grasp, wrench, force)
            return getattr(name, "name", None) or getattr(name, "__name__", type(name).__name__), force
        except InfeasibleStartError as error:
            self._raise_if_infeasible(wrench, error)
            raise

    def _rule(self, name: str) -> InitialForceRule:
        if name not in self._rules:
            self._rules[name] = initial_rule(name, self.objective)
        return self._rules[name]

    def _descend(self, x: Array, wrench: Wrench, name: str, optimum: float, trace: bool) -> ForceSolution:
        first = x.copy()
        record = np.full(self.max_iterations + 1 if trace else 0, np.nan)
        if self.method == "full_flow":
            code, iterations, trials, value, bound = full_flow(
                self.grasp,
                self.objective,
                x,
                wrench,
                self.step_rule,
                self.tolerance,
                optimum,
                self.max_iterations,
                record,
            )
        elif self.method == "newton":
            code, iterations, trials, value, bound = descent_kernels.newton(
                x, self._matrix, wrench, self._weights, self.tolerance, optimum, self.max_iterations, record
            )
        else:
            rule = self.step_rule
            code, iterations, trials, value, bound = descent_kernels.reduced_flow(
                x,
                self._projector,
                self._matrix,
                wrench,
                self._weights,
                rule.first,
                rule.grow,
                rule.shrink,
                self.tolerance,
                optimum,
                self.max_iterations,
                record,
            )
        force = self.grasp.to_force(x)
        return ForceSolution(
            force=force,
            status=_STATUS[code],
            iterations=iterations,
            trials=trials,
            objective=value,
            lower_bound=bound,
            equilibrium_residual=worst_residual(x, self._matrix, wrench, self.grasp.length, self._work),
            cone_margin=cone_slack(x),
            wrench=wrench,
            initial_force=self.grasp.to_force(first),
            method=self.method,
            initial=name,
            objective_trace=record[: iterations + 1],
        )

    def _checked_start(self, start: ContactForces, wrench: Wrench, name: str) -> Array:
        """Cone coordinates of a start that is finite, balanced and strictly inside, or an error that names the rule."""
        try:
            force = as_array(start, (self.grasp.n_contacts, 3), "initial force")
        except InvalidInputError as error:
            raise InfeasibleStartError(f"initial-force rule {name!r}: {error}") from None
        x = self.grasp.to_cone(force)
        residual = worst_residual(x, self._matrix, wrench, self.grasp.length, self._work)
        # w itself is the residual of no force
        scale = float(np.abs(force).max()) + worst_residual(
            0.0 * x, self._matrix, wrench, self.grasp.length, self._work
        )
        if residual > BALANCE_TOLERANCE * scale:
            raise InfeasibleStartError(
                f"initial-force rule {name!r} misses balance by {residual:.3g} N (G f + w = 0, w the wrench ON the object); "
                "add -G^+ (G f + w), or pass it through grasp_env.force.Repair"
            )
        if not phi(x, self._weights) < np.inf:
            raise InfeasibleStartError(
                f"initial-force rule {name!r} leaves the friction cones (margin {self.grasp.cone_margin(force):.3g} N); "
                "pass it through grasp_env.force.Repair"
            )
        return x

    def _raise_if_infeasible(self, wrench: Wrench, cause: Exception) -> None:
        answer = phase_one(self.grasp, wrench)
        if answer.feasible:
            return
        nothing = np.zeros((self.grasp.n_contacts, 3))
        solution = ForceSolution(
            nothing, Status.INFEASIBLE, 0, 0, float("inf"), float("inf"), self.grasp.residual(nothing, wrench), 0.0,
            wrench, nothing, self.method, str(self.initial), certificate=answer.certificate,
        )  # fmt: skip
        raise InfeasibleWrenchError(
            f"no force strictly inside the friction cones balances wrench {wrench.tolist()}; the twist "
            f"{None if answer.certificate is None else np.round(answer.certificate, 6).tolist()} separates it "
            "(error.solution.certificate): add contacts, raise the friction, or change the wrench",
            solution,
        ) from cause

    def _set_grasp(self, grasp: Grasp) -> None:
        self.grasp = grasp
        self._matrix = grasp.cone_matrix.copy()
        self._weights = self.objective.weights(grasp.n_contacts)
        self._work = np.empty(6)
        self._projector = reduced_projector(grasp)


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
    initial: Initial = "linear_combination",
    method: str = "reduced_flow",
    force_weight: Weight = 1.0,
    barrier_weight: Weight = 0.01,
    tolerance: float = 1e-4,
    max_iterations: int = MAX_ITERATIONS,
    step_rule: AdaptiveStep | None = None,
    optimum: float | None = None,
    trace: bool = False,
) -> ForceSolution:
    """The grasp force of least Phi that balances a wrench: by default the paper's method.

    Args:
        grasp: the contacts.
        wrench: (6,) external wrench ON the object, force [N] and moment about the object origin [N m], object
            frame; balanced as G f + wrench = 0.
        initial: "linear_combination" (the paper), "linear_combination_printed", "single_value", "lagrange",
            "phase_one", any callable rule(grasp, wrench) -> (N, 3), an (N, 3) force, or a previous `ForceSolution`
            to carry over.
        method: "reduced_flow" (the paper's 3N x 9N flow), "full_flow" (dense, N <= 8), "newton".
        force_weight: omega, the price of squeezing; one for all contacts or one each.
        barrier_weight: lambda, the price of closeness to a cone [N^2 at omega = 1]; one or one each.
        tolerance: relative certified gap of Phi at which to stop.
        max_iterations: most accepted steps.
        step_rule: the flows' step rule; None: `AdaptiveStep()`.
        optimum: see `ForceOptimizer.solve`.
        trace: see `ForceOptimizer.solve`.

    Raises:
        InvalidInputError: non-finite or wrongly shaped input.
        UnknownNameError: unknown method or rule.
        InfeasibleWrenchError: no force strictly inside the cones balances the wrench.
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
        force_weight=force_weight,
        barrier_weight=barrier_weight,
        tolerance=tolerance,
        max_iterations=max_iterations,
        step_rule=step_rule,
    )
    return optimizer.solve(wrench, optimum=optimum, trace=trace)
