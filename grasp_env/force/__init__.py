"""Grasp-force optimisation: the paper's flows, their starts, Newton, the exact conic problem. numpy, scipy, numba only."""

from grasp_env.force.basis import OfflineBasis
from grasp_env.force.batch import ForceSolutions, optimize_forces
from grasp_env.force.closure import ForceClosure, force_closure
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
from grasp_env.force.limits import ForceLimits
from grasp_env.force.linear import LinearForces, linear_forces
from grasp_env.force.methods import DESCENTS, METHODS
from grasp_env.force.objective import Objective
from grasp_env.force.optimizer import ForceOptimizer, optimize_force
from grasp_env.force.pipeline import ForcePipeline
from grasp_env.force.quality import Epsilon, GraspQuality, epsilon, quality, singular_values
from grasp_env.force.repair import Repair, carry_over
from grasp_env.force.solution import ForceSolution, Status
from grasp_env.force.step_size import AdaptiveStep, ArmijoStep, BarzilaiBorweinStep, ExactStep, FixedStep
from grasp_env.force.torques import contact_jacobian, joint_torques
from grasp_env.force.worst_case import WorstCase, WrenchBall, worst_case

__all__ = [
    "DESCENTS",
    "METHODS",
    "RULES",
    "AdaptiveStep",
    "ArmijoStep",
    "BarzilaiBorweinStep",
    "Epsilon",
    "ExactStep",
    "Feasibility",
    "FixedStep",
    "ForceClosure",
    "ForceLimits",
    "ForceOptimizer",
    "ForcePipeline",
    "ForceSolution",
    "ForceSolutions",
    "GraspQuality",
    "InitialForceRule",
    "Lagrange",
    "LinearCombination",
    "LinearForces",
    "Objective",
    "OfflineBasis",
    "PhaseOne",
    "Repair",
    "SingleValue",
    "Status",
    "WorstCase",
    "WrenchBall",
    "carry_over",
    "cone_margin",
    "contact_jacobian",
    "description_matrix",
    "epsilon",
    "force_closure",
    "initial_rule",
    "joint_torques",
    "linear_forces",
    "optimize_force",
    "optimize_forces",
    "phase_one",
    "quality",
    "singular_values",
    "worst_case",
]
