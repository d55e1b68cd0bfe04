"""Tasks: what is asked of the grasp in an episode, planned for every control tick, and what counts as success."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from grasp_env._check import Array
from grasp_env.disturbance import DISTURBANCES, disturb, six_pushes
from grasp_env.motion import MOTION_SIZES, MOTIONS, blend, motion_target, resting_target

if TYPE_CHECKING:
    from grasp_env.config import EnvConfig

__all__ = ["DISTURBANCES", "MOTIONS", "TASKS", "Plan", "Task", "make_plan", "succeeded"]

PAYLOAD_RAMP = 0.1
"""[s] in which the mass of "payload" changes."""


@dataclass(frozen=True)
class Task:
    """A kind of episode.

    Attributes:
        duration: [s] of an episode, unless given.
        disturbance: a key of `DISTURBANCES`, unless given.
        description: one line.
        drift_limit: [m] and tilt_limit: [rad] below which the object must be for success; infinite: only not lost.
    """

    duration: float
    disturbance: str
    description: str
    drift_limit: float = math.inf
    tilt_limit: float = math.inf


TASKS: dict[str, Task] = {
    "hold": Task(2.0, "constant", "hold the object in place against the disturbance"),
    "move": Task(4.0, "none", "follow the object trajectory `motion`; gravity and inertia must be balanced"),
    "payload": Task(4.0, "none", "hold while the mass, which nobody tells, changes by `payload_factor`"),
    "six_directions": Task(
        12.0,
        "none",
        "pushes of 10 N/kg along +x, -x, +y, -y, +z, -z for 2 s each, in one episode (DexGraspBench, which starts a "
        "fresh grasp for each); below 50 mm and 15 degrees",
        drift_limit=0.05,
        tilt_limit=math.radians(15.0),
    ),
}
"""What `task` may be."""


@dataclass(frozen=True)
class Plan:
    """What happens to the object in an episode, one row per control tick; row k holds from tick k to tick k + 1.

    Attributes:
        wrench: (T, 6) external wrench on the object [N, N m], object frame.
        push: (T, 3) force at the object's centre [N], world frame.
        gravity: (T, 3) [m/s^2], world frame.
        target: (T, 19) desired motion of the object, world frame; see `grasp_env.motion`.
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
        config: the settings; where `duration`, `disturbance` or `motion_size` is None, the task's or motion's own.
        rng: drawn from once, whatever the settings.
        mass: [kg] of the object, for the pushes of "six_directions".
    """
    own = np.random.default_rng(int(rng.integers(2**63)))
    task = TASKS[config.task]
    duration = task.duration if config.duration is None else config.duration
    disturbance = task.disturbance if config.disturbance is None else config.disturbance
    ticks = round(duration * config.control_rate) + 1
    times = np.arange(ticks) / config.control_rate
    tick = 1.0 / config.control_rate
    push, factor, target = np.zeros((ticks, 3)), np.ones(ticks), resting_target(ticks)
    if config.task == "six_directions":
        disturbance = "none"
        push = six_pushes(times, config.push_per_mass * mass, max(config.push_time, tick))
    rule = DISTURBANCES[disturbance] if isinstance(disturbance, str) else disturbance
    wrench, gravity = disturb(rule, times, own, config)
    if config.task == "move":
        size = MOTION_SIZES[config.motion] if config.motion_size is None else config.motion_size
        target = motion_target(config.motion, times, size, max(config.motion_period, tick))
    elif config.task == "payload":
        factor += (config.payload_factor - 1.0) * blend((times - config.payload_time) / PAYLOAD_RAMP)[0]
    return Plan(wrench, push, gravity, target, factor)


def succeeded(task: str, drift: float, tilt: float, failed: bool) -> bool:
    """Whether an episode that ends here is a success.

    Args:
        task: a key of `TASKS`.
        drift: [m] of the object from where it should be.
        tilt: [rad] of the object from how it should stand.
        failed: whether the object was lost.

    Example:
        >>> succeeded("six_directions", drift=0.04, tilt=0.2, failed=False)
        True
        >>> succeeded("six_directions", drift=0.04, tilt=0.3, failed=False)
        False
    """
    limits = TASKS[task]
    return not failed and bool(drift < limits.drift_limit) and bool(tilt < limits.tilt_limit)
