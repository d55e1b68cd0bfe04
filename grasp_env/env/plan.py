"""What happens to the object in an episode, planned for every control tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array
from grasp_env.config import EnvConfig
from grasp_env.task.disturbance import DISTURBANCES, disturb, six_pushes
from grasp_env.task.motion import blend, motion_target, resting_target

PAYLOAD_RAMP = 0.1
"""[s] in which the mass of "payload" changes."""


@dataclass(frozen=True)
class Plan:
    """What happens to the object in an episode, one row per control tick; row k holds from tick k to tick k + 1.

    Attributes:
        wrench: (T, 6) external wrench on the object [N, N m], object frame.
        push: (T, 3) force at the object's centre [N], world frame.
        gravity: (T, 3) [m/s^2], world frame.
        target: (T, 19) desired motion of the object, world frame; see `grasp_env.task.motion`.
        mass_factor: (T,) of the object's mass.
    """

    wrench: Array
    push: Array
    gravity: Array
    target: Array
    mass_factor: Array

    def __len__(self) -> int:
        return len(self.wrench)


def make_plan(config: EnvConfig, rng: np.random.Generator, mass: float) -> Plan:
    """The plan of one episode, T = round(duration * control_rate) + 1 rows.

    A seed gives the same disturbance whatever the duration: a longer episode extends a shorter one. (Only the desired
    motion of "move" knows its end, to be at rest there.)

    Args:
        config: the settings, `resolved`.
        rng: drawn from once, whatever the settings.
        mass: [kg] of the object, for the pushes of "six_directions".
    """
    own = np.random.default_rng(int(rng.integers(2**63)))
    assert config.duration is not None
    ticks = round(config.duration * config.control_rate) + 1
    times = np.arange(ticks) / config.control_rate
    tick = 1.0 / config.control_rate
    push, factor, target = np.zeros((ticks, 3)), np.ones(ticks), resting_target(ticks)
    if config.task == "six_directions":
        push = six_pushes(times, config.push_per_mass * mass, max(config.push_time, tick))
    disturbance = "none" if config.task == "six_directions" else config.disturbance
    assert disturbance is not None
    rule = DISTURBANCES[disturbance] if isinstance(disturbance, str) else disturbance
    wrench, gravity = disturb(rule, times, own, config)
    if config.task == "move":
        assert config.motion_size is not None
        target = motion_target(config.motion, times, config.motion_size, max(config.motion_period, tick))
    elif config.task == "payload":
        factor += (config.payload_factor - 1.0) * blend((times - config.payload_time) / PAYLOAD_RAMP)[0]
    return Plan(wrench, push, gravity, target, factor)
