"""Why an object does not count as held: one entry for each fault."""

from __future__ import annotations

from grasp_env.config import EnvConfig
from grasp_env.core import Outcome


def lasting_fault(outcome: Outcome, config: EnvConfig) -> str:
    """Return the first fault of an episode that no later step undoes; "" without one."""
    limits = config.limits
    if outcome.slide > limits.max_slide:
        return "slid"
    if outcome.overlap > limits.max_overlap:
        return "overlap"
    if outcome.stray_share > limits.max_stray:
        return "stray_force"
    breaks = limits.max_force is not None and outcome.force > limits.max_force
    return "crushed" if breaks else ""


def passing_fault(outcome: Outcome, config: EnvConfig) -> str:
    """Return the first fault of a step that may end again; "" without one."""
    limits = config.limits
    if not config.task.in_place(outcome.drift, outcome.tilt):
        return "drifted"
    if outcome.imbalance > limits.max_imbalance:
        return "not_carried"
    return "moving" if outcome.speed > limits.max_speed else ""
