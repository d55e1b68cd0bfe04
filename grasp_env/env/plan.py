"""The plan of an episode: disturbance, gravity, mass and target at every control tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.inputs.arguments import Array
from grasp_env.task.disturbance import disturb


@dataclass(frozen=True)
class Plan:
    """Plan of an episode, one row per control tick; row k holds from tick k to tick k + 1.

    Attributes:
        wrench: (T, 6) external wrench on the object [N, N m], object frame.
        push: (T, 3) force at the object's centre [N], world frame.
        gravity: (T, 3) gravity [m/s^2], world frame.
        target: (T, 19) desired motion of the object, world frame; see `grasp_env.task.motion`.
        mass_factor: (T,) factor on the object's mass.
    """

    wrench: Array
    push: Array
    gravity: Array
    target: Array
    mass_factor: Array

    def __len__(self) -> int:
        return len(self.wrench)


def make_plan(config: EnvConfig, rng: np.random.Generator, mass: float) -> Plan:
    """Make the plan of one episode of `resolved` settings for an object of a mass [kg].

    It has T = round(limits.duration * controller.rate) + 1 rows. It draws once from the generator.
    A seed gives the same disturbance for every duration: a longer episode extends a shorter one.
    (Only the desired motion of "move" depends on the duration, as it ends at rest.)
    """
    generator = np.random.default_rng(int(rng.integers(2**63)))
    limits, disturbance, task = config.limits, config.disturbance, config.task
    assert limits.duration is not None
    assert disturbance is not None
    rate = config.controller.rate
    tick = 1.0 / rate
    times = np.arange(round(limits.duration * rate) + 1) / rate
    wrench, gravity = disturb(disturbance, times, generator, config)
    push, target = task.push(times, tick, mass), task.target(times, tick)
    return Plan(wrench, push, gravity, target, task.mass_factor(times))
