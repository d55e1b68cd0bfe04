"""The methods behind `optimize_force`: each is made for one grasp and turns wrench and start into a `ForceSolution`.

| method | problem | contacts |
|---|---|---|
| reduced_flow, full_flow | Phi by the paper's gradient flows | hard, elliptic, frictionless |
| newton | Phi by Newton | all, further limits |
| conic | least sum, or least maximum, of normal forces | all, further limits |
| linear | the same sum over friction pyramids, by HiGHS | all, further limits |
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.errors import InfeasibleStartError, UnsupportedProblemError
from grasp_env.force import conic_kernels, newton_kernels
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.descent_kernels import BALANCE_TOLERANCE
from grasp_env.force.feasibility import answer
from grasp_env.force.flow import FORMS
from grasp_env.force.flow import Flow as GradientFlow
from grasp_env.force.flow_record import run_flow, solve_flow
from grasp_env.force.kernels import cone_slack, phi, worst_residual
from grasp_env.force.lanes import KNOWN, options, pack
from grasp_env.force.method import Method, Settings, Start, refuse
from grasp_env.force.newton_kernels import BASIS, TANGENT
from grasp_env.force.program import ForceProgram
from grasp_env.force.program_methods import Linear, ProgramConic, ProgramNewton
from grasp_env.force.record import (
    FORCE,
    ITERATIONS,
    record_size,
)
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp

DESCENTS = ("reduced_flow", "full_flow", "newton")
"""Methods on Phi: they take a start, a known optimum and a trace."""
METHODS = (*DESCENTS, "conic", "linear")
DEEP = 0.05
"""Part of its largest u by which a projected internal force must lie inside the cones to serve again."""
_INTERNAL: WeakKeyDictionary[Grasp, Array | None] = WeakKeyDictionary()
_NO_TRACE = np.empty(0)
_NO_FORCE = np.empty(0)
_NO_BASIS = np.empty((0, 0))


def make_method(grasp: Grasp, settings: Settings, before: Method | None = None) -> Method:
    """The method of `settings` for a grasp; `before` is the method on a nearby grasp, whose preparations may serve again.

    Raises:
        UnsupportedProblemError: the method does not know these contacts or limits.
    """
    general = not grasp.hard or settings.limits is not None
    if settings.method == "linear":
        return Linear(grasp, settings)
    if settings.method == "conic":
        near = before.interior if isinstance(before, Conic) else None
        interior = None if general or settings.criterion == "max" else internal_force(grasp, near)
        return ProgramConic(grasp, settings) if interior is None else Conic(grasp, settings, interior)
    if settings.method == "newton":
        return ProgramNewton(grasp, settings) if general else Newton(grasp, settings)
    if general:
        raise UnsupportedProblemError(
            f"method {settings.method!r} knows hard contacts (round, elliptic or frictionless) without further limits; "
            "use method='newton' or 'conic'"
        )
    return Flow(grasp, settings)


def internal_force(grasp: Grasp, near: Array | None = None) -> Array | None:
    """(3N,) an internal force strictly inside the cones, cone coordinates [N]; None without force closure.

    `near` is one of a nearby grasp: where it stays deep enough, projecting it saves the search. Remembered as long as `grasp`
    lives, so that going back to a grasp gives the same bits.
    """
    if grasp in _INTERNAL:
        return _INTERNAL[grasp]
    if near is not None and len(near) == 3 * grasp.n_contacts:
        inverse = grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]
        x = near - inverse @ (grasp.cone_matrix @ near)
        if cone_slack(x) > DEEP * float(x[0::3].max()):
            _INTERNAL[grasp] = x
            return x
    found = answer(ForceProgram(grasp), np.zeros(6))
    _INTERNAL[grasp] = None if found.force is None else grasp.to_cone(found.force)
    return _INTERNAL[grasp]


class _Checked:
    """A start that is finite, balanced and strictly inside the cones, or an error that names the rule."""

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        self.matrix = grasp.cone_matrix.copy()
        self.weights = settings.objective.weights(grasp.n_contacts)
        self._work = np.empty(6)

    def cone(self, start: Start, wrench: Wrench) -> Array:
        """Cone coordinates (3N,) of a start."""
        name, force = start.name, start.force
        x = self.grasp.to_cone(force)
        residual = worst_residual(x, self.matrix, wrench, self.grasp.length, self._work)
        # w itself is the residual of no force
        scale = float(np.abs(force).max()) + worst_residual(0.0 * x, self.matrix, wrench, self.grasp.length, self._work)
        if residual > BALANCE_TOLERANCE * scale:
            raise InfeasibleStartError(
                f"initial-force rule {name!r} misses balance by {residual:.3g} N (G f + w = 0, w the wrench ON the object); "
                "add -G^+ (G f + w), or pass it through grasp_env.force.Repair"
            )
        if not phi(x, self.weights) < np.inf:
            raise InfeasibleStartError(
                f"initial-force rule {name!r} leaves the friction cones (margin {self.grasp.cone_margin(force):.3g} N); "
                "pass it through grasp_env.force.Repair"
            )
        return x


class Flow:
    """The paper's flows, compiled: `reduced_flow` in its fastest form, `full_flow` dense."""

    needs_start = True

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        self.has_basis = True  # until one is asked for and there is none
        self._checked = _Checked(grasp, settings)
        flow = GradientFlow(grasp, "full" if settings.method == "full_flow" else None)
        self._form = (flow.constants, FORMS.index(flow.form), *flow.matrices)
        self._contacts = (self._checked.matrix, grasp.models.cone_divisor.copy(), self._checked.weights)
        self._rule = settings.step_rule.parameters()
        self._options = options(grasp, settings.tolerance, settings.max_iterations)
        self._size = record_size(grasp.n_contacts)
        self._basis: tuple[Array, Array] | None = None

    def descend(self, start: Array, wrench: Wrench, record: Array) -> None:
        """From a force (3N,) [N] into a record."""
        run_flow(*self._form, start, *self._contacts, wrench, self._rule, self._options, record, _NO_TRACE)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        assert start is not None
        self._checked.cone(start, wrench)
        force = np.array(start.force, dtype=np.float64).reshape(-1)
        values = np.full(self.settings.max_iterations + 1, np.nan) if trace else _NO_TRACE
        record, numbers = np.empty(self._size), self._options.copy()
        numbers[KNOWN] = optimum
        run_flow(*self._form, force, *self._contacts, wrench, self._rule, numbers, record, values)
        return ForceSolution(record, self.settings.method, start.name, values[: int(record[ITERATIONS]) + 1])

    def direct(self, wrench: Wrench, previous: Array | None) -> Array | None:
        """The record from the 12-basis, or from a previous record's force; None where there is no basis, or another N there."""
        if previous is not None and len(previous) != self._size:
            return None
        if self._basis is None:
            if not self.has_basis:
                return None
            try:
                basis = OfflineBasis.of(self.grasp, self.settings.objective).cone_forces
            except InfeasibleStartError:
                self.has_basis = False  # rules that need one say so
                return None
            self._basis = basis, self.grasp.pseudoinverse * self.grasp.models.cone_scale.reshape(-1)[:, None]
        record = np.empty(self._size)
        kind, start = (BASIS, _NO_FORCE) if previous is None else (TANGENT, previous[FORCE:])
        solve_flow(*self._form, kind, start, *self._basis, *self._contacts, wrench, self._rule, self._options, record)
        return record


class Newton:
    """Newton on Phi, hard contacts: the compiled fast path. Starts from the 12-basis and the previous solution inside."""

    needs_start = True

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        self._checked = _Checked(grasp, settings)
        self.weights = self._checked.weights
        self._size = record_size(grasp.n_contacts)
        self.options = options(grasp, settings.tolerance, settings.max_iterations)
        try:
            self.basis = OfflineBasis.of(grasp, settings.objective).cone_forces
            self.has_basis = True
        except InfeasibleStartError:
            self.basis, self.has_basis = _NO_BASIS, False  # rules that need one say so
        rest = self.basis[12] if self.has_basis else np.zeros(3 * grasp.n_contacts)
        self.constants = pack(grasp, rest, self.weights)

    def descend(self, start: Array, wrench: Wrench, record: Array) -> None:
        """From a force (3N,) [N] into a record."""
        newton_kernels.newton(
            self.constants, self.basis, newton_kernels.GIVEN, start, wrench, self.weights, self.options, record, _NO_TRACE
        )  # fmt: skip

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        assert start is not None
        self._checked.cone(start, wrench)
        values = np.full(self.settings.max_iterations + 1, np.nan) if trace else _NO_TRACE
        numbers = self.options
        if optimum == optimum:
            numbers = numbers.copy()
            numbers[KNOWN] = optimum
        record = np.empty(self._size)
        newton_kernels.newton(
            self.constants, self.basis, newton_kernels.GIVEN, np.array(start.force, dtype=np.float64).reshape(-1),
            wrench, self.weights, numbers, record, values,
        )  # fmt: skip
        return ForceSolution(
            record, "newton", start.name, values[: int(record[ITERATIONS]) + 1] if trace else _NO_TRACE
        )

    def direct(self, wrench: Wrench, previous: Array | None) -> Array | None:
        """The record from the 12-basis, or from a previous record's force; None where that has another N."""
        if previous is not None and len(previous) != self._size:
            return None
        record = np.empty(self._size)
        if previous is None:
            newton_kernels.newton(
                self.constants, self.basis, BASIS, _NO_FORCE, wrench, self.weights,
                self.options, record, _NO_TRACE,
            )  # fmt: skip
        else:
            newton_kernels.newton(
                self.constants, self.basis, TANGENT, previous[FORCE:], wrench, self.weights,
                self.options, record, _NO_TRACE,
            )  # fmt: skip
        return record


class Conic:
    """Least sum of normal forces, hard contacts with force closure: the compiled fast path, feasible throughout."""

    needs_start = False

    def __init__(self, grasp: Grasp, settings: Settings, interior: Array) -> None:
        self._size = record_size(grasp.n_contacts)
        self.options = options(grasp, settings.tolerance, min(settings.max_iterations, 100))
        self.interior = interior
        self.constants = pack(grasp, interior, np.ones((grasp.n_contacts, 2)))

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        refuse("conic", start, optimum, trace)
        return ForceSolution(self.direct(wrench), "conic", "central")

    def direct(self, wrench: Wrench) -> Array:
        """The record; nothing but the compiled call."""
        record = np.empty(self._size)
        conic_kernels.conic(self.constants, wrench, self.options, record)
        return record
