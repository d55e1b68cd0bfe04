"""The settings of the environment: `EnvConfig` and its nested records."""

from grasp_env.config.env import KEYWORDS, EnvConfig, all_settings, as_config
from grasp_env.config.records import Agent, Controller, EpisodeLimits, Pictures, Reward, Sensors, Solver

__all__ = [
    "KEYWORDS",
    "Agent",
    "Controller",
    "EnvConfig",
    "EpisodeLimits",
    "Pictures",
    "Reward",
    "Sensors",
    "Solver",
    "all_settings",
    "as_config",
]
