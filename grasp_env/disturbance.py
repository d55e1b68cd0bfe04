"""The external wrench over an episode, sampled at the control rate when the episode starts."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env.config import EnvConfig
from grasp_env.grasp.wrench import paper_path


def sample_disturbance(config: EnvConfig, rng: np.random.Generator, count: int) -> Array:
    """(count, 6) external wrenches [N, N m], object frame, one per control step of the episode.

    Args:
        config: which wrench, and how strong.
        rng: used by "random" only.
        count: control steps.
    """
    if config.wrench == "constant":
        return np.tile(config.scale * np.array(config.wrench_value), (count, 1))
    if config.wrench == "paper_path":
        return config.scale * paper_path(np.arange(count) / config.control_rate)
    if config.wrench == "random":
        return _ornstein_uhlenbeck(config, rng, count)
    return np.zeros((count, 6))


def _ornstein_uhlenbeck(config: EnvConfig, rng: np.random.Generator, count: int) -> Array:
    deviation = np.repeat([config.random_force, config.random_moment], 3)
    keep = np.exp(-1.0 / (config.control_rate * config.random_time))
    noise = rng.standard_normal((count, 6)) * deviation
    path = np.empty((count, 6))
    value = np.zeros(6)  # starts at rest, as the settled hand does
    for k in range(count):
        path[k] = value
        value = keep * value + np.sqrt(1.0 - keep**2) * noise[k]
    return path
