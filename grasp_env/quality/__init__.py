"""Grasp quality on the exact friction cones: which wrenches contacts can balance, and with how much force.

`feasibility` and `force_closure` need numpy only; the convex hulls of `epsilon` and `worst_case` need scipy.
"""

from grasp_env.quality.closure import ForceClosure, force_closure
from grasp_env.quality.feasibility import Feasibility, feasibility
from grasp_env.quality.measures import Epsilon, GraspQuality, epsilon, quality, singular_values
from grasp_env.quality.worst_wrench import WorstCase, WrenchBall, worst_case

__all__ = [
    "Epsilon",
    "Feasibility",
    "ForceClosure",
    "GraspQuality",
    "WorstCase",
    "WrenchBall",
    "epsilon",
    "feasibility",
    "force_closure",
    "quality",
    "singular_values",
    "worst_case",
]
