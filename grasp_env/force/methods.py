"""The methods behind `optimize_force`: each is made for one grasp and turns wrench and start into a `ForceSolution`.

| method | problem | contacts |
|---|---|---|
| reduced_flow, full_flow | Phi by the paper's gradient flows | hard, elliptic, frictionless |
| newton | Phi by Newton | all, further limits |
| conic | least sum, or least maximum, of normal forces | all, further limits |
| linear | the same sum over friction pyramids, by HiGHS | all, further limits |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError, InvalidInputError, UnsupportedProblemError
from grasp_env.force import conic_kernels, newton_kernels
from grasp_env.force.basis import OfflineBasis
from grasp_env.force.descent_kernels import CONVERGED, LIMIT, STALLED
from grasp_env.force.feasibility import Feasibility, answer
from grasp_env.force.flow import Flow as GradientFlow
from grasp_env.force.kernels import cone_slack, phi, worst_residual
from grasp_env.force.lanes import KNOWN, options, pack
from grasp_env.force.limits import ForceLimits
from grasp_env.force.linear import linear_forces
from grasp_env.force.objective import Objective
from grasp_env.force.program import Answer, ForceProgram
from grasp_env.force.record import (
    BOUND,
    CODE,
    FORCE,
    ITERATIONS,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    RESIDUAL,
    TRIALS,
    WRENCH,
    record_size,
)
from grasp_env.force.repair import Correction
from grasp_env.force.solution import ForceSolution, Status, infeasible
from grasp_env.force.step_size import StepRule
from grasp_env.grasp.grasp import Grasp

DESCENTS = ("reduced_flow", "full_flow", "newton")
"""Methods on Phi: they take a start, a known optimum and a trace."""
METHODS = (*DESCENTS, "conic", "linear")
BALANCE_TOLERANCE = 1e-8
"""A start may miss balance by this much of the wrench and force it carries; the rest is an error of the rule."""
DEEP = 0.05
"""Part of its largest u by which a projected internal force must lie inside the cones to serve again."""
_NO_TRACE = np.empty(0)
_NO_FORCE = np.empty(0)
_NO_BASIS = np.empty((0, 0))


@dataclass(frozen=True)
class Settings:
    """What every method may need; see `optimize_force`."""

    method: str
    criterion: str
    limits: ForceLimits | None
    objective: Objective
    tolerance: float
    max_iterations: int
    step_rule: StepRule
    correction: Correction


@dataclass(frozen=True)
class Start:
    """Where a descent begins: the rule's name and a force (N, 3) [N], with torsions (N,) [N m] where contacts are soft."""

    name: str
    force: ContactForces
    torsion: Array | None = None


class Method(Protocol):
    """One method on one grasp."""

    needs_start: bool
    """Whether `run` takes a start; the others have their own."""

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """Solves for a checked wrench (6,); `optimum` is a known minimum or nan, `trace` asks for Phi of every iterate."""
        ...


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

    `near` is one of a nearby grasp: where it stays deep enough, projecting it saves the search.
    """
    if near is not None and len(near) == 3 * grasp.n_contacts:
        inverse = grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]
        x = near - inverse @ (grasp.cone_matrix @ near)
        if cone_slack(x) > DEEP * float(x[0::3].max()):
            return x
    found = answer(ForceProgram(grasp), np.zeros(6))
    return None if found.force is None else grasp.to_cone(found.force)


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
        self._checked = _Checked(grasp, settings)
        self._flow = GradientFlow(grasp, "full" if settings.method == "full_flow" else None)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        assert start is not None
        grasp, settings = self.grasp, self.settings
        x = self._checked.cone(start, wrench)
        values = np.full(settings.max_iterations + 1 if trace else 0, np.nan)
        code, iterations, trials, value, bound = self._flow.run(
            self._checked.weights, x, wrench, settings.step_rule,
            tolerance=settings.tolerance, optimum=optimum, max_iterations=settings.max_iterations, trace=values,
        )  # fmt: skip
        record = np.zeros(record_size(grasp.n_contacts))
        record[CODE], record[ITERATIONS], record[TRIALS] = code, iterations, trials
        record[OBJECTIVE], record[BOUND], record[MARGIN] = value, bound, cone_slack(x)
        record[RESIDUAL] = grasp.residual(grasp.to_force(x), wrench)
        record[WRENCH : WRENCH + 6] = wrench
        size = 3 * grasp.n_contacts
        record[FORCE : FORCE + size] = grasp.to_force(x).reshape(-1)
        record[FORCE + size : FORCE + 2 * size] = np.asarray(start.force).reshape(-1)
        return ForceSolution(record, settings.method, start.name, values[: iterations + 1])


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

    def direct(self, wrench: Wrench, previous: Array | None) -> Array:
        """The record from the 12-basis, or from a previous record's force; nothing but the compiled call."""
        record = np.empty(self._size)
        if previous is None:
            newton_kernels.newton(
                self.constants, self.basis, newton_kernels.BASIS, _NO_FORCE, wrench, self.weights,
                self.options, record, _NO_TRACE,
            )  # fmt: skip
        else:
            newton_kernels.newton(
                self.constants, self.basis, newton_kernels.TANGENT, previous[FORCE:], wrench, self.weights,
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
        _refuse("conic", start, optimum, trace)
        return ForceSolution(self.direct(wrench), "conic", "central")

    def direct(self, wrench: Wrench) -> Array:
        """The record; nothing but the compiled call."""
        record = np.empty(self._size)
        conic_kernels.conic(self.constants, wrench, self.options, record)
        return record


class _Program:
    """Soft contacts, further limits, no force closure: what the methods on `ForceProgram` share."""

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        self.program = ForceProgram(grasp, settings.limits)

    def solution(self, found: Answer, wrench: Wrench, start: Array, name: str, trace: Array) -> ForceSolution:
        """The record of an answer; status OPTIMAL where its certified gap is within the tolerance."""
        program, count = self.program, self.grasp.n_contacts
        record = np.zeros(record_size(count))
        value = found.value
        gap = (value - found.bound) / found.bound if found.bound > 0.0 else (0.0 if value == 0.0 else np.inf)
        # a value clearly below its bound means a force that misses something
        proven = -1e-9 <= gap <= self.settings.tolerance and program.slack(found.z) >= 0.0
        record[CODE] = CONVERGED if proven else max(found.code, LIMIT if found.code == LIMIT else STALLED)
        record[ITERATIONS], record[TRIALS], record[OBJECTIVE], record[BOUND] = (
            found.iterations, found.trials, value, found.bound,
        )  # fmt: skip
        record[MARGIN], record[RESIDUAL] = program.slack(found.z), program.residual(found.z, wrench)
        record[WRENCH : WRENCH + 6], record[MULTIPLIERS : MULTIPLIERS + 6] = wrench, found.multipliers
        record[FORCE : FORCE + 3 * count] = program.force(found.z).reshape(-1)
        record[FORCE + 3 * count : FORCE + 6 * count] = program.force(start).reshape(-1)
        record[FORCE + 6 * count :] = program.torsion(found.z)
        return ForceSolution(record, self.settings.method, name, trace, limit_multipliers=found.limit_multipliers)

    def feasible(self, wrench: Wrench, name: str) -> Feasibility:
        """The deepest force.

        Raises:
            InfeasibleWrenchError: there is none.
        """
        found = answer(self.program, wrench)
        if found.certificate is not None:
            raise infeasible_error(self.grasp, wrench, self.settings.method, name, found.certificate)
        return found


class ProgramConic(_Program):
    """Least sum or least maximum of normal forces within all limits."""

    needs_start = False

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`.

        Raises:
            InfeasibleWrenchError: no force within the limits balances the wrench.
        """
        _refuse("conic", start, optimum, trace)
        settings = self.settings
        # a tenth: the certificate gives a little away when it makes its multipliers feasible
        found = self.program.least_force(
            wrench, settings.criterion, 0.1 * settings.tolerance, min(settings.max_iterations, 100)
        )
        if found.code != CONVERGED:
            deepest = self.feasible(wrench, "central")
            size = float(np.abs(self.program.frame @ wrench).max())
            usable = self.program.slack(found.z) >= 0.0 and self.program.residual(found.z, wrench) <= 1e-9 * size
            if not usable:  # nan is not
                assert deepest.force is not None
                z = self.program.variables(deepest.force, deepest.torsion)
                normals = deepest.force[:, 0]
                value = float(normals.sum() if settings.criterion == "sum" else normals.max())
                found = Answer(STALLED, z, found.iterations, value, 0.0, np.zeros(6), found.limit_multipliers * 0.0)
        return self.solution(found, wrench, found.z, "central", _NO_TRACE)


class ProgramNewton(_Program):
    """Newton on Phi within all limits."""

    needs_start = True

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`; without a start the deepest force is taken."""
        program, settings = self.program, self.settings
        start = start or self.deepest(wrench)
        z = program.variables(start.force, start.torsion)
        size = float(np.abs(start.force).max()) + float(np.abs(program.frame @ wrench).max())
        if program.residual(z, wrench) > BALANCE_TOLERANCE * size:
            raise InfeasibleStartError(
                f"initial-force rule {start.name!r} misses balance by {program.residual(z, wrench):.3g} N (G f + w = 0)"
            )
        if not program.slack(z) > 0.0:
            raise InfeasibleStartError(
                f"initial-force rule {start.name!r} leaves the limits by {-program.slack(z):.3g} N; use "
                "initial='phase_one', the force deepest inside them"
            )
        values = np.full(settings.max_iterations + 1 if trace else 0, np.nan)
        weights = settings.objective.weights(self.grasp.n_contacts)
        found = program.least_phi(wrench, weights, z, settings.tolerance, optimum, settings.max_iterations, values)
        return self.solution(found, wrench, z, start.name, values[: found.iterations + 1])

    def deepest(self, wrench: Wrench) -> Start:
        """The force deepest inside all limits."""
        found = self.feasible(wrench, "phase_one")
        assert found.force is not None
        return Start("phase_one", found.force, found.torsion)

    def carried(self, wrench: Wrench, previous: ForceSolution) -> Start:
        """The previous force, balanced for this wrench and grasp by the least change, or the deepest one."""
        if previous.n_contacts != self.grasp.n_contacts:
            raise InfeasibleStartError(
                f"the previous solution has {previous.n_contacts} contacts, the grasp {self.grasp.n_contacts}"
            )
        z = self.program.balanced(self.program.variables(previous.force, previous.torsion), wrench)
        if self.program.slack(z) > 0.0:
            return Start("previous", self.program.force(z), self.program.torsion(z))
        found = self.feasible(wrench, "previous")
        assert found.force is not None
        return Start("previous", found.force, found.torsion)


class Linear:
    """The classical pyramid program by HiGHS, for comparison."""

    needs_start = False

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        if settings.criterion != "sum":
            raise UnsupportedProblemError(
                f"method 'linear' knows criterion 'sum', got {settings.criterion!r}; use 'conic'"
            )
        self.grasp, self.settings = grasp, settings
        self.program = ForceProgram(grasp, settings.limits)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`. The bound is that of the pyramids, not of the cones.

        Raises:
            InfeasibleWrenchError: no force balances the wrench.
        """
        _refuse("linear", start, optimum, trace)
        found = linear_forces(self.grasp, wrench, limits=self.settings.limits)
        if found.status is Status.INFEASIBLE:
            proof = answer(self.program, wrench)
            if proof.certificate is not None:
                raise infeasible_error(self.grasp, wrench, "linear", "none", proof.certificate)
            raise InfeasibleWrenchError(
                f"no force inside the friction pyramids balances wrench {wrench.tolist()}, one inside the cones does: "
                "use method='conic'"
            )
        count = self.grasp.n_contacts
        record = np.zeros(record_size(count))
        z = self.program.variables(found.force, found.torsion)
        record[CODE], record[OBJECTIVE], record[BOUND] = CONVERGED, found.objective, found.objective
        record[MARGIN], record[RESIDUAL] = self.program.slack(z), self.program.residual(z, wrench)
        record[WRENCH : WRENCH + 6] = wrench
        record[MULTIPLIERS : MULTIPLIERS + 6] = found.multipliers
        record[FORCE : FORCE + 3 * count] = found.force.reshape(-1)
        record[FORCE + 3 * count : FORCE + 6 * count] = found.force.reshape(-1)
        record[FORCE + 6 * count :] = found.torsion
        return ForceSolution(record, "linear", "none")


def infeasible_error(
    grasp: Grasp, wrench: Wrench, method: str, initial: str, certificate: Array
) -> InfeasibleWrenchError:
    """The error that carries the infeasible solution and its separating twist."""
    residual = grasp.residual(np.zeros((grasp.n_contacts, 3)), wrench)
    return InfeasibleWrenchError(
        f"no force strictly inside the limits balances wrench {wrench.tolist()}; the twist "
        f"{np.round(certificate, 6).tolist()} separates it (error.solution.certificate): add contacts, raise the "
        "friction, widen the limits, or change the wrench",
        infeasible(wrench, grasp.n_contacts, method, initial, residual, certificate),
    )


def _refuse(method: str, start: Start | None, optimum: float, trace: bool) -> None:
    if start is not None or optimum == optimum or trace:
        raise InvalidInputError(f"method {method!r} takes no start, optimum or trace: they belong to descents on Phi")
