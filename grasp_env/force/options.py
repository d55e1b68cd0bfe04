"""How a force optimisation is asked: one record of checked settings, with one set of defaults for every door."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from grasp_env import ranges
from grasp_env._check import as_text, choice, flag, positive, together, whole
from grasp_env.errors import UnsupportedProblemError
from grasp_env.force.objective import Objective, Weight
from grasp_env.force.step_size import StepRule, checked_rule

FLOWS = ("reduced_flow", "full_flow")
"""The paper's methods: on hard contacts without limits."""
DESCENTS = (*FLOWS, "newton")
"""Methods on Phi: they take a start, a known optimum and a trace."""
METHODS = (*DESCENTS, "conic")
"""What `method` may be; `conic` starts from its own centre."""
CRITERIA = ("sum", "max")
"""Of `conic`: of the normal forces."""
MAX_ITERATIONS = 20_000
TOLERANCE = 1e-4
"""Default relative gap of the descents on Phi."""
CONIC_TOLERANCE = 1e-6
"""Default relative gap of the conic problem."""


@dataclass(frozen=True)
class Options:
    """Checked settings of a `ForceOptimizer`; `optimize_force` says what they mean, `checked_options` makes them."""

    method: str
    criterion: str
    objective: Objective
    tolerance: float
    max_iterations: int
    step_rule: StepRule
    elastic: bool

    @property
    def flows(self) -> bool:
        """Whether the method is one of the paper's flows."""
        return self.method in FLOWS


def checked_options(*given: Any) -> Options:
    """The settings of an optimizer's keywords, in the order of its signature. They are remembered: to check them costs more than a solve.

    Raises:
        UnknownNameError, InvalidInputError, UnsupportedProblemError: see `optimize_force`.
    """
    try:
        return _remembered(*given)
    except TypeError:  # what has no hash, such as a list of weights
        return _checked(*given)


def _checked(
    method: str,
    criterion: str,
    force_weight: Weight,
    barrier_weight: Weight,
    tolerance: float | None,
    max_iterations: int,
    step_rule: StepRule | None,
    elastic: bool,
) -> Options:
    made = Options(
        *together(
            lambda: choice(method, "method", METHODS),
            lambda: choice(criterion, "criterion", CRITERIA),
            lambda: Objective(force_weight, barrier_weight),
            lambda: _tolerance(tolerance, method),
            lambda: whole(max_iterations, "max_iterations", 0, ranges.ITERATIONS),
            lambda: checked_rule(step_rule),
            lambda: flag(elastic, "elastic"),
        )
    )
    if made.criterion != "sum" and made.method != "conic":
        raise UnsupportedProblemError(f"criterion {criterion!r} belongs to method 'conic', got method {made.method!r}")
    if step_rule is not None and not made.flows:
        raise UnsupportedProblemError(
            f"step_rule belongs to the flows, got method {made.method!r}: take method='reduced_flow' or 'full_flow', or leave it out"
        )
    return made


_remembered = lru_cache(256, typed=True)(_checked)


def _tolerance(given: float | None, method: object) -> float:
    if given is None:
        return CONIC_TOLERANCE if as_text(method) == "conic" else TOLERANCE
    return positive(given, "tolerance", ranges.TOLERANCE)
