"""Motors of the hand: from commanded to delivered torques."""

from __future__ import annotations

import math

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.control.sensing import NoiseRows, keep_factor
from grasp_env.inputs.arguments import Array


class Motors:
    """The motors of an episode, whose errors the controller does not know.

    Joint friction is not among them: the engine simulates it.

    Args:
        config: The settings of the episode.
        limits: (M,) largest torques [N m].
        seed: Seed of the errors.

    Attributes:
        ideal: True if the motors deliver what is commanded.

    Example:
        >>> config = EnvConfig(motors={"strength": 0.9})
        >>> Motors(config, np.ones(2), seed=0)([0.5, 2.0])
        [0.45, 1.0]
    """

    def __init__(self, config: EnvConfig, limits: Array, seed: int) -> None:
        motors = config.motors
        self.ideal = motors.strength == 1.0 and not (
            motors.noise or motors.drift or motors.gain_error
        )
        self._limits = limits
        count = len(limits)
        # streams of their own: one error does not change the draws of another
        self._rows = NoiseRows(np.random.default_rng(seed), count)
        self._steps = NoiseRows(np.random.default_rng([seed, 1]), count)
        self._gain = motors.gain_error * np.random.default_rng([seed, 2]).standard_normal(count)
        self._strength = motors.strength
        self._noise = motors.noise
        self._every = max(1, config.controller.ticks(motors.noise_time))
        self._drift = motors.drift
        self._keep = keep_factor(motors.drift_time, 1.0 / config.controller.rate)
        self._fast = np.zeros(count)
        self._slow: Array | None = None
        self._tick = 0

    def __call__(self, torques: list[float]) -> list[float]:
        """Return the delivered torques (M,) of a control tick [N m], within the limits."""
        if self._noise and self._tick % self._every == 0:
            self._fast = self._noise * self._rows()
        error = self._gain + self._fast
        if self._drift:
            error = error + self._drift * self._slowly()
        self._tick += 1
        delivered = np.array(torques) * (self._strength * (1.0 + error))
        return np.clip(delivered, -self._limits, self._limits).tolist()

    def _slowly(self) -> Array:
        """Return the next state (M,) of the slow process, with standard deviation 1."""
        step = self._steps()
        last = self._slow
        now: Array = step.copy()
        if last is not None:
            now = self._keep * last + math.sqrt(1.0 - self._keep**2) * step
        self._slow = now
        return now
