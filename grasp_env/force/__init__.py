"""Grasp-force optimisation: the paper's flows, the starts, Newton on the same objective. numpy, scipy, numba only."""

from grasp_env.force.basis import OfflineBasis
from grasp_env.force.description import cone_margin, description_matrix
from grasp_env.force.feasibility import Feasibility, phase_one
from grasp_env.force.initial import (
    RULES,
    InitialForceRule,
    Lagrange,
    LinearCombination,
    PhaseOne,
    SingleValue,
    initial_rule,
)
from grasp_env.force.objective import Objective
from grasp_env.force.optimizer import METHODS, ForceOptimizer, optimize_force
from grasp_env.force.repair import Repair, carry_over
from grasp_env.force.solution import ForceSolution, Status
from grasp_env.force.step_size import AdaptiveStep

__all__ = [
    "METHODS",
    "RULES",
    "AdaptiveStep",
    "Feasibility",
    "ForceOptimizer",
    "ForceSolution",
    "InitialForceRule",
    "Lagrange",
    "LinearCombination",
    "Objective",
    "OfflineBasis",
    "PhaseOne",
    "Repair",
    "SingleValue",
    "Status",
    "carry_over",
    "cone_margin",
    "description_matrix",
    "initial_rule",
    "optimize_force",
    "phase_one",
]
