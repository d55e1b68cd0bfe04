"""`ForceOptimizer`, for call after call, and `optimize_force`, the same for one call."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core, ranges
from grasp_env._check import (
    Array,
    ContactForces,
    Wrench,
    as_array,
    as_list,
    as_wrench,
    flag,
    instance,
    positive,
    together,
)
from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    NotConvergedError,
    RankDeficientGraspError,
    UnsupportedProblemError,
    shown,
)
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.initial import (
    Initial,
    LearnedRule,
    StartFrom,
    call_rule,
    checked_initial,
    is_rule,
    rule_name,
    rule_start,
)
from grasp_env.force.limits import ForceLimits, LimitNumbers, as_limits, checked_jacobian
from grasp_env.force.many import ForceSolutions, checked_batch, solve_many
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.options import MAX_ITERATIONS, Options, checked_options
from grasp_env.force.proof import tell
from grasp_env.force.record import CODE, FORCE, INFEASIBLE, LIMIT, REFUSED, REPLACED, START, UNDECIDED
from grasp_env.force.solution import COMBINATION, GIVEN, LEARNED, PREVIOUS, STARTS, ForceSolution, start_name
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.advice import warn_of
from grasp_env.grasp.grasp import Grasp, as_grasp

BALANCE_TOLERANCE = 1e-8
"""A start may miss balance by this much of the wrench and force it carries; the rest is an error of the rule."""
FROM_BASIS = ("linear_combination", "linear_combination_printed", "single_value", "lagrange")
"""Starts that the 12-basis makes."""


class ForceOptimizer:
    """Optimises grasp forces again and again, on the contacts it was made for and on others.

    What a call is given (positions, normals, friction, Jacobian, torques, which contacts touch) holds for that call alone: nothing but
    the previous solution, and that only where `initial="previous"` asks for it, is kept between calls. One optimizer belongs to one
    thread; several may run at once. It is the C++ class `grasp::ForceOptimizer`; what Python adds is words.

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
        force_weight: Weight = 1.0,
        barrier_weight: Weight = 0.01,
        tolerance: float | None = None,
        max_iterations: int = MAX_ITERATIONS,
        step_rule: StepRule | None = None,
        elastic: bool = False,
    ) -> None:
        """Prepares the method for the contacts.

        Args:
            grasp: the contacts; `solve` may be given others, `update` replaces them.
            initial: where every call starts, as in `optimize_force`; or "previous": where the last one ended.
            method, criterion, limits, force_weight, barrier_weight, tolerance, max_iterations, step_rule, elastic: see `optimize_force`.
        """
        asked = (method, criterion, force_weight, barrier_weight, tolerance, max_iterations, step_rule, elastic)
        try:
            self.options, self._grasp = checked_options(*asked), as_grasp(grasp)
            self.limits = limits if limits is None else as_limits(limits)
            self._initial = initial if initial is None else checked_initial(initial)
        except GraspError:
            together(  # all that is wrong
                lambda: checked_options(*asked),
                lambda: as_grasp(grasp),
                lambda: as_limits(limits),
                lambda: checked_initial(initial),
            )
            raise
        if elastic and limits is None:
            raise InvalidInputError("elastic=True says what to do with limits that no force keeps: give limits")
        if initial is not None and self.options.method == "conic":
            raise InvalidInputError(f"method 'conic' starts from its own centre, got initial={shown(initial)}")
        self._make()
        warn_of(grasp, None, self.limits)
        if isinstance(self._initial, ForceSolution):
            self.previous, self._initial = self._fitting(self._initial), "previous"

    def _make(self) -> None:
        """Makes the compiled optimizer."""
        grasp, options, initial = self.grasp, self.options, self._initial
        start, model, remembers = 0, None, False
        self.names = names, asked = names_of(initial, options)
        if initial is None:
            pass
        elif isinstance(initial, ForceSolution):
            start, remembers = PREVIOUS, True
        elif isinstance(initial, str):
            start, remembers = STARTS.index(initial), initial == "previous"
        elif is_rule(initial, LearnedRule):
            start, remembers = LEARNED, bool(initial.remembers)
            try:
                model = call_rule(initial, initial.model, grasp, options.objective)
                instance(model, core.Model, f"what initial-force rule {rule_name(initial)!r} predicts with")
            except InfeasibleStartError as error:
                if error.__cause__ is not None:  # a fault of the rule's
                    raise
                # else contacts that it does not know: without a model the core replaces the start, and `initial` names both
        self.compiled, self.remembers = initial is None or start > 0, remembers
        weights: Any = options.objective
        plain = type(weights.force_weight) is float and type(weights.barrier_weight) is float
        limits: LimitNumbers = (
            (None, None, None, None, None) if self.limits is None else self.limits.given(grasp.n_contacts)
        )
        weighed = None if plain else weights.weights(grasp.n_contacts)
        try:
            self.core: Any = core.ForceOptimizer.make(
                grasp.contacts, weighed, weights.force_weight if plain else 1.0,
                weights.barrier_weight if plain else 1.0, *limits, options.method, options.criterion == "max", start,
                options.tolerance, options.max_iterations, options.elastic,
                options.step_rule.parameters() if options.flows else None, model, ForceSolution, options.method, names, asked,
                remembers,
            )  # fmt: skip
        except ValueError as error:
            raise UnsupportedProblemError(f"{error}; got method {options.method!r}") from None
        self._solve, self._count = self.core.solve, grasp.n_contacts
        if isinstance(initial, str) and initial in FROM_BASIS:
            OfflineBasis.of(grasp, options.objective)  # says what is wrong where there is none

    def __repr__(self) -> str:
        start = "its own start" if self._initial is None else rule_name(self._initial)
        return f"ForceOptimizer({self._count} contacts, {self.method} from {start})"

    @property
    def grasp(self) -> Grasp:
        """The contacts it was made for, or last updated to."""
        return self._grasp

    @property
    def initial(self) -> Initial | None:
        """The start of every call that has none of its own."""
        return self._initial

    @property
    def method(self) -> str:
        """The method's name."""
        return self.options.method

    @property
    def objective(self) -> Objective:
        """Phi."""
        return self.options.objective

    @property
    def tolerance(self) -> float:
        """Relative certified gap at which a solve stops."""
        return self.options.tolerance

    @property
    def max_iterations(self) -> int:
        """Most accepted steps."""
        return self.options.max_iterations

    @property
    def step_rule(self) -> StepRule:
        """The flows' step rule."""
        return self.options.step_rule

    @property
    def previous(self) -> ForceSolution | None:
        """The last solution, where `initial="previous"` starts; None: forgotten, or none yet."""
        return self.core.previous

    @previous.setter
    def previous(self, solution: ForceSolution | None) -> None:
        self.core.previous = instance(solution, ForceSolution, "previous", or_none=True)

    def forget(self) -> None:
        """The next call does not know the calls before it."""
        self.core.previous = None

    @property
    def limit_labels(self) -> tuple[str, ...]:
        """What each entry of a solution's `limit_multipliers` belongs to."""
        return () if self.limits is None else self.limits.labels(self._count)

    def solve(
        self,
        wrench: ArrayLike,
        *,
        positions: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
        torque_bias: ArrayLike | None = None,
        contacts: ArrayLike | None = None,
        initial: Initial | None = None,
        optimum: float | None = None,
        trace: bool = False,
    ) -> ForceSolution:
        """The optimal grasp force that balances `wrench`; see `optimize_force`.

        What is left out is as the optimizer was made with. All of it is given in one frame, that of the constructor's positions or
        any other. C-contiguous float64 arrays are read as they are.

        Args:
            wrench: (6,) external wrench on the object [N, N m].
            positions: (N, 3) contact points of this call [m].
            normals: (N, 3) inward unit normals of this call.
            friction: coefficient(s) of this call, as in `Grasp.from_contacts`.
            jacobian: (N, 3, J) or (N, 6, J) of this call, as in `ForceLimits`; the optimizer must have torque limits.
            torque_bias: (J,) of this call [N m].
            contacts: (N,) which contacts touch; the force of the others is zero. None: all. At most 64 contacts.
            initial: a start for this call only.
            optimum: a known min Phi: stop at the relative gap to it instead of the certified one (for studies).
            trace: keep Phi of every iterate in `objective_trace`.

        Raises:
            InvalidInputError: wrong shapes, numbers that are not finite or not possible.
            RankDeficientGraspError: the contacts that touch cannot balance a wrench of every direction.
            InfeasibleWrenchError, InfeasibleStartError, NotConvergedError: see `optimize_force`.
        """
        if initial is None and optimum is None and trace is False and self.compiled:
            solution = self._solve(wrench, positions, normals, friction, jacobian, torque_bias, contacts)
            if solution is not None:
                return solution
            row = self.core.ended
            if row is not None and row[CODE] == INFEASIBLE:
                raise self._infeasible(row, (positions, normals, friction, jacobian, torque_bias, contacts))
        now = (positions, normals, friction, jacobian, torque_bias, contacts)
        return self._solve_checked(wrench, now, initial, optimum, trace)

    def _solve_checked(
        self, wrench: ArrayLike, given: tuple[Any, ...], initial: Initial | None, optimum: float | None, trace: bool
    ) -> ForceSolution:
        """The general way of `solve`: arguments are converted, rules asked, and outcomes without a force said in words."""
        load, known, _, now = together(
            lambda: as_wrench(wrench),
            lambda: float("nan") if optimum is None else positive(optimum, "optimum"),
            lambda: flag(trace, "trace"),
            lambda: self._now(*given),
        )
        if self.method == "conic" and (initial is not None or known == known or trace):
            raise InvalidInputError("method 'conic' takes no start, optimum or trace: they belong to descents on Phi")
        if self.limits is None and (now[3] is not None or now[4] is not None):
            raise InvalidInputError("jacobian and torque_bias belong to torque limits: make the optimizer with limits")
        start = self._start(load, now, initial)
        values = np.full(self.max_iterations + 1, np.nan) if trace else None
        solution = self.core.solve_from(start.start, start.name, start.force, start.before, known, values, load, *now)
        if solution is None:
            raise self._error(self.core.ended, load, now, start)
        if values is not None:
            solution.objective_trace = values[: solution.iterations + 1]
        if start.replaced:
            solution._record[START], solution._record[REPLACED] = COMBINATION, 1.0
            solution.initial = start_name(STARTS[COMBINATION], str(start.name), True, False)
        return solution

    def start(
        self,
        wrench: ArrayLike,
        *,
        positions: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        contacts: ArrayLike | None = None,
        initial: Initial | None = None,
    ) -> ContactForces:
        """The initial force (N, 3) [N] that `solve` would start from.

        Args:
            wrench: (6,) external wrench [N, N m].
            positions, normals, friction, contacts: of this call, see `solve`.
            initial: a start for this call only.

        Raises:
            UnsupportedProblemError: the method starts from its own centre.
            InvalidInputError, RankDeficientGraspError: see `solve`.
            InfeasibleWrenchError, InfeasibleStartError: see `optimize_force`.
        """
        now = {"positions": positions, "normals": normals, "friction": friction, "contacts": contacts}
        return self._begin(wrench, initial=initial, **now)[0]

    def _begin(
        self, wrench: ArrayLike, *, initial: Initial | None = None, **given: ArrayLike | None
    ) -> tuple[ContactForces, bool]:
        """`start`, and whether another start took the place of the one that was asked for."""
        if self.method == "conic":
            raise UnsupportedProblemError("method 'conic' takes no initial force")
        load, now = as_wrench(wrench), self._now(**given)
        start = self._start(load, now, initial)
        row = self.core.start(start.start, start.force, start.before, load, *now)
        if row[CODE] != LIMIT:
            raise self._error(row, load, now, start)
        n = self._count
        return row[FORCE + 3 * n : FORCE + 6 * n].reshape(n, 3), start.replaced or bool(row[REPLACED])

    def solve_many(self, wrenches: ArrayLike, *, workers: int | None = None) -> ForceSolutions:
        """The forces for many wrenches, none of which knows the others: `optimize_forces` of this optimizer.

        Args:
            wrenches: (M, 6) external wrenches on the object [N, N m].
            workers: threads; None: one per core.

        Raises:
            InvalidInputError: see `optimize_forces`; a wrench that nothing balances has the status INFEASIBLE instead of raising.
        """
        return solve_many(self, *checked_batch(wrenches, workers))

    def update(
        self,
        *,
        positions: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        jacobian: ArrayLike | None = None,
        torque_bias: ArrayLike | None = None,
    ) -> None:
        """Replaces what the optimizer was made with; what is left out stays. The 12-basis, where a start needs it, is made anew.

        Args:
            positions, normals, friction, jacobian, torque_bias: see `solve`.

        Raises:
            InvalidInputError, RankDeficientGraspError: see `solve`; the optimizer stays as it was.
        """
        now = self._now(positions, normals, friction, jacobian, torque_bias)
        moved = self._moved(now) if any(each is not None for each in now[:3]) else self.grasp
        if not self.core.update(*now[:5]):
            raise InvalidInputError(
                "the contacts or limits are not possible: give finite numbers and inward unit normals"
            )
        self._grasp = moved
        if self.limits is not None:
            given = {
                name: each.copy() for name, each in (("jacobian", now[3]), ("torque_bias", now[4])) if each is not None
            }
            self.limits = replace(self.limits, **given)

    def _now(
        self,
        positions: Any = None,
        normals: Any = None,
        friction: Any = None,
        jacobian: Any = None,
        torque_bias: Any = None,
        contacts: Any = None,
    ) -> tuple[Any, ...]:
        """The checked arrays of a call, in the order of the core's arguments."""
        n, joints = self._count, 0 if self.limits is None else self.limits.joints

        def made(value: Any, shape: tuple[int | None, ...], name: str, within: Any = None) -> Any:
            return None if value is None else np.ascontiguousarray(as_array(value, shape, name, within, copy=False))

        def moving() -> Any:
            if jacobian is None:
                return None
            rows = checked_jacobian(jacobian, n)
            if rows.shape[2] != joints:
                raise InvalidInputError(f"jacobian must be that of {joints} joints, got shape {rows.shape}")
            return np.ascontiguousarray(rows)

        def touching() -> Any:
            if contacts is None:
                return None
            each = as_list(contacts)
            mask = np.asarray(contacts if each is None else each)
            if mask.shape != (n,) or mask.dtype != np.bool_ or n > 64:
                raise InvalidInputError(
                    f"contacts must be ({n},) of true and false, of at most 64 contacts, got {shown(contacts)}"
                )
            return np.ascontiguousarray(mask)

        return tuple(
            together(
                lambda: made(positions, (n, 3), "positions"),
                lambda: made(normals, (n, 3), "normals"),
                lambda: None if friction is None else self.grasp.models.other_friction(friction),
                moving,
                lambda: made(torque_bias, (joints,), "torque_bias", ranges.BIAS),
                touching,
            )
        )

    def _moved(self, now: tuple[Any, ...]) -> Grasp:
        """The contacts of a call that touch.

        Raises:
            InvalidInputError, RankDeficientGraspError: there is no such grasp.
        """
        grasp, (positions, normals, friction, _, _, mask) = self.grasp, now
        chosen = slice(None) if mask is None else mask
        models, tangents = grasp.models, grasp.contacts.tangents
        gamma = models.torsional_friction[chosen]
        return Grasp.from_contacts(
            (grasp.positions if positions is None else positions)[chosen],
            (grasp.normals if normals is None else normals)[chosen],
            (models.friction if friction is None else friction)[chosen],
            contact_model=[name for k, name in enumerate(models.names) if mask is None or mask[k]],
            torsional_friction=gamma if gamma.any() else None,
            tangents=tangents[chosen] if len(tangents) else None,
        )

    def _start(self, wrench: Wrench, now: tuple[Any, ...], initial: Initial | None) -> StartFrom:
        """The start of a call.

        Raises:
            InfeasibleStartError: a rule fails, or returns no force.
        """
        asked: Any = self._initial if initial is None else checked_initial(initial)
        if asked is None or self.method == "conic":
            return StartFrom(0)
        if isinstance(asked, ForceSolution):
            return StartFrom(PREVIOUS, before=self._fitting(asked))
        if isinstance(asked, str):
            if initial is not None and asked in FROM_BASIS:
                self.core.set_basis(OfflineBasis.of(self.grasp, self.options.objective).cone_forces)
            return StartFrom(STARTS.index(asked), before=self.previous if asked == "previous" else None)
        if initial is None and is_rule(asked, LearnedRule):
            return StartFrom(0, before=self.previous if asked.remembers else None)
        moved = self.grasp if all(each is None for each in now) else self._moved(now)
        start = rule_start(asked, moved, wrench, self.options.objective)
        if now[5] is None or now[5].all():
            return start
        force = np.zeros((self._count, 3))
        force[now[5]] = start.force
        return StartFrom(start.start, start.name, start.replaced, force)

    def _fitting(self, previous: ForceSolution) -> ForceSolution:
        """A solution to start from, if it is of as many contacts."""
        if previous.n_contacts != self._count:
            raise InfeasibleStartError(
                f"the previous solution has {previous.n_contacts} contacts, the grasp {self._count}"
            )
        return previous

    def _infeasible(self, row: Array, now: tuple[Any, ...], start: str | None = None) -> InfeasibleWrenchError:
        solution = ForceSolution(row, self.method, start or STARTS[int(row[START])])
        return InfeasibleWrenchError("", solution, lambda: self._proof(solution, now))

    def _proof(self, solution: ForceSolution, given: tuple[Any, ...]) -> str:
        """Why there is no force, in words."""
        limits, moved = self.limits, self.grasp
        if any(each is not None for each in given):
            try:
                now = self._now(*given)
                if now[5] is not None and not now[5].all():
                    return tell(solution, None, limits)
                moved = self._moved(now)
            except GraspError:  # the caller's arrays hold other numbers by now
                return tell(solution, None, limits)
            changed = {
                name: value for name, value in (("jacobian", now[3]), ("torque_bias", now[4])) if value is not None
            }
            limits = replace(limits, **changed) if limits is not None and changed else limits
        return tell(solution, moved, limits)

    def _error(self, row: Array, wrench: Wrench, now: tuple[Any, ...], start: StartFrom) -> GraspError:
        """What a row without a force means, in words."""
        code = row[CODE]
        if code == INFEASIBLE:
            return self._infeasible(row, now, start.name)
        if code == UNDECIDED:
            return NotConvergedError(
                f"neither a force nor a proof that there is none was found for wrench {wrench.tolist()}: forces, limits and weights are too "
                "many decades apart, or the contacts are within rounding of losing force closure"
            )
        try:
            moved = self._moved(now)
        except GraspError as error:
            return error
        if code == REFUSED and start.force is not None:
            return refused_start(moved, wrench, start, now[5])
        return RankDeficientGraspError(
            f"rank(G) < 6 with {moved.n_contacts} contacts: some wrenches cannot be balanced. Use at least three contacts with friction "
            "that do not lie on one line, or two soft ones"
        )

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name not in ("core", "_solve")}
        return kept | {"_grasp": self.grasp, "previous": self.previous}

    def __setstate__(self, state: dict[str, Any]) -> None:
        previous = state.pop("previous")
        vars(self).update(state)
        self._make()  # what is compiled is made anew
        self.previous = previous


def names_of(initial: Any, options: Options) -> tuple[tuple[str, ...], str]:
    """The names of starts in the solutions of an optimizer, in the order of `STARTS`, and the name of the one it asks for."""
    if options.method == "conic":
        return STARTS, "central"
    if initial is None:
        return STARTS, "linear_combination" if options.flows else "internal_force"
    if isinstance(initial, ForceSolution):
        return STARTS, "previous"
    asked = "given" if isinstance(initial, np.ndarray | list | tuple) else rule_name(initial)
    place = LEARNED if is_rule(initial, LearnedRule) else GIVEN
    return (STARTS if asked in STARTS else (*STARTS[:place], asked, *STARTS[place + 1 :])), asked


def refused_start(grasp: Grasp, wrench: Wrench, start: StartFrom, touching: Any) -> InfeasibleStartError:
    """Why a descent did not take a given force."""
    assert start.force is not None
    force = start.force if touching is None else start.force[touching]
    missed = grasp.residual(force, wrench)
    scale = float(np.abs(force).max()) + float(np.abs(grasp.unit_frame @ wrench).max())
    if missed > BALANCE_TOLERANCE * scale:
        return InfeasibleStartError(
            f"initial-force rule {start.name!r} misses balance by {missed:.3g} N (G f + w = 0, w the wrench ON the object); "
            "add -G^+ (G f + w), or pass it through grasp_env.force.Repair"
        )
    return InfeasibleStartError(
        f"initial-force rule {start.name!r} leaves the friction cones (margin {grasp.cone_margin(force):.3g} N); "
        "pass it through grasp_env.force.Repair"
    )


def optimize_force(
    grasp: Grasp, wrench: ArrayLike, *, optimum: float | None = None, trace: bool = False, **options: Any
) -> ForceSolution:
    """The grasp force of least Phi that balances a wrench, by Newton unless another method is asked for.

    Args:
        grasp: the contacts.
        wrench: (6,) external wrench ON the object, force [N] and moment about the object origin [N m], in the frame of the
            contacts' positions; balanced as G f + wrench = 0.
        optimum: a known min Phi: stop at the relative gap to it instead of the certified one (for studies).
        trace: keep Phi of every iterate in `objective_trace`.
        options: the keywords of `ForceOptimizer`:

            method: "newton" (Phi, about six steps), "reduced_flow" (the paper's flow on 3N numbers), "full_flow" (dense, N <= 8),
            "conic" (exact: no Phi, least normal forces).

            initial: "linear_combination" (the paper's, of the flows the default), "linear_combination_printed",
            "single_value", "lagrange", "phase_one", "internal_force" (of newton the default), any callable rule(grasp, wrench) ->
            (N, 3), an (N, 3) force, or a previous `ForceSolution`. Not for `conic`, which starts from its own centre. Contacts
            without force closure start from a force that phase one finds.

            criterion: of `conic`: "sum" or "max" of the normal forces.

            limits: a `ForceLimits` on normal forces and joint torques, for `newton` and `conic`.

            force_weight: omega, the price of squeezing, 1e-4 to 1e4; one for all contacts or one each.

            barrier_weight: lambda, the price of closeness to a cone [N^2 at omega = 1], 1e-16 to 1e6; one or one each.

            tolerance: relative certified gap at which to stop, at most 1; None: 1e-4, for `conic` 1e-6.

            max_iterations: most accepted steps, 0 to 10,000,000.

            step_rule: the flows' `FixedStep`, `ArmijoStep`, `AdaptiveStep`, `BarzilaiBorweinStep` or `ExactStep`; None:
            `AdaptiveStep()`.

            elastic: where no force keeps the limits, return the balanced one inside the cones whose largest excess, as a part of
            the limit, is least (within 1 % of the least possible, or 1e-6), with status LIMITS_EXCEEDED, instead of an error, if `max_iterations`
            allow. Its `limit_excess` is the objective, `lower_bound` what no force stays below.

    Raises:
        InvalidInputError: input of another type or shape, not finite, or out of range (`grasp_env/ranges.py`).
        UnknownNameError: unknown method, criterion or rule.
        UnsupportedProblemError: a method that does not know these contacts, limits or options.
        InfeasibleWrenchError: no force strictly inside the cones and limits balances the wrench; carries the proof.
        InfeasibleStartError: the rule has no balanced, strictly feasible force here.
        NotConvergedError: neither a force nor a proof was found.

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
        warn_of(grasp, error.solution.wrench, optimizer.limits)
        raise
    warn_of(grasp, solution.wrench, optimizer.limits)
    return solution


__all__ = ["ForceOptimizer", "optimize_force"]
