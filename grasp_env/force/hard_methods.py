"""What the core solves of hard contacts, contact by contact: Newton, the flows and `conic`, and what all Newtons in the core share."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from grasp_env import core
from grasp_env._check import Array, Wrench, instance
from grasp_env.errors import InfeasibleStartError, InvalidInputError
from grasp_env.force.basis import OfflineBasis, core_contacts
from grasp_env.force.initial import CompiledRule, RuleStarts, asked, is_rule, rule_name
from grasp_env.force.method import (
    CONIC_ITERATIONS,
    Loop,
    OwnStart,
    Settings,
    Start,
    refuse,
    refused_start,
)
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONVERGED,
    FORCE,
    ITERATIONS,
    LIMIT,
    OBJECTIVE,
    REFUSED,
    STALLED,
    WRENCH,
    record_size,
)
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp

if TYPE_CHECKING:
    from grasp_env.force.program_methods import ProgramConic, ProgramNewton

LOOPED = ("linear_combination", "previous")
"""The named starts that are made within the compiled call."""
NO_TRACE = np.empty(0)
LAST_DIGITS = 1e-9
"""A gap that is left to the rounding of a double."""
MORE_STEPS = 1000
"""Of the general program, where Newton stalled: 60 ms with four contacts."""


def gap(record: Array) -> float:
    """Objective above its lower bound."""
    return float(record[OBJECTIVE] - record[BOUND])


def gapes(record: Array, tolerance: float) -> bool:
    """Whether what stopped short of the tolerance has more left than the last digits."""
    return not (record[BOUND] > 0.0 and gap(record) <= max(tolerance, LAST_DIGITS) * record[BOUND])


class FallingBack(RuleStarts):
    """Newton in the core: named starts in the compiled call, what it leaves by the general program of the same contacts and limits."""

    solver: Any

    @abstractmethod
    def solution(self, record: Array, method: str, initial: str) -> ForceSolution:
        """What the core wrote."""

    @cached_property
    def general(self) -> ProgramNewton:
        """The general program of the same contacts and limits."""
        from grasp_env.force.program_methods import ProgramNewton

        return ProgramNewton(self.grasp, self.settings)

    def loop(self, initial: Any) -> Loop | None:
        """See `Method.loop`."""
        named = initial is None or (isinstance(initial, str) and initial in LOOPED)
        if not named or self.settings.correction != "tangent":
            return None
        solver, follows = self.solver, initial == "previous"
        return Loop(
            solver.solve, "linear_combination", "previous", follows, solver.solve_many, self.solution, self.solution
        )


class Newton(FallingBack):
    """Newton on Phi, hard contacts. Starts from the 12-basis and the previous solution in the compiled call."""

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        self.solver = self._make(core_contacts(grasp, settings.objective))
        try:
            self.solver.set_basis(OfflineBasis.of(grasp, settings.objective).cone_forces)
            self.has_basis = True
        except InfeasibleStartError:
            self.has_basis = False  # rules that need one say so

    def _make(self, contacts: core.Contacts) -> core.Newton:
        return core.Newton.make(contacts, self.settings.tolerance, self.settings.max_iterations)

    def loop(self, initial: Any) -> Loop | None:
        """See `Method.loop`."""
        if not self.has_basis:
            return None
        if is_rule(initial, CompiledRule):
            return rule_loop(self, initial) if self.settings.correction == "tangent" else None
        loop = super().loop(initial)
        if loop is not None:
            loop.solution = ForceSolution  # a record that converged is what it is
        return loop

    def solution(self, record: Array, method: str, initial: str, trace: Array = NO_TRACE) -> ForceSolution:
        """What the core wrote; where that stalled with a gap, what the general program makes of it in twice the digits."""
        if record[CODE] == STALLED and not len(trace) and gapes(record, self.settings.tolerance):
            self._go_on(record)
        return ForceSolution(record, method, initial, trace)

    def _go_on(self, record: Array) -> None:
        """From the force of a record to a better one, into the record."""
        program, settings, count = self.general.program, self.settings, self.grasp.n_contacts
        z = program.variables(record[FORCE : FORCE + 3 * count].reshape(-1, 3), None)
        found, _ = program.least_phi(
            record[WRENCH : WRENCH + 6].copy(), settings.objective.weights(count), z, settings.tolerance, float("nan"),
            min(settings.max_iterations, MORE_STEPS), NO_TRACE,
        )  # fmt: skip
        if found[CODE] != REFUSED and found[OBJECTIVE] < record[OBJECTIVE]:
            found[ITERATIONS] += record[ITERATIONS]
            found[FORCE + 3 * count : FORCE + 6 * count] = record[FORCE + 3 * count : FORCE + 6 * count]
            found[CODE] = CONVERGED if found[CODE] == CONVERGED else STALLED
            record[:] = found

    def descend(self, force: Array, wrench: Array, record: Array) -> None:
        """From a force (3N,) [N], balanced and strictly inside, into a record."""
        self.solver.descend(wrench, force.reshape(-1, 3), float("nan"), NO_TRACE, record)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        assert start is not None
        values = np.full(self.settings.max_iterations + 1, np.nan) if trace else NO_TRACE
        record = np.empty(record_size(self.grasp.n_contacts))
        if self.solver.descend(wrench, start.force, optimum, values, record) == REFUSED:
            raise refused_start(self.grasp, wrench, start)
        traced = values[: int(record[ITERATIONS]) + 1] if trace else NO_TRACE
        if optimum == optimum:
            return ForceSolution(record, self.settings.method, start.name, traced)
        return self.solution(record, self.settings.method, start.name, traced)


class Flow(Newton):
    """The paper's flows, from the same starts: `reduced_flow` in its fastest form, `full_flow` dense."""

    def _make(self, contacts: core.Contacts) -> core.Newton:
        settings, count = self.settings, self.grasp.n_contacts
        full = settings.method == "full_flow"
        if full and count > core.FULL_CONTACTS:
            raise InvalidInputError(
                f"the full flow is dense: {count} contacts given, at most {core.FULL_CONTACTS}; use another method"
            )
        form, rule = "full" if full else "reduced", settings.step_rule.parameters()
        return core.Flow.on(contacts, settings.tolerance, settings.max_iterations, form, rule)

    def _go_on(self, record: Array) -> None:
        """A flow ends where it ends."""


class Conic(OwnStart):
    """Least sum of normal forces, hard contacts with force closure: feasible throughout."""

    def __init__(self, grasp: Grasp, settings: Settings, contacts: core.Contacts, interior: Array) -> None:
        self.grasp, self.settings, self._size = grasp, settings, record_size(grasp.n_contacts)
        limit = min(settings.max_iterations, CONIC_ITERATIONS)
        self.solver = core.Conic.make(contacts, settings.tolerance, limit, interior)

    @cached_property
    def general(self) -> ProgramConic:
        """The general program of the same contacts."""
        from grasp_env.force.program_methods import ProgramConic

        return ProgramConic(self.grasp, self.settings)

    def loop(self, initial: Any) -> Loop | None:
        """See `Method.loop`."""
        return Loop(self.solver.solve, "central", many=self.solver.solve_many, stopped=self.solution)

    def solution(self, record: Array, method: str, initial: str) -> ForceSolution:
        """What the core wrote; where that stopped short of the tolerance, what the general program makes of it in twice the digits.

        Raises:
            InfeasibleWrenchError, NotConvergedError: neither has a force, for contacts within rounding of no force closure.
        """
        settings = self.settings
        stopped = record[CODE] in (STALLED, LIMIT) and settings.max_iterations >= CONIC_ITERATIONS
        if stopped and gapes(record, settings.tolerance):
            wrench = record[WRENCH : WRENCH + 6].copy()
            found, _ = self.general.program.least_force(wrench, "sum", settings.tolerance, CONIC_ITERATIONS)
            ended = found[CODE] in (STALLED, LIMIT)
            if found[CODE] == CONVERGED or (ended and gap(found) < gap(record)):
                record = found
            elif not ended and gap(record) > record[BOUND]:  # neither holds a digit
                return self.general.run(wrench, None, float("nan"), False)
        return ForceSolution(record, method, initial)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        refuse("conic", start, optimum, trace)
        record = np.empty(self._size)
        self.solver.solve(wrench, None, record)
        return self.solution(record, "conic", "central")


def rule_loop(method: Any, rule: CompiledRule) -> Loop | None:
    """The control loop's call of a rule that starts and certifies by itself; None where it does not know the contacts.

    Args:
        method: with `grasp`, `settings`, `solution` of what did not converge and, where it is not Newton, `descend`.
        rule: binds to them.
    """
    settings = method.settings
    descend = None if settings.method == "newton" else method.descend
    try:
        loop = asked(
            rule, rule.bind, method.grasp, settings.objective, settings.tolerance, settings.max_iterations, descend
        )
    except InfeasibleStartError:
        return None  # the general path says so in words
    instance(loop, Loop, f"what initial-force rule {rule_name(rule)!r} binds to").stopped = method.solution
    return loop
