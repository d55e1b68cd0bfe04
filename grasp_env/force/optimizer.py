"""`ForceOptimizer`, for repeated calls, and `optimize_force`, for a single call.

The file is long because the class documents every argument and shares the state of a call.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    NotConvergedError,
    UnsupportedProblemError,
    shown,
)
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.call import Call, checked_call, touching_grasp
from grasp_env.force.initial import (
    OWN_START,
    CompiledRule,
    Initial,
    StartRequest,
    call_rule,
    checked_initial,
    names_of,
    refused_start,
    rule_name,
    rule_start,
)
from grasp_env.force.limits import ForceLimits, as_limits, core_limits
from grasp_env.force.many import ForceSolutions, checked_batch, solve_many
from grasp_env.force.margin import (
    Margin,
    ShiftedProblem,
    as_margin,
    check_preload,
    nearest_margin,
)
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.options import MAX_ITERATIONS, checked_options
from grasp_env.force.proof import explain
from grasp_env.force.record import INFEASIBLE, REFUSED, STARTED, UNDECIDED
from grasp_env.force.solution import LEARNED, PREVIOUS, STARTS, ForceSolution
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.advice import warn_of_contacts, warn_of_wrench
from grasp_env.grasp.checks import rank_error
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs.arguments import (
    AllFaults,
    ContactForces,
    Wrench,
    as_wrench,
    flag,
    instance,
    positive,
)

FROM_BASIS = ("linear_combination", "linear_combination_printed", "single_value", "lagrange")
"""Starts that need the 12-basis."""


class ForceOptimizer:
    """Solver for repeated calls, on the contacts of the constructor or on others.

    The arguments of a call hold for that call only. Only the last solution is kept between calls.
    It is a start only with `initial="previous"`, or with a learned rule whose `remembers` is True
    and whose prediction has a larger Phi. Use each optimizer in one thread; several may run at
    once. The class wraps the C++ class `grasp::ForceOptimizer`.

    Args:
        grasp: the contacts; `update` replaces them.
        method: "newton" minimises Phi in about six steps. "full_flow" is the gradient flow exactly
            as the paper prints it, on dense matrices, for N <= 8. "reduced_flow" is the same flow
            on the 3N force components only, which is much cheaper. "conic" minimises the weighted
            normal forces, without Phi.
        initial: the start of every call: a name, any callable rule(grasp, wrench) -> (N, 3), a
            force (N, 3) [N], or a `ForceSolution`. With a solution, only the first call starts from
            it, later calls from the last solution. The names are "linear_combination" (the paper's
            start, the default of the flows), "linear_combination_printed", "single_value",
            "lagrange", "phase_one", "internal_force" (the default of newton) and "previous" (the
            last solution). "conic" takes no start. If the contacts of a call have no force closure,
            the named start may not exist; "phase_one" then replaces it.
        criterion: what "conic" minimises: the "sum" or the "max" of the normal forces, each times
            its `force_weight`, or "torque", the norm of the joint torques of `limits` [N m],
            torque_bias included, without force_weight. Joints without a limit have
            torque_limit=inf. Where rounding leaves multipliers outside a dual cone, the bound of
            "torque" holds for normal forces of up to 1e4 times those of the solution.
        limits: a `ForceLimits` on normal forces and joint torques, for "newton" and "conic".
        margin: how far forces stay inside the friction cones, a `Margin` or its share of friction;
            None: up to the cones. The optimum lies close to the margin, so an error of friction or
            of the wrench that the margin does not cover lets the object slip.
        force_weight, barrier_weight: the weights of `Objective`. A barrier of None is 0.01;
            "conic" has none.
        tolerance: relative certified gap at which to stop, at most 1. None: 1e-4, or 1e-6 for
            "conic".
        max_iterations: largest number of accepted steps, 0 to 10,000,000.
        step_rule: the step rule of the flows: `FixedStep`, `ArmijoStep`, `AdaptiveStep`,
            `BarzilaiBorweinStep` or `ExactStep`. None: `AdaptiveStep()`.
        elastic: if no force satisfies the limits, return a force with status LIMITS_EXCEEDED
            instead of raising an error. Of the balanced forces inside the cones it is the one whose
            largest excess / limit is smallest, to 1 % or 1e-6, whichever is larger;
            `max_iterations` does not count its steps. The solution's `objective` is this excess,
            and `lower_bound` bounds it.

    Raises:
        InvalidInputError: input of another type or shape, not finite, or out of range
            (`grasp_env/inputs/ranges.py`).
        UnknownNameError: unknown method, criterion or rule.
        UnsupportedProblemError: a method that does not support these contacts, limits or options.
        RankDeficientGraspError: a flow, and contacts of rank below 6.
        InfeasibleStartError: the start needs the 12-basis, which these contacts do not have, or a
            learned rule fails.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
        >>> optimizer = ForceOptimizer(grasp, initial="previous")
        >>> first = optimizer.solve(wrench)
        >>> again = optimizer.solve(wrench, positions=grasp.positions + 1e-4)      # the tips have rolled a little
        >>> first.status.name, again.status.name, again.iterations < first.iterations
        ('OPTIMAL', 'OPTIMAL', True)
        >>> three = optimizer.solve(wrench, contacts=[True, True, True, False])    # the fourth finger has let go
        >>> three.force[3].tolist()
        [0.0, 0.0, 0.0]
        >>> exact = ForceOptimizer(grasp, method="conic").solve(wrench)
        >>> round(exact.objective, 4), exact.optimality_gap < 1e-6
        (8.5847, True)
    """

    def __init__(
        self,
        grasp: Grasp,
        *,
        method: str = "newton",
        initial: Initial | None = None,
        criterion: str = "sum",
        limits: ForceLimits | None = None,
        margin: Margin | float | None = None,
        force_weight: Weight = 1.0,
        barrier_weight: Weight | None = None,
        tolerance: float | None = None,
        max_iterations: int = MAX_ITERATIONS,
        step_rule: StepRule | None = None,
        elastic: bool = False,
    ) -> None:
        settings = (
            method,
            criterion,
            force_weight,
            barrier_weight,
            tolerance,
            max_iterations,
            step_rule,
            elastic,
        )
        with AllFaults() as check:
            self.options, self._grasp = check(checked_options, *settings), check(as_grasp, grasp)
            self.limits = limits if limits is None else check(as_limits, limits)
            self._margin = check(as_margin, margin)
            self._initial = initial if initial is None else check(checked_initial, initial)
        if elastic and limits is None:
            raise InvalidInputError(
                "elastic=True is for limits that no force satisfies: give limits"
            )
        if initial is not None and self.options.method == "conic":
            raise InvalidInputError(
                f"method 'conic' starts from its own centre, got initial={shown(initial)}"
            )
        check_preload(self._margin, self.limits, grasp.n_contacts)
        self._make()
        warn_of_contacts(grasp, self.limits)
        if isinstance(self._initial, ForceSolution):
            self.previous, self._initial = self._initial, "previous"

    def _make(self) -> None:
        grasp = self.grasp
        options = self.options
        initial = self._initial
        start, model, remembers = 0, None, False
        self.names = names_of(initial, options)
        if isinstance(initial, ForceSolution):
            start, remembers = PREVIOUS, True
        elif isinstance(initial, str):
            start = STARTS.index(initial)
            remembers = initial == "previous"
        elif initial is not None and isinstance(initial, CompiledRule):
            start = LEARNED
            remembers = bool(initial.remembers)
            try:
                model = call_rule(initial, initial.model, self._narrowed, options.objective)
                what = f"what initial-force rule {rule_name(initial)!r} predicts with"
                instance(model, core.Model, what)
            except InfeasibleStartError as error:
                if error.__cause__ is not None:  # the rule itself failed
                    raise
                # without a model for these contacts the core uses its default start
        # False for a user's rule or force, which `_start` evaluates in Python
        self.core_finds_start = initial is None or start > 0
        self.remembers = remembers
        if options.flows and grasp.rank < 6:
            raise self._rank_error(grasp)
        weights: Any = options.objective
        plain = type(weights.force_weight) is float and type(weights.barrier_weight) is float
        pair = weights.force_weight, weights.barrier_weight
        problem = core.Problem(
            grasp.contacts,
            pair if plain else weights.weights(grasp.n_contacts),
            core_limits(self.limits, grasp.n_contacts),
            self._margin if self._margin else None,
        )
        settings = core.Options(
            method=options.method,
            criterion=options.criterion,
            start=start,
            tolerance=options.tolerance,
            limit=options.max_iterations,
            elastic=options.elastic,
            step_rule=options.step_rule.parameters() if options.flows else None,
            model=model,
            remembers=remembers,
        )
        try:
            self.core: Any = core.ForceOptimizer(problem, settings, ForceSolution, self.names)
        except ValueError as error:
            raise UnsupportedProblemError(f"{error}; got method {options.method!r}") from None
        self._solve_call = self.core.solve_call
        self._count = grasp.n_contacts
        if isinstance(initial, str) and initial in FROM_BASIS:
            OfflineBasis.of(self._narrowed, options.objective)  # raises if the grasp has none

    def __repr__(self) -> str:
        start = "its own start" if self._initial is None else rule_name(self._initial)
        return f"ForceOptimizer({self._count} contacts, {self.method} from {start})"

    @property
    def grasp(self) -> Grasp:
        """The contacts."""
        return self._grasp

    @property
    def margin(self) -> Margin:
        """How far forces stay inside the friction cones."""
        return self._margin

    @cached_property
    def _narrowed(self) -> Grasp:
        """The contacts with the share of friction of the margin."""
        return self._margin.narrowed(self.grasp)

    @property
    def initial(self) -> Initial | None:
        """The start of calls that do not give their own `initial`."""
        return self._initial

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.options.method

    @property
    def objective(self) -> Objective:
        """The objective Phi."""
        return self.options.objective

    @property
    def tolerance(self) -> float:
        """Relative certified gap at which a solve ends."""
        return self.options.tolerance

    @property
    def max_iterations(self) -> int:
        """Largest number of accepted steps."""
        return self.options.max_iterations

    @property
    def step_rule(self) -> StepRule:
        """The step rule of the flows."""
        return self.options.step_rule

    @property
    def previous(self) -> ForceSolution | None:
        """The last solution, the start with `initial="previous"`; None before the first call."""
        return self.core.previous

    @previous.setter
    def previous(self, solution: ForceSolution | None) -> None:
        instance(solution, ForceSolution, "previous", or_none=True)
        if solution is None:
            self.forget()
        else:
            self.core.remember(self._checked_previous(solution))

    def forget(self) -> None:
        """Drop the previous solution."""
        self.core.forget()

    @property
    def limit_labels(self) -> tuple[str, ...]:
        """Descriptions of the entries of a solution's `limit_multipliers`."""
        return () if self.limits is None else self.limits.labels(self._count)

    def solve(  # arguments that Python takes by name alone would cost 15 ns each
        self,
        wrench: ArrayLike,
        positions: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
        torque_bias: ArrayLike | None = None,
        contacts: ArrayLike | None = None,
        margin: Margin | float | None = None,
        initial: Initial | None = None,
        optimum: float | None = None,
        trace: bool = False,
    ) -> ForceSolution:
        """Return the optimal grasp force that balances `wrench`.

        Arguments that are left out have the values of the constructor. Name those that you
        give. Give wrench, positions, normals and Jacobian in one frame. If you leave out positions,
        normals or Jacobian, this must be the constructor's frame. C-contiguous float64 arrays are
        read without a copy.

        Args:
            wrench: (6,) external wrench, as in `optimize_force`.
            positions: (N, 3) contact points [m].
            normals: (N, 3) inward unit normals.
            friction: coefficient(s), as in `Grasp.from_contacts`.
            jacobian: (N, 3, J) or (N, 6, J), as in `ForceLimits`; the optimizer must have torque
                limits.
            torque_bias: (J,) tau_0 [N m], as in `ForceLimits`.
            contacts: (N,) True for contacts that touch; the force of the others is zero. None: all
                touch. At most 64 contacts.
            margin: as for the constructor; `Margin()` is none.
            initial: a start for this call only.
            optimum: the optimal Phi, if known: the solve stops when Phi is within `tolerance`
                (relative) of it (for studies).
            trace: keep Phi of every iterate in `objective_trace`.

        Raises:
            InvalidInputError: wrong shapes, values that are not finite or out of range.
            InfeasibleWrenchError: no force strictly inside the cones, the margin and the limits
                balances the wrench; the error contains the proof. Two hard contacts, for example,
                do not balance a moment about the line through them.
            RankDeficientGraspError: no contact touches; or a flow, and contacts of rank below 6.
            InfeasibleStartError: the start is not balanced or not strictly inside the cones, or its
                rule fails.
            NotConvergedError: neither a force nor a proof was found.
        """
        arrays = (positions, normals, friction, jacobian, torque_bias, contacts, margin)
        if initial is None and optimum is None and trace is False and self.core_finds_start:
            solution = self._solve_call(wrench, arrays)
            if solution is NotImplemented:  # an argument cannot be read in place
                solution = self._solve_call(*self._checked(wrench, arrays))
            if solution:
                return solution
            start = OWN_START
        else:
            solution, start = self._solve_from(
                *self._checked(wrench, arrays), initial, optimum, trace
            )
            if solution:
                return solution
        raise self._error(solution, wrench, arrays, start)

    def _checked(self, wrench: ArrayLike, arrays: tuple[Any, ...]) -> tuple[Wrench, Call]:
        with AllFaults() as check:
            load = check(as_wrench, wrench)
            call = check(self._arrays, *arrays)
        if self.limits is None and (call.jacobian is not None or call.torque_bias is not None):
            raise InvalidInputError(
                "jacobian and torque_bias need torque limits: make the optimizer with limits"
            )
        check_preload(self._margin_of(call), self.limits, self._count, call.contacts)
        return load, call

    def _solve_from(
        self, load: Wrench, call: Call, initial: Initial | None, optimum: float | None, trace: bool
    ) -> tuple[ForceSolution, StartRequest]:
        """Solve from a start of this call, with `optimum` and `trace`; return the start, too."""
        with AllFaults() as check:
            known = float("nan") if optimum is None else check(positive, optimum, "optimum")
            check(flag, trace, "trace")
        if self.method == "conic" and (initial is not None or known == known or trace):
            raise InvalidInputError(
                "method 'conic' takes no start, optimum or trace: they belong to descents on Phi"
            )
        start = self._start(load, call, initial)
        values = np.full(self.max_iterations + 1, np.nan) if trace else None
        solution = self.core.solve(load, call, start.request(known, values))
        solution._names = self.names.of_start(start.start, start.name)
        if solution.has_force:
            start.mark(solution._record)
            self.core.remember(solution)  # with the names and the mark
        if values is not None:
            traced = values[: solution.iterations + 1]
            solution.objective_trace = traced[~np.isnan(traced)]
        return solution, start

    def start(
        self,
        wrench: ArrayLike,
        *,
        positions: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        contacts: ArrayLike | None = None,
        margin: Margin | float | None = None,
        initial: Initial | None = None,
    ) -> ContactForces:
        """Return the initial force (N, 3) [N] of `solve`.

        `solve` documents wrench, positions, normals, friction, contacts, margin, initial and the
        errors.

        Raises:
            UnsupportedProblemError: the method takes no initial force.
        """
        arrays = (positions, normals, friction, None, None, contacts, margin)
        return self._start_and_replaced(wrench, initial, *arrays)[0]

    def _start_and_replaced(
        self, wrench: ArrayLike, initial: Initial | None, *arrays: Any
    ) -> tuple[ContactForces, bool]:
        """Return `start`, and True if another start replaced the requested one."""
        if self.method == "conic":
            raise UnsupportedProblemError("method 'conic' takes no initial force")
        load, call = self._checked(wrench, arrays)
        start = self._start(load, call, initial)
        solution = self.core.start(load, call, start.request())
        if solution.code != STARTED:
            raise self._error(solution, load, call, start)
        return solution.initial_force.copy(), start.replaced or solution.start_replaced

    def solve_many(self, wrenches: ArrayLike, *, workers: int | None = None) -> ForceSolutions:
        """Solve for wrenches (M, 6) [N, N m], independently; `workers` as in `optimize_forces`."""
        return solve_many(self, *checked_batch(wrenches, workers))

    def update(
        self,
        *,
        positions: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
        torque_bias: ArrayLike | None = None,
        margin: Margin | float | None = None,
    ) -> None:
        """Replace arguments of the constructor; those left out stay.

        `solve` documents positions, normals, friction, jacobian, torque_bias and margin. The
        12-basis is computed again if the start needs it.

        Raises:
            InvalidInputError, RankDeficientGraspError: as in `solve`; the optimizer is unchanged.
        """
        call = self._arrays(positions, normals, friction, jacobian, torque_bias, None, margin)
        check_preload(self._margin_of(call), self.limits, self._count)
        moved = any(array is not None for array in call[:3])
        grasp = touching_grasp(self.grasp, call) if moved else self.grasp
        if self.options.flows and grasp.rank < 6:
            raise self._rank_error(grasp)
        if not self.core.update(call):
            raise InvalidInputError(
                "the contacts or limits are invalid: give finite numbers and inward unit normals"
            )
        self._grasp = grasp
        self.limits = self._limits_of(call)
        self._margin = self._margin_of(call)
        vars(self).pop("_narrowed", None)

    def _arrays(self, *arrays: Any) -> Call:
        jacobian: Any = None if self.limits is None else self.limits.jacobian
        motions = (0, 0) if jacobian is None else jacobian.shape[1:]
        return checked_call(self.grasp, motions, *arrays)

    def _limits_of(self, call: Call) -> ForceLimits | None:
        """Return the limits with the Jacobian and the torque bias of a call."""
        changes = {name: getattr(call, name) for name in ("jacobian", "torque_bias")}
        changes = {name: value.copy() for name, value in changes.items() if value is not None}
        return replace(self.limits, **changes) if self.limits and changes else self.limits

    def _margin_of(self, call: Call) -> Margin:
        return self._margin if call.margin is None else call.margin

    def _start(self, wrench: Wrench, call: Call, initial: Initial | None) -> StartRequest:
        requested: Any = self._initial if initial is None else checked_initial(initial)
        if requested is None or self.method == "conic":
            return OWN_START
        if isinstance(requested, ForceSolution):
            return StartRequest(PREVIOUS, before=self._checked_previous(requested))
        if isinstance(requested, str):
            if initial is not None and requested in FROM_BASIS:
                basis = OfflineBasis.of(self._narrowed, self.options.objective)
                self.core.set_basis(basis.cone_forces)
            return StartRequest(STARTS.index(requested))
        if initial is None and isinstance(requested, CompiledRule):
            return OWN_START
        start = rule_start(requested, self._shifted(wrench, call), self.options.objective)
        if call.contacts is None or call.contacts.all():
            return start
        force = np.zeros((self._count, 3))
        force[call.contacts] = start.force
        return StartRequest(start.start, start.name, start.replaced, force)

    def _shifted(self, wrench: Wrench, call: Call) -> ShiftedProblem:
        """Return the problem of a call without its margin, on the contacts that touch."""
        if all(array is None for array in call):
            grasp, margin = self._narrowed, self._margin
        else:
            margin = self._margin_of(call)
            grasp = margin.narrowed(touching_grasp(self.grasp, call))
        preload = margin.preloads(self._count)
        return ShiftedProblem.of(
            grasp, wrench, preload if call.contacts is None else preload[call.contacts]
        )

    def _checked_previous(self, previous: ForceSolution) -> ForceSolution:
        if not previous.has_force:
            raise InvalidInputError(
                f"previous must be a solution with a force, got status {previous.status.value}"
            )
        if previous.n_contacts != self._count:
            raise InfeasibleStartError(
                f"the previous solution has {previous.n_contacts} contacts, the grasp {self._count}"
            )
        return previous

    def _proof(self, solution: ForceSolution, arrays: tuple[Any, ...]) -> str:
        try:
            call = self._arrays(*arrays)
            problem = self._shifted(solution.wrench, call)
        except GraspError:  # the caller has overwritten the arrays
            return explain(solution, None, self.limits, np.zeros(self._count))
        proof = explain(solution, problem.grasp, self._limits_of(call), problem.preload)
        margin = self._margin_of(call)
        if not margin:
            return proof
        limits = core_limits(self.limits, self._count)
        contacts = core.Problem(self.grasp.contacts, None, limits)
        solver: Any = core.ForceOptimizer(contacts, core.Options(method="conic"), ForceSolution)

        def largest_share(other: Margin) -> float | None:
            found = solver.solve(solution.wrench, call._replace(margin=other))
            return float(np.nanmax(found.friction_used)) if found.has_force else None

        return f"{nearest_margin(margin, largest_share)}{proof}"

    def _error(
        self,
        solution: ForceSolution,
        wrench: ArrayLike,
        arrays: tuple[Any, ...],
        start: StartRequest,
    ) -> GraspError:
        code = solution.code
        if code == INFEASIBLE:
            return InfeasibleWrenchError("", solution, lambda: self._proof(solution, arrays))
        load, call = self._checked(wrench, arrays)  # raises if one of them is the reason
        if code == UNDECIDED:
            return NotConvergedError(
                f"neither a force nor a proof that none exists was found for wrench {load.tolist()}: forces, limits and weights are too "
                "many decades apart, or the contacts are within rounding of losing force closure",
                solution,
            )
        try:
            grasp = touching_grasp(self.grasp, call)
        except GraspError as error:
            return error
        if code == REFUSED and start.force is not None:
            return refused_start(self._shifted(load, call), start, call.contacts)
        if code == REFUSED:
            return InvalidInputError(
                f"the call has numbers that the solver cannot use, for wrench {load.tolist()} and {grasp}"
            )
        return self._rank_error(grasp)

    def _rank_error(self, grasp: Grasp) -> GraspError:
        hint = f"; method {self.method!r} needs that, 'newton' and 'conic' solve the wrenches that are within reach"
        return rank_error(grasp.rank, grasp.n_contacts, hint if self.options.flows else "")

    def __getstate__(self) -> dict[str, Any]:
        kept = {
            name: value for name, value in vars(self).items() if name not in ("core", "_solve_call")
        }
        return kept | {"_grasp": self.grasp, "previous": self.previous}

    def __setstate__(self, state: dict[str, Any]) -> None:
        previous = state.pop("previous")
        vars(self).update(state)
        self._make()
        self.previous = previous


def optimize_force(
    grasp: Grasp,
    wrench: ArrayLike,
    *,
    optimum: float | None = None,
    trace: bool = False,
    **options: Any,
) -> ForceSolution:
    """Return the optimal grasp force that balances a wrench: a `ForceOptimizer` for a single call.

    Args:
        grasp: the contacts.
        wrench: (6,) external wrench ON the object, force [N] and moment about the object origin
            [N m], in the frame of the contacts' positions; balanced as G f + wrench = 0.
        optimum, trace: see `ForceOptimizer.solve`.
        options: the keywords of `ForceOptimizer`, with its defaults.

    Raises:
        InvalidInputError, UnknownNameError, UnsupportedProblemError: see `ForceOptimizer`.
        InfeasibleWrenchError, InfeasibleStartError, NotConvergedError: see `ForceOptimizer.solve`.

    Example:
        >>> from grasp_env.grasp import presets
        >>> solution = optimize_force(presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0])
        >>> solution.status.name, round(solution.total_normal_force, 1)
        ('OPTIMAL', 9.4)
        >>> weak = ForceLimits(max_normal=2.0)
        >>> solution = optimize_force(presets.paper_cuboid(), solution.wrench, limits=weak, elastic=True)
        >>> solution.status.name, round(solution.limit_excess, 1)
        ('LIMITS_EXCEEDED', 1.3)
    """
    optimizer = ForceOptimizer(grasp, **options)
    try:
        solution = optimizer.solve(wrench, optimum=optimum, trace=trace)
    except InfeasibleWrenchError as error:
        warn_of_wrench(grasp, error.solution.wrench)
        raise
    warn_of_wrench(grasp, solution.wrench)
    return solution
