"""Settings of the controller's sensors: delay, noise, and the estimate of the external wrench."""

from __future__ import annotations

import math

import numpy as np

from grasp_env import core
from grasp_env.config import EnvConfig
from grasp_env.inputs.arguments import Array


def sensor_settings(config: EnvConfig) -> core.SensorSettings:
    """Return the settings of the core's sensors."""
    sensors = config.sensors
    settings = core.SensorSettings()
    settings.wrench = getattr(core.WrenchSource, sensors.wrench)
    settings.tick = 1.0 / config.controller.rate
    settings.keep = keep_factor(sensors.estimator_time, settings.tick)
    settings.joint_delay = joint_ticks(config)
    settings.delay = late_ticks(config)
    settings.wrench_delay = sensors.wrench_delay
    settings.pose_noise = sensors.pose_noise
    settings.tactile_noise = sensors.tactile_noise
    return settings


def late_ticks(config: EnvConfig) -> int:
    """Return the delay of contacts and pose in whole control ticks."""
    return config.controller.ticks(config.sensors.delay)


def joint_ticks(config: EnvConfig) -> int:
    """Return the delay of the joints in whole control ticks."""
    return config.controller.ticks(config.sensors.joint_delay)


def keep_factor(time: float, tick: float) -> float:
    """Return the share that a first-order filter of time constant `time` keeps over `tick` [s]."""
    return math.exp(-tick / time) if time > 1e-3 * tick else 0.0


class NoiseRows:
    """Rows of `width` standard normal numbers.

    Row k depends only on the seed and k, so a longer run has the same beginning.
    """

    _BLOCK = 64

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng = rng
        self._rows = np.empty((self._BLOCK, width))
        self._next = self._BLOCK

    def __call__(self) -> Array:
        """Return the next row (width,): a view, valid until the next call."""
        if self._next == self._BLOCK:
            self._rng.standard_normal(out=self._rows)
            self._next = 0
        self._next += 1
        return self._rows[self._next - 1]
