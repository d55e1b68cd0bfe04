"""Disturbances over an episode: wrenches and tilting gravity, a row per control tick."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError, shown
from grasp_env.grasp.wrench import PAPER_CONSTANT, paper_path
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array, call_user
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Settings, any_of, numbers, real, setting
from grasp_env.task.motion import blend

_BLOCK = 64
"""Number of impulses drawn at a time: fixed, so that a longer episode extends a shorter one."""


@dataclass(frozen=True)
class Disturbed:
    """Disturbance of an episode in T rows; row k acts from control tick k to k + 1.

    Attributes:
        wrench: (T, 6) external wrench on the object [N, N m], object frame; None: no wrench.
        gravity: (T, 3) gravity [m/s^2], world frame; None: that of the settings.

    Example:
        >>> def lighter(times, rng, settings):
        ...     return Disturbed(gravity=np.outer(1.0 - 0.5 * times / times[-1], settings.gravity))
        >>> import gymnasium as gym
        >>> env = gym.make("grasp_env:FourFingerGrasp-v0", disturbance=lighter)
        >>> _ = env.reset(seed=0)
        >>> env.close()
    """

    wrench: ArrayLike | None = None
    gravity: ArrayLike | None = None


Disturbance: TypeAlias = "Callable[[Array, np.random.Generator, Any], ArrayLike | Disturbed]"
"""Function f(times, rng, settings) -> (T, 6) wrenches [N, N m] in the object frame, or a
`Disturbed`.

times: (T,) of the control ticks [s]; rng: a generator for this episode's disturbance; settings: the
`EnvConfig`. If the order of draws from rng does not depend on T, a seed gives the same disturbance
in a longer episode."""


def name_of(disturbance: Disturbance | None) -> str:
    """Return the name of a built-in disturbance or of a function; "" if it has none."""
    built_in = isinstance(disturbance, DisturbanceSettings)
    name = getattr(disturbance, "name" if built_in else "__name__", "")
    return name if isinstance(name, str) else ""


def disturb(
    rule: Disturbance, times: Array, rng: np.random.Generator, settings: Any
) -> tuple[Array, Array]:
    """Return the `Disturbed` arrays of a disturbance."""
    what = f"the disturbance {name_of(rule) or shown(rule)}"
    rows = len(times)
    takes = "a disturbance takes (times, rng, settings) and returns (T, 6) wrenches [N, N m], a row per tick"
    result = call_user(rule, times.copy(), rng, settings, what=what, takes=takes)
    if result is None:
        raise InvalidInputError(
            f"what {what} returns must be (T, 6) wrenches [N, N m] or a Disturbed, got None: does it end in a return?"
        )

    def checked(value: ArrayLike | None, default: ArrayLike, name: str) -> Array:
        if value is None:
            return np.tile(default, (rows, 1))
        what_returns = f"what {what} returns ({name}, a row per tick)"
        return as_array(value, (rows, np.size(default)), what_returns, ranges.SIZE)

    acts = result if isinstance(result, Disturbed) else Disturbed(result)
    wrench = checked(acts.wrench, np.zeros(6), "wrench [N, N m]")
    return wrench, checked(acts.gravity, settings.gravity, "gravity [m/s^2]")


@dataclass(frozen=True)
class DisturbanceSettings(Settings):
    """Base class of the built-in disturbances: records that are called like a user's function.

    Example:
        >>> from grasp_env.config import EnvConfig
        >>> ConstantWrench(scale=0.5)(np.arange(2), np.random.default_rng(0), EnvConfig())[0, :3]
        array([ 0.5 ,  0.25, -0.3 ])
    """

    def __call__(
        self, times: Array, rng: np.random.Generator, settings: Any
    ) -> ArrayLike | Disturbed:
        """See `Disturbance`."""
        return Disturbed()


@dataclass(frozen=True)
class NoDisturbance(DisturbanceSettings):
    """No disturbance: gravity alone."""

    name: ClassVar[str] = "none"


@dataclass(frozen=True)
class ConstantWrench(DisturbanceSettings):
    """A constant wrench, by default the paper's."""

    name: ClassVar[str] = "constant"

    value: tuple[float, ...] = setting(
        PAPER_CONSTANT, numbers(6), "Force and moment, object frame.", unit="N, N m"
    )
    scale: float = setting(1.0, real(), "Factor on the wrench.")

    def __call__(self, times: Array, rng: np.random.Generator, settings: Any) -> Array:
        """See `Disturbance`."""
        return np.tile(self.scale * np.array(self.value), (len(times), 1))


@dataclass(frozen=True)
class PaperPath(DisturbanceSettings):
    """The paper's W_ext(t).

    Its moment about z peaks at 1 N m, which takes 153 N of normal force and 9 N m at the joints;
    motors of a hand of this size deliver about a tenth.
    """

    name: ClassVar[str] = "paper_path"

    scale: float = setting(0.1, real(), "Factor on the wrench.")

    def __call__(self, times: Array, rng: np.random.Generator, settings: Any) -> Array:
        """See `Disturbance`."""
        return self.scale * paper_path(times)


@dataclass(frozen=True)
class RandomWrench(DisturbanceSettings):
    """An Ornstein-Uhlenbeck process per axis; it starts at zero, as the hand has settled."""

    name: ClassVar[str] = "random"

    force: float = setting(
        0.6, real(NOT_NEGATIVE), "Standard deviation of the force along each axis.", unit="N"
    )
    moment: float = setting(
        0.02, real(NOT_NEGATIVE), "Standard deviation of the moment about each axis.", unit="N m"
    )
    time: float = setting(0.3, real(POSITIVE), "Correlation time.", unit="s")

    def __call__(self, times: Array, rng: np.random.Generator, settings: Any) -> Array:
        """See `Disturbance`."""
        ticks = self.time / (1.0 / settings.controller.rate)
        decay = 1.0 / max(ticks, 1e-3)  # a shorter correlation time changes nothing
        path = rng.standard_normal((len(times), 6))
        path *= math.sqrt(-math.expm1(-2.0 * decay)) * np.repeat([self.force, self.moment], 3)
        path[0] = 0.0
        keep = math.exp(-decay)
        # scipy.signal.lfilter computes the same, but takes half a second to import
        for column in path.T:
            column[:] = list(
                accumulate(column.tolist(), lambda before, drawn: drawn + keep * before)
            )
        return path


@dataclass(frozen=True)
class Impulses(DisturbanceSettings):
    """Half-sine pushes and twists in random directions, with exponential waits between them.

    Each row is the mean over its tick, so an impulse of any duration delivers 2 / pi * force * time
    [N s]. A wait runs from the end of one impulse to the start of the next, and starts are at least
    a tick apart.
    """

    name: ClassVar[str] = "impulses"

    force: float = setting(
        5.0, real(NOT_NEGATIVE), "Peak force, in a direction uniform on the sphere.", unit="N"
    )
    moment: float = setting(
        0.1, real(NOT_NEGATIVE), "Peak moment, in another direction.", unit="N m"
    )
    time: float = setting(0.05, real(POSITIVE), "Duration of an impulse.", unit="s")
    interval: float = setting(0.5, real(POSITIVE), "Mean of the waits.", unit="s")

    def __call__(self, times: Array, rng: np.random.Generator, settings: Any) -> Array:
        """See `Disturbance`."""
        tick = 1.0 / settings.controller.rate
        length = max(self.time, 1e-6 * tick)
        steps = [np.array([-length])]
        peaks = [np.zeros((1, 6))]  # a first impulse of zero, which ends at time 0
        end = len(times) * tick
        reached = -length
        while reached <= end:
            direction = rng.standard_normal((_BLOCK, 2, 3))
            direction *= np.array([[self.force], [self.moment]]) / np.sqrt(
                (direction**2).sum(axis=2, keepdims=True)
            )
            steps.append(
                np.maximum(length + self.interval * rng.standard_exponential(_BLOCK), tick)
            )
            peaks.append(direction.reshape(_BLOCK, 6))
            reached += float(steps[-1].sum())
        starts = np.cumsum(np.concatenate(steps))
        impulses = np.concatenate(peaks) * (2.0 * length / np.pi)
        before = np.cumsum(impulses, axis=0) - impulses
        edges = np.arange(len(times) + 1) * tick
        last = np.searchsorted(starts, edges, side="right") - 1
        share = 0.5 - 0.5 * np.cos(np.pi * np.clip((edges - starts[last]) / length, 0.0, 1.0))
        return np.ascontiguousarray(
            np.diff(before[last] + share[:, None] * impulses[last], axis=0) / tick
        )


@dataclass(frozen=True)
class TiltingGravity(DisturbanceSettings):
    """Gravity swings about a random horizontal axis, as if the hand were tilted slowly.

    The swing is a sinusoid that fades in over its first period, so it starts upright and at rest.
    """

    name: ClassVar[str] = "tilting_gravity"

    angle: float = setting(0.7, real(NOT_NEGATIVE), "Largest tilt to either side.", unit="rad")
    period: float = setting(2.0, real(POSITIVE), "Period of the swing.", unit="s")

    def __call__(self, times: Array, rng: np.random.Generator, settings: Any) -> Disturbed:
        """See `Disturbance`."""
        gravity = np.array(settings.gravity)
        heading = 2.0 * np.pi * rng.random()
        size = float(np.sqrt((gravity**2).sum()))
        if size == 0.0:
            return Disturbed()
        down = gravity / size
        first = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
        first /= np.sqrt((first**2).sum())
        sideways = np.cos(heading) * first + np.sin(heading) * np.cross(down, first)
        phase = times / max(self.period, 1.0 / settings.controller.rate)
        tilt = self.angle * blend(phase)[0] * np.sin(2.0 * np.pi * phase)
        return Disturbed(
            gravity=size * (np.cos(tilt)[:, None] * down + np.sin(tilt)[:, None] * sideways)
        )


DISTURBANCES: dict[str, type[DisturbanceSettings]] = {
    kind.name: kind
    for kind in (NoDisturbance, ConstantWrench, PaperPath, RandomWrench, Impulses, TiltingGravity)
}
"""The built-in disturbances, by name."""
DISTURBANCE = any_of(
    DISTURBANCES,
    DisturbanceSettings,
    ", or give {'name': 'constant', 'value': (fx, fy, fz, mx, my, mz)} or a function f(times, rng, settings) -> (T, 6) wrenches [N, N m]",
    calls=True,
)
"""Kind of a setting that holds a disturbance."""
