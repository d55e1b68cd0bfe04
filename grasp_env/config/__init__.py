"""The settings of the environment: `EnvConfig` and its nested records."""

from grasp_env.config.env import EnvConfig
from grasp_env.config.records import Agent, Controller, EpisodeLimits, Pictures, Reward, Sensors, Solver

__all__ = ["Agent", "Controller", "EnvConfig", "EpisodeLimits", "Pictures", "Reward", "Sensors", "Solver"]
