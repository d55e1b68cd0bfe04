"""What a force optimisation returns: the force, how it went, and the residuals that certify it."""

from __future__ import annotations

from enum import Enum
from typing import Any, Protocol

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.core import Solution
from grasp_env.errors import InfeasibleWrenchError, NotConvergedError
from grasp_env.force.record import (
    BOUND,
    CODE,
    CONVERGED,
    EXCESS,
    FORCE,
    INFEASIBLE,
    ITERATIONS,
    LIMIT,
    LIMITS_EXCEEDED,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    RESIDUAL,
    STALLED,
    TRIALS,
    WRENCH,
)


class Status(Enum):
    """Outcome of a force optimisation; `status.help` says what it means."""

    OPTIMAL = "optimal"
    ITERATION_LIMIT = "iteration_limit"
    STALLED = "stalled"
    INFEASIBLE = "infeasible"
    LIMITS_EXCEEDED = "limits_exceeded"

    @property
    def help(self) -> str:
        """One sentence for people."""
        return _HELP[self]


_HELP = {
    Status.OPTIMAL: "The relative gap of the objective to its certified lower bound is within the tolerance; the force is balanced and "
    "inside the cones.",
    Status.ITERATION_LIMIT: "Stopped at max_iterations: the force is balanced and inside the cones, not optimal "
    "to the tolerance; raise max_iterations or the tolerance, or start closer.",
    Status.STALLED: "No further progress in floating point: the force is inside the cones; optimality_gap and equilibrium_residual say "
    "how good it is. Either the tolerance asks for more digits than the problem has, or it has few: contacts close together or close "
    "to losing force closure, weights or friction decades apart.",
    Status.INFEASIBLE: "No force strictly inside the limits balances the wrench; `certificate` is a twist that proves it.",
    Status.LIMITS_EXCEEDED: "No force strictly inside the limits balances the wrench; this one does, inside the cones, and exceeds "
    "the limits least: no other one's largest excess (`limit_excess`) is clearly smaller.",
}
STATUSES = {
    CONVERGED: Status.OPTIMAL,
    LIMIT: Status.ITERATION_LIMIT,
    STALLED: Status.STALLED,
    INFEASIBLE: Status.INFEASIBLE,
    LIMITS_EXCEEDED: Status.LIMITS_EXCEEDED,
}
"""By code."""
_REPLACED = "linear_combination (", " was replaced)"


def combination_for(name: str) -> str:
    """`ForceSolution.initial` where the paper's combination took the place of the start of that name."""
    return name.join(_REPLACED)


class Priced(Protocol):
    """What knows the prices of a solution's limits where they are asked for; `ContactRows` does."""

    def prices(self, solution: ForceSolution) -> Array:
        """(M,) >= 0."""
        ...


class ForceSolution(Solution):
    """A grasp force with its certificates: a view of one record of numbers (`record.py`), read on demand.

    Attributes:
        n_contacts: N.
        force: (N, 3) N: normal, o, t of each finger's force on the object, in that contact's frame.
        initial_force: (N, 3) the start [N].
        torsion: (N,) N m: torsion of each finger on the object about its normal; zero unless the contact is soft.
        method: the method's name.
        initial: the name of the start rule; "linear_combination (NAME was replaced)" where `start_replaced`.
        objective_trace: Phi of every iterate, when asked for; else empty.
        certificate: (6,) for INFEASIBLE: a twist v with G_i^T v in the dual cone of every contact and v . w > 0
            (= 0: only forces on the boundary of the cones balance it); see `Feasibility`.
    """

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (
            self._record,
            self.method,
            self.initial,
            self.objective_trace,
            self.certificate,
            self.limit_multipliers,
        )

    @property
    def limit_multipliers(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(M,) >= 0 prices of the further limits, in the order of `ForceOptimizer.limit_labels`; empty where there are none."""
        given: Array | Priced = super().limit_multipliers
        return given if isinstance(given, np.ndarray) else given.prices(self)

    @property
    def wrench(self) -> Wrench:
        """(6,) the external wrench that `force` balances [N, N m]."""
        return _read_only(self._record[WRENCH : WRENCH + 6])

    @property
    def multipliers(self) -> Array:
        """(6,) nu of balance: grad objective = G^T nu (+ multipliers of the limits), d objective / d wrench = -nu."""
        return _read_only(self._record[MULTIPLIERS : MULTIPLIERS + 6])

    @property
    def status(self) -> Status:
        """How the optimisation ended."""
        return STATUSES[self.code]

    @property
    def start_replaced(self) -> bool:
        """True if the solve began from the paper's combination although a rule of yours or a learned start was asked.

        Nothing was left of the force that the rule had in mind: `Repair` discards a candidate where no force on the way to it has
        less Phi than the combination. Such a start costs what the paper's costs.
        """
        begin, end = _REPLACED
        return self.initial.startswith(begin) and self.initial.endswith(end)

    @property
    def iterations(self) -> int:
        """Accepted steps."""
        return int(self._record[ITERATIONS])

    @property
    def trials(self) -> int:
        """All steps tried, rejected ones included."""
        return int(self._record[TRIALS])

    @property
    def objective(self) -> float:
        """Phi of `force`; of `conic` sum [N] or maximum [N] of the normal forces; else `limit_excess`, where it is > 0."""
        return float(self._record[OBJECTIVE])

    @property
    def lower_bound(self) -> float:
        """A dual bound: no balanced force has a smaller objective (-inf: none); with `optimum` given, that."""
        return float(self._record[BOUND])

    @property
    def equilibrium_residual(self) -> float:
        """Largest |component| of G f + w [N], moments about the contacts' centre, divided by the grasp's length."""
        return float(self._record[RESIDUAL])

    @property
    def cone_margin(self) -> float:
        """Min over contacts of mu * normal - |tangential| [N] (in cone coordinates); > 0 strictly inside."""
        return float(self._record[MARGIN])

    @property
    def limit_excess(self) -> float:
        """Largest excess of a limit, as a part of that limit; 0 within all. See `elastic` of `optimize_force`."""
        return float(self._record[EXCESS])

    @property
    def optimality_gap(self) -> float:
        """(objective - lower_bound) / lower_bound, certified; +inf without a positive bound."""
        if self.lower_bound > 0.0:
            return max(0.0, (self.objective - self.lower_bound) / self.lower_bound)
        return 0.0 if self.objective == 0.0 else float("inf")

    @property
    def total_normal_force(self) -> float:
        """Sum of the normal forces [N]."""
        return float(self.force[:, 0].sum())

    def raise_for_status(self) -> ForceSolution:
        """Returns self when OPTIMAL.

        Raises:
            InfeasibleWrenchError: status INFEASIBLE or LIMITS_EXCEEDED.
            NotConvergedError: any other status but OPTIMAL.
        """
        if self.status in (Status.INFEASIBLE, Status.LIMITS_EXCEEDED):
            raise InfeasibleWrenchError(f"wrench {self.wrench.tolist()}: {self.status.help}", self)
        if self.status is not Status.OPTIMAL:
            raise NotConvergedError(
                f"{self.method} ended after {self.iterations} iterations with a relative gap of "
                f"{self.optimality_gap:.3g}: {self.status.help}",
                self,
            )
        return self

    def __repr__(self) -> str:
        return (
            f"ForceSolution({self.status.value}, {self.method} from {self.initial}, {self.n_contacts} contacts, "
            f"{self.iterations} iterations, objective {self.objective:.6g}, gap {self.optimality_gap:.1e}, "
            f"balance {self.equilibrium_residual:.1e} N, margin {self.cone_margin:.3g} N)"
        )


def _read_only(view: Array) -> Array:
    # the certificates belong to these numbers, and the next solve may start from them
    view.setflags(False)  # pyright: ignore[reportCallIssue]
    return view


def infeasible(wrench: Wrench, count: int, method: str, initial: str, residual: float, twist: Array) -> ForceSolution:
    """The solution of a wrench that is proven infeasible: no force, the certificate."""
    record = np.zeros(FORCE + 7 * count)
    record[CODE], record[OBJECTIVE], record[BOUND], record[RESIDUAL] = INFEASIBLE, np.inf, np.inf, residual
    record[WRENCH : WRENCH + 6] = wrench
    return ForceSolution(record, method, initial, certificate=twist)
