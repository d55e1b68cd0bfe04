"""Grasp-force optimisation: the paper's flows, their starts, Newton, the exact conic problem."""

from grasp_env.force.basis import OfflineBasis
from grasp_env.force.batch import optimize_forces
from grasp_env.force.description import description_matrix
from grasp_env.force.limits import ForceLimits
from grasp_env.force.many import ForceSolutions
from grasp_env.force.margin import Margin
from grasp_env.force.objective import Objective
from grasp_env.force.optimizer import ForceOptimizer, optimize_force
from grasp_env.force.repair import Repair
from grasp_env.force.solution import ForceSolution, Status
from grasp_env.force.step_size import (
    AdaptiveStep,
    ArmijoStep,
    BarzilaiBorweinStep,
    ExactStep,
    FixedStep,
)
from grasp_env.force.torques import joint_torques

__all__ = [
    "AdaptiveStep",
    "ArmijoStep",
    "BarzilaiBorweinStep",
    "ExactStep",
    "FixedStep",
    "ForceLimits",
    "ForceOptimizer",
    "ForceSolution",
    "ForceSolutions",
    "Margin",
    "Objective",
    "OfflineBasis",
    "Repair",
    "Status",
    "description_matrix",
    "joint_torques",
    "optimize_force",
    "optimize_forces",
]
