"""Learned initial forces, controllers and agents. torch is imported only where a network is trained."""

from typing import TYPE_CHECKING, Any

from policies.controllers import Policy, ZeroPolicy
from policies.learned import LearnedInitialForce

if TYPE_CHECKING:
    from policies.agent import TrainedAgent


def __getattr__(name: str) -> Any:
    if name != "TrainedAgent":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from policies.agent import TrainedAgent  # asks the environment what it shows, which needs the extra "sim"

    return TrainedAgent


def __dir__() -> list[str]:
    return sorted(__all__)


__all__ = ["LearnedInitialForce", "Policy", "TrainedAgent", "ZeroPolicy"]
