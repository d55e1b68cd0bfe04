"""Methods with which every start is compared, each with its best options."""

from __future__ import annotations

from typing import Any

from grasp_env.force import BarzilaiBorweinStep, ForceOptimizer, Objective
from grasp_env.grasp import Grasp

FLOW = "reduced_flow"
METHODS: dict[str, dict[str, Any]] = {FLOW: {"step_rule": BarzilaiBorweinStep()}, "newton": {}}
"""Options of `ForceOptimizer` by method.

With this step rule the flow takes the fewest iterations and the least time, from the 12-basis and
from the network; `training.evaluation.reproduce.experiments` compares all step rules.
"""


def optimizer(
    grasp: Grasp, method: str, objective: Objective, tolerance: float, **options: Any
) -> ForceOptimizer:
    """Return an optimizer for a method and Phi, to a relative gap."""
    return ForceOptimizer(
        grasp, method=method, tolerance=tolerance, **METHODS[method], **vars(objective), **options
    )
