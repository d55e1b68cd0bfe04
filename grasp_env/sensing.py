"""What the controller sees of the scene: late and noisy where asked for, else the scene's own numbers."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env.config import EnvConfig
from grasp_env.estimation import Delay, NoiseRows, add_force_noise
from grasp_env.prediction import carry_forward
from grasp_env.sim.scene import Scene
from grasp_env.sim.snapshot import Snapshot, split


class Sensors:
    """Late by `sensor_delay`, which the controller knows and makes good by `carry_forward`; with `pose_noise` and `tactile_noise`.

    Args:
        config: the settings.
        scene: what is looked at.

    Attributes:
        exact: whether the numbers of now are seen as they are. prompt: whether the wrench is, too.
    """

    def __init__(self, config: EnvConfig, scene: Scene) -> None:
        self.config, self._scene = config, scene
        hand = scene.config.hand
        self.exact = not (config.sensor_delay or config.pose_noise or config.tactile_noise)
        self.buffer = scene.buffer if self.exact else scene.buffer.copy()
        self.snapshot: Snapshot = split(self.buffer, hand.finger_count, hand.joint_count)
        ticks = int(np.ceil(config.sensor_delay * config.control_rate - 1e-9))
        self._delay, self._time = Delay(ticks, len(self.buffer)), ticks / config.control_rate
        self._late = Delay(ticks + config.wrench_delay, 6)
        self.prompt = self.exact and not self._late.ticks
        self._width = 3 + 3 * hand.finger_count

    def reset(self, rng: np.random.Generator) -> None:
        """A new episode: draws the noise from `rng` (one number, whatever the settings); before it the scene stood still."""
        self._noise = NoiseRows(np.random.default_rng(int(rng.integers(2**63))), self._width)
        self._scene.look()
        self.rewind()

    def rewind(self) -> None:
        """As before the first tick: what was seen since `reset` was not yet."""
        self._delay.reset(self._scene.buffer)
        self._late.reset(np.zeros(6))

    def see(self) -> Snapshot:
        """The scene as it is seen now; call once per control tick."""
        now = self._scene.look()
        if self.exact:
            return now
        self.buffer[:] = self._delay(self._scene.buffer)
        seen, noise = self.snapshot, self._noise()
        seen.position[:] += self.config.pose_noise * noise[:3]
        add_force_noise(seen.forces, self.config.tactile_noise, noise[3:], seen.forces)
        if self._time:
            carry_forward(*self._scene.observed, self._time, self.buffer)
        return seen

    def told(self, wrench: Array) -> Array:
        """The external wrench (6,) as it is known now, where it is measured."""
        return self._late(wrench) if self._late.ticks else wrench
