"""Grasp-force optimisation: the paper's flows, their starts, Newton, the exact conic problem.

All methods and starts are the compiled core's; what needs scipy is imported when it is asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from grasp_env.force.basis import OfflineBasis
from grasp_env.force.batch import optimize_forces
from grasp_env.force.description import cone_margin, description_matrix
from grasp_env.force.initial import InitialForceRule, LinearCombination
from grasp_env.force.limits import ForceLimits
from grasp_env.force.many import ForceSolutions
from grasp_env.force.objective import Objective
from grasp_env.force.optimizer import ForceOptimizer, optimize_force
from grasp_env.force.options import DESCENTS, METHODS
from grasp_env.force.repair import Repair, carry_over, start_replaced
from grasp_env.force.rules import RULES, Lagrange, PhaseOne, SingleValue, initial_rule
from grasp_env.force.solution import ForceSolution, Status
from grasp_env.force.step_size import AdaptiveStep, ArmijoStep, BarzilaiBorweinStep, ExactStep, FixedStep
from grasp_env.force.torques import joint_torques

if TYPE_CHECKING:
    from grasp_env.force.closure import ForceClosure, force_closure
    from grasp_env.force.feasibility import Feasibility, phase_one
    from grasp_env.force.grasp_quality import Epsilon, GraspQuality, epsilon, quality, singular_values
    from grasp_env.force.worst_wrench import WorstCase, WrenchBall, worst_case

_LATER = {
    "closure": ("ForceClosure", "force_closure"),
    "feasibility": ("Feasibility", "phase_one"),
    "grasp_quality": ("Epsilon", "GraspQuality", "epsilon", "quality", "singular_values"),
    "worst_wrench": ("WorstCase", "WrenchBall", "worst_case"),
}
_HOME = {name: module for module, names in _LATER.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(__all__)


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
    "ForceSolution",
    "ForceSolutions",
    "GraspQuality",
    "InitialForceRule",
    "Lagrange",
    "LinearCombination",
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
    "description_matrix",
    "epsilon",
    "force_closure",
    "initial_rule",
    "joint_torques",
    "optimize_force",
    "optimize_forces",
    "phase_one",
    "quality",
    "singular_values",
    "start_replaced",
    "worst_case",
]
