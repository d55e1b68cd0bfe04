"""What a force optimisation returns: the force, how it went, and the residuals that certify it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from grasp_env._check import Array, ContactForces, Wrench
from grasp_env.errors import InfeasibleWrenchError, NotConvergedError


class Status(Enum):
    """Outcome of a force optimisation; `status.help` says what it means."""

    OPTIMAL = "optimal"
    ITERATION_LIMIT = "iteration_limit"
    STALLED = "stalled"
    INFEASIBLE = "infeasible"

    @property
    def help(self) -> str:
        """One sentence for people."""
        return _HELP[self]


_HELP = {
    Status.OPTIMAL: "The relative gap of Phi to its certified lower bound is within the tolerance.",
    Status.ITERATION_LIMIT: "Stopped at max_iterations: the force is balanced and strictly inside the cones, not optimal "
    "to the tolerance; raise max_iterations or the tolerance, or start closer.",
    Status.STALLED: "No step decreases Phi in floating point: the force is balanced and strictly inside the cones; the "
    "tolerance asks for more digits than the problem has.",
    Status.INFEASIBLE: "No force strictly inside the cones balances the wrench; `certificate` is a twist that proves it.",
}


@dataclass(frozen=True)
class ForceSolution:
    """A grasp force with its certificates.

    Attributes:
        force: (N, 3) N: normal, o, t of each finger's force on the object, in that contact's frame.
        status: how the optimisation ended.
        iterations: accepted steps.
        trials: all steps tried, rejected ones included.
        objective: Phi of `force`.
        lower_bound: a dual bound: no balanced force has a smaller Phi (-inf: none found); with `optimum` given, that.
        equilibrium_residual: largest |component| of G f + w, moments divided by the grasp's length [N].
        cone_margin: min over contacts of mu * normal - |tangential| [N]; > 0 strictly inside.
        wrench: (6,) the external wrench that `force` balances [N, N m].
        initial_force: (N, 3) the start [N].
        method: the method's name.
        initial: the name of the start rule.
        objective_trace: Phi of every iterate, when asked for; else empty.
        certificate: (6,) for INFEASIBLE: a twist v with G_i^T v in the dual cone of every contact and v . w > 0
            (= 0: only forces on the boundary of the cones balance it); see `Feasibility`.
    """

    force: ContactForces
    status: Status
    iterations: int
    trials: int
    objective: float
    lower_bound: float
    equilibrium_residual: float
    cone_margin: float
    wrench: Wrench
    initial_force: ContactForces
    method: str
    initial: str
    objective_trace: Array = field(default_factory=lambda: np.empty(0), repr=False)
    certificate: Array | None = None

    @property
    def optimality_gap(self) -> float:
        """(Phi - lower_bound) / lower_bound, certified; +inf without a positive bound."""
        if self.lower_bound > 0.0:
            return max(0.0, (self.objective - self.lower_bound) / self.lower_bound)
        return float("inf")

    @property
    def total_normal_force(self) -> float:
        """Sum of the normal forces [N]."""
        return float(self.force[:, 0].sum())

    def raise_for_status(self) -> ForceSolution:
        """Returns self when OPTIMAL.

        Raises:
            InfeasibleWrenchError: status INFEASIBLE.
            NotConvergedError: any other status but OPTIMAL.
        """
        if self.status is Status.INFEASIBLE:
            raise InfeasibleWrenchError(f"wrench {self.wrench.tolist()}: {self.status.help}", self)
        if self.status is not Status.OPTIMAL:
            raise NotConvergedError(
                f"{self.method} ended after {self.iterations} iterations with a relative gap of "
                f"{self.optimality_gap:.3g}: {self.status.help}"
            )
        return self
