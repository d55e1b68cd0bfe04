"""Methods for soft contacts, further limits and grasps without force closure."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array, Wrench, is_a
from grasp_env.errors import InfeasibleStartError, NotConvergedError, UnsupportedProblemError
from grasp_env.force.feasibility import Feasibility, answer
from grasp_env.force.initial import InitialForceRule, asked, rule_name
from grasp_env.force.method import (
    BALANCE_TOLERANCE,
    CONIC_ITERATIONS,
    Loop,
    OwnStart,
    Settings,
    Start,
    given_start,
    infeasible_error,
    proven,
    refuse,
)
from grasp_env.force.program import ForceProgram
from grasp_env.force.record import (
    CODE,
    FORCE,
    INFEASIBLE,
    ITERATIONS,
    REFUSED,
)
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp

NO_PRICES = np.empty(0)
NEXT_TO_NOTHING = 1e-9
"""[N], [N m]."""


class _Program:
    """Soft contacts, further limits, no force closure: what the methods on `ForceProgram` share."""

    uses_basis = False

    def __init__(self, grasp: Grasp, settings: Settings) -> None:
        self.grasp, self.settings = grasp, settings
        self.program = ForceProgram(grasp, settings.limits)

    @property
    def limit_labels(self) -> tuple[str, ...]:
        """What each entry of a solution's `limit_multipliers` belongs to."""
        return self.program.labels

    def loop(self, initial: Any) -> Loop | None:
        """None: the general program takes the general path."""
        return None

    def feasible(self, wrench: Wrench, name: str) -> Feasibility:
        """The deepest force.

        Raises:
            InfeasibleWrenchError: there is none.
        """
        found = answer(self.program, wrench)
        if found.certificate is not None:
            raise infeasible_error(self.grasp, wrench, self.settings.method, name, found.certificate)
        return found


class ProgramConic(OwnStart, _Program):
    """Least sum or least maximum of normal forces within all limits."""

    def loop(self, initial: Any) -> Loop | None:
        """See `Method.loop`; None where a solution holds multipliers of limits."""
        program, settings = self.program, self.settings
        if len(program.bound):
            return None
        solve, largest = program.solver.least_force, settings.criterion == "max"
        tolerance, limit = settings.tolerance, min(settings.max_iterations, CONIC_ITERATIONS)

        def call(wrench: Any, previous: Array | None, record: Array) -> int:
            return solve(wrench, largest, tolerance, limit, record, NO_PRICES)

        return Loop(call, "central", stopped=self.solution)

    def solution(self, record: Array, method: str, initial: str, prices: Array = NO_PRICES) -> ForceSolution:
        """What the core wrote.

        Raises:
            InfeasibleWrenchError: no force within the limits balances the wrench.
        """
        if record[CODE] == INFEASIBLE:
            raise proven(record, method, initial)
        return ForceSolution(record, method, initial, limit_multipliers=prices)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method` and `solution`."""
        refuse("conic", start, optimum, trace)
        settings, limit = self.settings, min(self.settings.max_iterations, CONIC_ITERATIONS)
        record, prices = self.program.least_force(wrench, settings.criterion, settings.tolerance, limit)
        if record[CODE] == REFUSED:
            self.feasible(wrench, "central")  # says why
            raise NotConvergedError(f"the conic solver found no least force for wrench {wrench.tolist()}")
        return self.solution(record, "conic", "central", prices)


class ProgramNewton(_Program):
    """Newton on Phi within all limits."""

    takes_start = True

    def start(self, wrench: Wrench, initial: Any, previous: ForceSolution | None) -> Start:
        """See `Method.start`: the deepest force unless one is given, carried over, or a callable's.

        Raises:
            UnsupportedProblemError: a rule's name, which knows hard contacts without further limits.
        """
        if is_a(initial, np.ndarray | list | tuple):
            return given_start("given", initial, self.grasp.n_contacts)
        if initial is None:
            return self.deepest(wrench)
        if isinstance(initial, str):
            if initial == "phase_one" or (initial == "previous" and previous is None):
                return self.deepest(wrench)
            if initial == "previous":
                assert previous is not None
                return self.carried(wrench, previous)
            raise UnsupportedProblemError(
                f"initial={initial!r} knows hard contacts without further limits; use 'phase_one' or 'previous', or leave "
                "it out"
            )
        rule: InitialForceRule = initial
        return given_start(rule_name(rule), asked(rule, rule, self.grasp, wrench.copy()), self.grasp.n_contacts)

    def run(self, wrench: Wrench, start: Start | None, optimum: float, trace: bool) -> ForceSolution:
        """See `Method`."""
        assert start is not None
        program, settings = self.program, self.settings
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
        record, prices = program.least_phi(
            wrench, weights, z, settings.tolerance, optimum, settings.max_iterations, values
        )
        if record[CODE] == REFUSED:
            raise NotConvergedError(
                f"Newton finds no number for Phi at the start {start.name!r} of wrench {wrench.tolist()}: forces, limits and weights are "
                "too many decades apart; use method='conic', or units in which they are not"
            )
        count = self.grasp.n_contacts
        record[FORCE + 3 * count : FORCE + 6 * count] = start.force.reshape(-1)
        traced = values[: int(record[ITERATIONS]) + 1]
        return ForceSolution(record, "newton", start.name, traced, limit_multipliers=prices)

    def deepest(self, wrench: Wrench) -> Start:
        """The force deepest inside all limits; of a wrench next to nothing, whose own are far from what Phi asks, that of none, balanced."""
        if np.abs(wrench).max() < NEXT_TO_NOTHING:
            rest = answer(self.program, np.zeros(6))
            if rest.force is not None:
                z = self.program.balanced(self.program.variables(rest.force, rest.torsion), wrench)
                if self.program.slack(z) > 0.0:
                    return Start("phase_one", self.program.force(z), self.program.torsion(z))
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
