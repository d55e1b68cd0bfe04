"""Grasp quality on exact friction cones: which wrenches can be balanced, with what force."""

from grasp_env.quality.closure import force_closure
from grasp_env.quality.feasibility import feasibility
from grasp_env.quality.measures import epsilon, quality, singular_values
from grasp_env.quality.payload import payload
from grasp_env.quality.worst_wrench import WrenchBall, worst_case

__all__ = [
    "WrenchBall",
    "epsilon",
    "feasibility",
    "force_closure",
    "payload",
    "quality",
    "singular_values",
    "worst_case",
]
