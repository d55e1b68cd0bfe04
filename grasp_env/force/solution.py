"""The result of a force optimisation: the force, its status, and its certificates."""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from grasp_env.core import Solution
from grasp_env.errors import InfeasibleWrenchError, NotConvergedError
from grasp_env.force.record import (
    CONVERGED,
    INFEASIBLE,
    LIMIT,
    LIMITS_EXCEEDED,
    OUTSIDE,
    REPLACED,
    STALLED,
    START,
    UNDECIDED,
)
from grasp_env.inputs.arguments import Array

STARTS = (
    "standard",
    "internal_force",
    "linear_combination",
    "linear_combination_printed",
    "single_value",
    "lagrange",
    "phase_one",
    "previous",
    "given",
    "guess",
    "learned",
    "central",
)
"""Names of the core's enumeration `Start`, in its order."""
COMBINATION, PREVIOUS, GIVEN, GUESS, LEARNED = (
    STARTS.index(name) for name in ("linear_combination", "previous", "given", "guess", "learned")
)


class Status(Enum):
    """Outcome of a force optimisation."""

    OPTIMAL = "optimal"
    ITERATION_LIMIT = "iteration_limit"
    STALLED = "stalled"
    INFEASIBLE = "infeasible"
    LIMITS_EXCEEDED = "limits_exceeded"
    UNDECIDED = "undecided"

    @property
    def help(self) -> str:
        """Explanation of the status."""
        return _HELP[self]


_HELP = {
    Status.OPTIMAL: "The relative gap of the objective to its certified lower bound is within the tolerance; the force is balanced and "
    "inside the cones.",
    Status.ITERATION_LIMIT: "Stopped at max_iterations: the force is balanced and inside the cones, not optimal "
    "to the tolerance; raise max_iterations or the tolerance, or start closer.",
    Status.STALLED: "No further progress in floating point: the force is inside the cones; see optimality_gap and equilibrium_residual "
    "for its accuracy. Either the tolerance asks for more digits than the problem has, or the problem is ill-conditioned: contacts close "
    "together or close to losing force closure, weights or friction decades apart.",
    Status.INFEASIBLE: "No force strictly inside the limits balances the wrench; `certificate` is a twist that proves it.",
    Status.LIMITS_EXCEEDED: "No force strictly inside the limits balances the wrench; this one does, inside the cones, and exceeds "
    "the limits by the least possible amount: no force has a clearly smaller `limit_excess`.",
    Status.UNDECIDED: "Neither a force nor a proof of infeasibility was found: the contacts or limits are within rounding of the "
    "feasible boundary, or the numbers are too many decades apart.",
}
STATUSES = {
    CONVERGED: Status.OPTIMAL,
    LIMIT: Status.ITERATION_LIMIT,
    STALLED: Status.STALLED,
    INFEASIBLE: Status.INFEASIBLE,
    LIMITS_EXCEEDED: Status.LIMITS_EXCEEDED,
    UNDECIDED: Status.UNDECIDED,
}
"""Status of each code of the core."""


class Names(NamedTuple):
    """Names that a solution shows.

    Attributes:
        requested: the name of the requested start.
        starts: the names of all starts, in the order of `STARTS`.
    """

    method: str
    requested: str
    starts: tuple[str, ...] = STARTS

    def initial(self, record: Array) -> str:
        """Return `ForceSolution.initial`."""
        used = self.starts[int(record[START])]
        if record[REPLACED]:
            return f"{used} ({self.requested} was replaced)"
        return f"{used} (outside its training range)" if record[OUTSIDE] else used

    def of_start(self, start: int, name: str | None) -> Names:
        """Return the names for a call with another start, an index into `STARTS`."""
        if name is None:
            return self._replace(requested=STARTS[start]) if start else self
        return self._replace(requested=name, starts=(*STARTS[:start], name, *STARTS[start + 1 :]))


class ForceSolution(Solution):
    """A grasp force with its certificates: a view of one record (`record.py`), read on demand.

    A solution is true if it has a force.

    Attributes:
        n_contacts: N, the number of contacts.
        force: (N, 3) force of each finger on the object [N]: normal, o, t in the contact frame;
            zero for contacts that do not touch.
        object_force: (N, 3) the same force along the axes of the frame of the positions [N].
        frames: (N, 3, 3) contact frames, columns (n, o, t), in the frame of the positions.
        torques: (J,) joint torques, the bias included [N m]; empty without torque limits.
        initial_force: (N, 3) the start [N].
        torsion: (N,) torsion of each finger on the object about its normal [N m]; zero unless the
            contact is soft.
        friction_used: (N,) share of the given friction that each force uses, torsion included: 1 on
            the cone. NaN for contacts that do not touch, inf for a tangential force without a
            normal one. A contact that uses 0.99 slips if the friction is 1 % lower than given.
        wrench: (6,) the external wrench that `force` balances [N, N m].
        wrench_with_preload: (6,) `wrench` plus that of the margin's preloads, w + G s n [N, N m].
        multipliers: (6,) nu of balance: grad objective = G^T nu (+ multipliers of the limits),
            d objective / d wrench = -nu.
        limit_multipliers: (M,) multipliers >= 0 of the limits, in the order of
            `ForceOptimizer.limit_labels`; if infeasible, see `certificate`; empty for
            LIMITS_EXCEEDED.
        has_force: False if the solve found no force; then `force` is zero.
        initial: the name of the start; "internal_force (NAME was replaced)" if nothing is left of
            the requested one, and then `start_replaced` is True.
        iterations: accepted steps.
        trials: all steps tried.
        objective: Phi of `force`, or the criterion of `conic` [N]; `limit_excess` if that is > 0.
        lower_bound: dual bound, below the objective of every balanced force; -inf: unknown; the
            `optimum` if that was given.
        optimality_gap: (objective - lower_bound) / lower_bound, certified; +inf without a positive
            bound.
        equilibrium_residual: `Grasp.residual` of the force [N].
        cone_margin: `Grasp.cone_margin` of the force [N], of the cones within the `Margin`; > 0
            strictly inside.
        limit_excess: largest excess of a limit as a fraction of that limit; see `elastic` of
            `ForceOptimizer`.
        objective_trace: Phi of every iterate with `trace=True`, without those of the general
            program where it continued; else empty. It falls with every step, except with the first
            from a previous force, which may not balance the new wrench.
    """

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._record, self._names, self.objective_trace)

    @property
    def method(self) -> str:
        """The method's name."""
        return self._names.method

    @property
    def initial(self) -> str:
        """The name of the start; see the class."""
        return self._names.initial(self._record)

    @property
    def certificate(self) -> Array | None:
        """(6,) the proof of infeasibility with status INFEASIBLE, else None.

        It is a twist v with G_i^T v in the dual cone of every contact and v . w > 0. With limits
        A f <= b and multipliers y, `limit_multipliers`, G^T v + A^T y lies in the dual cones and
        v . w > y . b. With a `Margin` of preloads s, the cones are those within its share of
        friction, w is `wrench_with_preload`, and b is b - A s n. For a zero wrench v . w = 0: no force strictly inside the cones balances
        itself, and the force zero has no finite Phi.
        """
        return self.multipliers if self.code == INFEASIBLE else None

    @property
    def status(self) -> Status:
        """Outcome of the optimisation."""
        return STATUSES[self.code]

    @property
    def total_normal_force(self) -> float:
        """Sum of the normal forces [N]."""
        return float(self.force[:, 0].sum())

    def raise_for_status(self) -> ForceSolution:
        """Return self if the status is OPTIMAL.

        Raises:
            InfeasibleWrenchError: status INFEASIBLE or LIMITS_EXCEEDED.
            NotConvergedError: any other status.
        """
        if self.status in (Status.INFEASIBLE, Status.LIMITS_EXCEEDED):
            raise InfeasibleWrenchError(self._infeasibility(), self)
        if self.status is not Status.OPTIMAL:
            raise NotConvergedError(
                f"{self.method} ended after {self.iterations} iterations with a relative gap of "
                f"{self.optimality_gap:.3g}: {self.status.help}",
                self,
            )
        return self

    def _infeasibility(self) -> str:
        """Describe an infeasible wrench, without the grasp or the labels of the limits."""
        twist = self.certificate
        if twist is None:
            shown = f"The largest excess is {100.0 * self.limit_excess:.3g} % of its limit. The error of optimize_force with elastic=False"
        else:
            shown = (
                f"The twist is {[round(v, 6) for v in twist.tolist()]}. The error of optimize_force"
            )
        return (
            f"wrench {self.wrench.tolist()} on {self.n_contacts} contacts: {self.status.help} {shown} names the limits and the "
            "friction cones that the proof needs"
        )

    def _largest_share(self) -> str:
        return f"{np.nanmax(self.friction_used):.3g}" if self.has_force else "none"

    def __repr__(self) -> str:
        return (
            f"ForceSolution({self.status.value}, {self.method} from {self.initial}, {self.n_contacts} contacts, "
            f"{self.iterations} iterations, objective {self.objective:.6g}, gap {self.optimality_gap:.1e}, "
            f"balance {self.equilibrium_residual:.1e} N, friction used {self._largest_share()})"
        )
