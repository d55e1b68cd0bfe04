"""Tasks: what is asked of the grasp in an episode, and what counts as success."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from grasp_env._check import Array
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Settings, any_of, one_of, real, setting
from grasp_env.task.disturbance import ConstantWrench, DisturbanceSettings, NoDisturbance
from grasp_env.task.motion import MOTION_SIZES, MOTIONS, blend, motion_target, resting_target

PAYLOAD_RAMP = 0.1
"""[s] in which the mass of "payload" changes."""
PUSH_RAMP = 0.05
"""[s] in which a push of "six_directions" changes into the next, at most a quarter of `push_time`."""


@dataclass(frozen=True)
class Task(Settings):
    """A kind of episode: a record of its numbers. Another one is a class here and its place in `TASKS`.

    Example:
        >>> Hold().duration, SixDirections(push_time=1.0).duration
        (2.0, 6.0)
        >>> SixDirections().in_place(drift=0.04, tilt=0.2), SixDirections().in_place(drift=0.04, tilt=0.3)
        (True, False)
    """

    disturbance: ClassVar[DisturbanceSettings] = NoDisturbance()
    """The default disturbance."""
    pushes: ClassVar[bool] = False
    """True if the task pushes the object itself; then no disturbance may be given."""
    max_drift: ClassVar[float] = 0.02
    """[m] at which the object counts as lost unless settings say otherwise."""
    max_tilt: ClassVar[float] = 0.35
    """[rad], the same."""
    drift_limit: ClassVar[float] = math.inf
    """[m] below which the object must be from its place for success; infinite: only not lost."""
    tilt_limit: ClassVar[float] = math.inf
    """[rad], the same."""
    duration: ClassVar[Any] = 4.0
    """[s] of an episode, unless given."""
    caption: ClassVar[str] = ""
    """A short description for pictures, with settings in braces."""

    def push(self, times: Array, tick: float, mass: float) -> Array:
        """(T, 3) force at the object's centre [N], world frame.

        Args:
            times: (T,) of the control ticks [s].
            tick: between them [s].
            mass: of the object [kg].
        """
        return np.zeros((len(times), 3))

    def target(self, times: Array, tick: float) -> Array:
        """(T, 19) desired motion of the object, see `grasp_env.task.motion`; arguments as of `push`: times and tick."""
        return resting_target(len(times))

    def mass_factor(self, times: Array) -> Array:
        """(T,) by which the object's mass has grown at the times (T,)."""
        return np.ones(len(times))

    def in_place(self, drift: float, tilt: float) -> bool:
        """Returns True if an object there is near enough to its place for success.

        Args:
            drift: [m] of the object from where it should be.
            tilt: [rad] of the object from how it should stand.
        """
        return bool(drift < self.drift_limit) and bool(tilt < self.tilt_limit)


@dataclass(frozen=True)
class Hold(Task):
    """Hold the object in place against the disturbance."""

    name: ClassVar[str] = "hold"
    disturbance: ClassVar[DisturbanceSettings] = ConstantWrench()
    duration: ClassVar[Any] = 2.0


@dataclass(frozen=True)
class Move(Task):
    """Follow a motion of the object: gravity and inertia must be balanced."""

    name: ClassVar[str] = "move"
    caption: ClassVar[str] = "{motion}"

    motion: str = setting("lift", one_of(MOTIONS), "Motion of the object.")
    size: float | None = setting(
        None, real(POSITIVE), "How far: lift and shake in metres, rotate in radians.", unit="m or rad",
        none=f"{MOTION_SIZES['lift']:g} m, {MOTION_SIZES['rotate']:g} rad",
    )  # fmt: skip
    period: float = setting(1.0, real(POSITIVE), "Duration of one motion.", unit="s")

    def target(self, times: Array, tick: float) -> Array:
        """See `Task`: times [s], tick [s]."""
        size = MOTION_SIZES[self.motion] if self.size is None else self.size
        return motion_target(self.motion, times, size, max(self.period, tick))


@dataclass(frozen=True)
class Payload(Task):
    """Hold while the mass changes, which the controller is not told."""

    name: ClassVar[str] = "payload"
    caption: ClassVar[str] = "{factor:g} times the mass at {time:g} s"

    factor: float = setting(2.0, real(POSITIVE), "Factor by which the mass changes.")
    time: float = setting(1.0, real(NOT_NEGATIVE), "When it changes.", unit="s")

    def mass_factor(self, times: Array) -> Array:
        """See `Task`: times [s]."""
        return 1.0 + (self.factor - 1.0) * blend((times - self.time) / PAYLOAD_RAMP)[0]


@dataclass(frozen=True)
class SixDirections(Task):
    """Pushes along +x, -x, +y, -y, +z, -z in one episode; success is to stay below 50 mm and 15 degrees.

    DexGraspBench pushes so, and starts a fresh grasp for each.
    """

    name: ClassVar[str] = "six_directions"
    caption: ClassVar[str] = "pushes of {push_per_mass:g} N/kg"
    pushes: ClassVar[bool] = True
    max_drift = drift_limit = 0.05
    max_tilt = tilt_limit = math.radians(15.0)

    push_per_mass: float = setting(10.0, real(NOT_NEGATIVE), "Force per mass of the object.", unit="N/kg")
    push_time: float = setting(2.0, real(POSITIVE), "Duration of each push.", unit="s")

    @property
    def duration(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Task`."""
        return 6.0 * self.push_time

    def push(self, times: Array, tick: float, mass: float) -> Array:
        """See `Task`: times [s], tick [s], mass [kg].

        Each push grows out of the one before by a minimum-jerk ramp: a step would ask for a jump of the contact forces.
        """
        length, pushes = max(self.push_time, tick), np.zeros((8, 3))  # nothing before the first and after the last
        pushes[1:7:2] = self.push_per_mass * mass * np.eye(3)
        pushes[2:7:2] = -pushes[1:7:2]
        index = np.minimum(times / length, 6.0).astype(np.int64)
        share = blend((times - index * length) / min(PUSH_RAMP, 0.25 * length))[0][:, None]
        return (1.0 - share) * pushes[index] + share * pushes[index + 1]


TASKS: dict[str, type[Task]] = {made.name: made for made in (Hold, Move, Payload, SixDirections)}
"""The tasks by name."""
TASK = any_of(TASKS, Task, ", or give its settings, such as Move(motion='lift')")
"""The kind of a setting that holds a task."""
