"""Tasks of an episode and their criteria of success."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Settings, any_of, one_of, real, setting
from grasp_env.task.disturbance import ConstantWrench, DisturbanceSettings, NoDisturbance
from grasp_env.task.motion import MOTION_SIZES, MOTIONS, blend, motion_target, resting_target

PAYLOAD_RAMP = 0.1
"""Time [s] in which the mass of "payload" changes."""
PUSH_RAMP = 0.05
"""Time [s] in which a push of "six_directions" changes into the next; at most `push_time` / 4."""


@dataclass(frozen=True)
class Task(Settings):
    """Base class of the tasks, which are entries of `TASKS`.

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
    """Default distance [m] from its place at which the object counts as lost."""
    max_tilt: ClassVar[float] = 0.35
    """Default angle [rad] at which the object counts as lost."""
    drift_limit: ClassVar[float] = math.inf
    """Largest distance [m] for success."""
    tilt_limit: ClassVar[float] = math.inf
    """Largest angle [rad] for success."""
    duration: ClassVar[Any] = 4.0
    """Default duration of an episode [s]."""
    caption: ClassVar[str] = ""
    """A short description for pictures, with settings in braces."""

    def push(self, times: Array, tick: float, mass: float) -> Array:
        """Return the force (T, 3) [N] at the object's centre, world frame, at `times` (T,) [s].

        The object has a `mass` [kg]; times are a `tick` [s] apart.
        """
        return np.zeros((len(times), 3))

    def target(self, times: Array, tick: float) -> Array:
        """Return the motion (T, 19) of the object; `times` and `tick` are as in `push`."""
        return resting_target(len(times))

    def mass_factor(self, times: Array) -> Array:
        """Return the factors (T,) on the object's mass at the times (T,)."""
        return np.ones(len(times))

    def in_place(self, drift: float, tilt: float) -> bool:
        """True if `drift` [m] and `tilt` [rad] from the target are small enough for success."""
        return bool(drift < self.drift_limit) and bool(tilt < self.tilt_limit)


@dataclass(frozen=True)
class Hold(Task):
    """Hold the object in place against the disturbance."""

    name: ClassVar[str] = "hold"
    disturbance: ClassVar[DisturbanceSettings] = ConstantWrench()
    duration: ClassVar[Any] = 2.0


@dataclass(frozen=True)
class Move(Task):
    """Move the object along a path: the forces must balance gravity and inertia."""

    name: ClassVar[str] = "move"
    caption: ClassVar[str] = "{motion}"

    motion: str = setting("lift", one_of(MOTIONS), "Motion of the object.")
    size: float | None = setting(
        None,
        real(POSITIVE),
        "Size of the motion: lift and shake in metres, rotate in radians.",
        unit="m or rad",
        none=f"{MOTION_SIZES['lift']:g} m, {MOTION_SIZES['rotate']:g} rad",
    )
    period: float = setting(1.0, real(POSITIVE), "Duration of one motion.", unit="s")

    def target(self, times: Array, tick: float) -> Array:
        """See `Task`: times, tick."""
        size = MOTION_SIZES[self.motion] if self.size is None else self.size
        return motion_target(self.motion, times, size, max(self.period, tick))


@dataclass(frozen=True)
class Payload(Task):
    """Hold while the mass changes, unknown to the controller."""

    name: ClassVar[str] = "payload"
    caption: ClassVar[str] = "{factor:g} times the mass at {time:g} s"

    factor: float = setting(2.0, real(POSITIVE), "Factor by which the mass changes.")
    time: float = setting(1.0, real(NOT_NEGATIVE), "Time of the change.", unit="s")

    def mass_factor(self, times: Array) -> Array:
        """See `Task`: times."""
        return 1.0 + (self.factor - 1.0) * blend((times - self.time) / PAYLOAD_RAMP)[0]


@dataclass(frozen=True)
class SixDirections(Task):
    """Hold against pushes along +x, -x, +y, -y, +z, -z, within 50 mm and 15 degrees.

    DexGraspBench applies the same pushes, with a new grasp for each.
    """

    name: ClassVar[str] = "six_directions"
    caption: ClassVar[str] = "pushes of {push_per_mass:g} N/kg"
    pushes: ClassVar[bool] = True
    max_drift = drift_limit = 0.05
    max_tilt = tilt_limit = math.radians(15.0)

    push_per_mass: float = setting(
        10.0, real(NOT_NEGATIVE), "Force per mass of the object.", unit="N/kg"
    )
    push_time: float = setting(2.0, real(POSITIVE), "Duration of each push.", unit="s")

    @property
    def duration(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `Task`."""
        return 6.0 * self.push_time

    def push(self, times: Array, tick: float, mass: float) -> Array:
        """See `Task`: times, tick, mass. Pushes change into each other by minimum-jerk ramps."""
        length = max(self.push_time, tick)
        pushes = np.zeros((8, 3))  # zero before the first push and after the last
        pushes[1:7:2] = self.push_per_mass * mass * np.eye(3)
        pushes[2:7:2] = -pushes[1:7:2]
        index = np.minimum(times / length, 6.0).astype(np.int64)
        share = blend((times - index * length) / min(PUSH_RAMP, 0.25 * length))[0][:, None]
        return (1.0 - share) * pushes[index] + share * pushes[index + 1]


TASKS: dict[str, type[Task]] = {task.name: task for task in (Hold, Move, Payload, SixDirections)}
"""The tasks, by name."""
TASK = any_of(TASKS, Task, ", or give its settings, such as Move(motion='lift')")
"""Kind of a setting that holds a task."""
