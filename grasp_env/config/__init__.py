"""The settings of the environment: `EnvConfig` and its nested records."""

from grasp_env.config.env import EnvConfig
from grasp_env.config.records import (
    AgentSettings,
    ControllerSettings,
    EpisodeLimits,
    MotorSettings,
    PictureSettings,
    RewardSettings,
    SensorSettings,
    SolverSettings,
)

__all__ = [
    "AgentSettings",
    "ControllerSettings",
    "EnvConfig",
    "EpisodeLimits",
    "MotorSettings",
    "PictureSettings",
    "RewardSettings",
    "SensorSettings",
    "SolverSettings",
]
