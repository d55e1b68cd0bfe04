"""Checked settings of a force optimisation, with one set of defaults for all entry points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from grasp_env.errors import UnsupportedProblemError, shown
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.step_size import StepRule, checked_rule
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import AllFaults, choice, flag, positive, whole

FLOWS = ("reduced_flow", "full_flow")
"""The paper's flows, for hard contacts without limits."""
DESCENTS = (*FLOWS, "newton")
"""Methods that minimise Phi; they accept a start, a known optimum and a trace."""
METHODS = (*DESCENTS, "conic")
"""Names of all methods. `conic` takes no start."""
CRITERIA = ("sum", "max", "torque")
"""Objectives of `conic`: of the normal forces times their force_weight, or of the joint torques."""
MAX_ITERATIONS = 20_000
"""Default largest number of accepted steps."""
TOLERANCE = 1e-4
"""Default relative gap of the descents on Phi."""
CONIC_TOLERANCE = 1e-6
"""Default relative gap of the conic problem."""


@dataclass(frozen=True)
class Options:
    """Checked settings of a `ForceOptimizer`, which documents them."""

    method: str
    criterion: str
    objective: Objective
    tolerance: float
    max_iterations: int
    step_rule: StepRule
    elastic: bool

    @property
    def flows(self) -> bool:
        """True if the method is one of the paper's flows."""
        return self.method in FLOWS


def checked_options(*settings: Any) -> Options:
    """Return the fields of `Options`, checked once, since the checks take longer than a solve."""
    try:
        return _cached(*settings)
    except Exception:  # arguments without a hash, such as a list; wrong ones raise again
        return _checked(*settings)


def _checked(
    method: str,
    criterion: str,
    force_weight: Weight,
    barrier_weight: Weight | None,
    tolerance: float | None,
    max_iterations: int,
    step_rule: StepRule | None,
    elastic: bool,
) -> Options:
    barrier = Objective.barrier_weight if barrier_weight is None else barrier_weight
    with AllFaults() as check:
        options = Options(
            check(choice, method, "method", METHODS),
            check(choice, criterion, "criterion", CRITERIA),
            check(Objective, force_weight, barrier),
            check(_tolerance, tolerance, method),
            check(whole, max_iterations, "max_iterations", 0, ranges.ITERATIONS),
            check(checked_rule, step_rule),
            check(flag, elastic, "elastic"),
        )
    if options.criterion != "sum" and options.method != "conic":
        raise UnsupportedProblemError(
            f"criterion {criterion!r} belongs to method 'conic', got method {options.method!r}"
        )
    if options.criterion == "torque" and options.objective.force_weight != 1.0:
        raise UnsupportedProblemError(
            f"criterion 'torque' has no weights of normal forces, got force_weight={shown(force_weight)}: leave it out"
        )
    if step_rule is not None and not options.flows:
        raise UnsupportedProblemError(
            f"step_rule belongs to the flows, got method {options.method!r}: take method='reduced_flow' or 'full_flow', or leave it out"
        )
    if barrier_weight is not None and options.method == "conic":
        raise UnsupportedProblemError(
            f"method 'conic' has no barrier, got barrier_weight={shown(barrier_weight)}: take method='newton', or leave it out"
        )
    return options


_cached = lru_cache(256, typed=True)(_checked)


def _tolerance(value: float | None, method: object) -> float:
    if value is None:
        return CONIC_TOLERANCE if method == "conic" else TOLERANCE
    return positive(value, "tolerance", ranges.TOLERANCE)
