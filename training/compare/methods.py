"""The methods that every start is compared with, each at its best."""

from __future__ import annotations

from typing import Any

from grasp_env.force import BarzilaiBorweinStep, ForceOptimizer, Objective
from grasp_env.grasp import Grasp

FLOW = "reduced_flow"
METHODS: dict[str, dict[str, Any]] = {FLOW: {"step_rule": BarzilaiBorweinStep()}, "newton": {}}
"""Options of `ForceOptimizer` by method. From the 12-basis as from the network the flow takes the fewest iterations and the least time
with this step rule, see `training.reproduce`, which compares all of them, the constant step included."""


def optimizer(grasp: Grasp, method: str, objective: Objective, tolerance: float, **options: Any) -> ForceOptimizer:
    """A method on a Phi, to a relative gap; further options of `ForceOptimizer`."""
    return ForceOptimizer(
        grasp, method=method, tolerance=tolerance, **METHODS[method], **phi_options(objective), **options
    )


def phi_options(objective: Objective) -> dict[str, Any]:
    """Phi as keywords of `ForceOptimizer`."""
    return {"force_weight": objective.force_weight, "barrier_weight": objective.barrier_weight}
