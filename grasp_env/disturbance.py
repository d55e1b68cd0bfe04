"""The external wrench over an episode, one value per control step."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.config import EnvConfig
from grasp_env.grasp.wrench import paper_path


class Disturbance:
    """External wrenches [N, N m], object frame, by control step; "random" is drawn as far as it is asked for.

    Args:
        config: which wrench, and how strong.
        rng: source of the seed of "random"; drawn from once, whatever the wrench.
    """

    def __init__(self, config: EnvConfig, rng: np.random.Generator) -> None:
        self.config = config
        self._rng = np.random.default_rng(int(rng.integers(2**63)))
        self._constant = config.scale * np.array(config.wrench_value)
        self._path = np.zeros((1, 6))  # starts at rest, as the settled hand does

    def at(self, step: int) -> Wrench:
        """The wrench (6,) during control step `step` >= 0."""
        kind = self.config.wrench
        if kind == "constant":
            return self._constant.copy()
        if kind == "paper_path":
            return self.config.scale * paper_path(step / self.config.control_rate)
        if kind == "random":
            while step >= len(self._path):
                self._path = np.concatenate([self._path, self._ornstein_uhlenbeck(500)])
            return self._path[step].copy()
        return np.zeros(6)

    def _ornstein_uhlenbeck(self, count: int) -> Array:
        """The next `count` values, from the last one on."""
        config = self.config
        deviation = np.repeat([config.random_force, config.random_moment], 3)
        keep = np.exp(-1.0 / (config.control_rate * config.random_time))
        noise = np.sqrt(1.0 - keep**2) * deviation * self._rng.standard_normal((count, 6))
        value = self._path[-1]
        for row in noise:
            value = row[:] = keep * value + row
        return noise
