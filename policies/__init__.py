"""Learned initial forces, controllers and agents, and the optimum as a torch layer.

torch is imported only where it is needed.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from policies.controllers import Policy, ZeroPolicy
from policies.learned import LearnedInitialForce

if TYPE_CHECKING:
    from policies.agent import TrainedAgent
    from policies.layer import GraspForceLayer, GraspForces, grasp_force

_LATER = {
    "TrainedAgent": "policies.agent",  # reads the layout of observations, which needs the extra "sim"
    **dict.fromkeys(("GraspForceLayer", "GraspForces", "grasp_force"), "policies.layer"),
}
"""Names that are imported on first use, because they need an extra."""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LATER[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


__all__ = [
    "GraspForceLayer",
    "GraspForces",
    "LearnedInitialForce",
    "Policy",
    "TrainedAgent",
    "ZeroPolicy",
    "grasp_force",
]
