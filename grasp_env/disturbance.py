"""What disturbs the object over an episode: external wrenches, tilting gravity, pushes; one row per control tick."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from grasp_env._check import Array
from grasp_env._compile import compiled
from grasp_env.grasp.wrench import paper_path
from grasp_env.motion import blend

if TYPE_CHECKING:
    from grasp_env.config import EnvConfig

DISTURBANCES: dict[str, str] = {
    "none": "nothing besides gravity",
    "constant": "`disturbance_value`, scaled",
    "paper_path": "the paper's W_ext(t), scaled",
    "random": "an Ornstein-Uhlenbeck process per axis, from zero on",
    "impulses": "half-sine pushes and twists in random directions, with exponential waits between them",
    "tilting_gravity": "gravity swings about a random horizontal axis, as if the hand were tilted slowly",
}
"""What `disturbance` may be, and what it does."""

RAMP = 0.05
"""[s] in which a push of "six_directions" changes into the next, at most a quarter of `push_time`."""

_BLOCK = 64
"""Impulses drawn at a time: fixed, so that a longer episode extends a shorter one."""


def external_wrench(kind: str, config: EnvConfig, rng: np.random.Generator, ticks: int) -> Array:
    """(ticks, 6) external wrench [N, N m], object frame, of a key of `DISTURBANCES`; row k acts from k to k + 1.

    The random kinds draw from `rng` in an order that does not depend on `ticks`.
    """
    tick = 1.0 / config.control_rate
    if kind == "random":
        deviation = np.repeat([config.random_force, config.random_moment], 3)
        return ornstein_uhlenbeck(rng, ticks, deviation, config.random_time / tick)
    if kind == "impulses":
        return impulses(
            rng, ticks, tick, config.impulse_force, config.impulse_moment, config.impulse_time, config.impulse_interval
        )
    wrench = np.zeros((ticks, 6))
    if kind == "constant":
        wrench[:] = config.scale * np.array(config.disturbance_value)
    elif kind == "paper_path":
        wrench[:] = config.scale * paper_path(np.arange(ticks) / config.control_rate)
    return wrench


def ornstein_uhlenbeck(rng: np.random.Generator, ticks: int, deviation: Array, time: float) -> Array:
    """(ticks, n) samples of independent Ornstein-Uhlenbeck processes that start at zero, as the settled hand does.

    Args:
        rng: source of one standard normal per sample, row by row.
        ticks: number of rows.
        deviation: (n,) stationary standard deviation.
        time: correlation time in ticks.
    """
    decay = 1.0 / max(time, 1e-3)  # within a thousandth of a tick nothing is left to correlate
    path = rng.standard_normal((ticks, len(deviation)))
    path *= math.sqrt(-math.expm1(-2.0 * decay)) * deviation
    path[0] = 0.0
    _accumulate(path, math.exp(-decay))
    return path


@compiled
def _accumulate(path, keep):
    """path[k] += keep * path[k - 1], in place, row after row."""
    for k in range(1, len(path)):
        for j in range(path.shape[1]):
            path[k, j] += keep * path[k - 1, j]


def impulses(
    rng: np.random.Generator, ticks: int, tick: float, force: float, moment: float, length: float, interval: float
) -> Array:
    """(ticks, 6) half-sine impulses [N, N m] in random directions.

    Each row is the mean over its tick, so that every impulse delivers its 2 / pi * force * length [N s] however short
    it is. They never overlap: a wait runs from the end of one to the start of the next, and starts are at least a tick
    apart.

    Args:
        rng: source of waits and directions.
        ticks: number of rows.
        tick: [s] between rows.
        force: peak [N], in a direction uniform on the sphere. moment: peak [N m], in another.
        length: [s] of an impulse.
        interval: [s] mean of the exponential waits.
    """
    length = max(length, 1e-6 * tick)
    steps, peaks = [np.array([-length])], [np.zeros((1, 6))]  # one of nothing, which ends at time 0
    end, reached = ticks * tick, -length
    while reached <= end:
        direction = rng.standard_normal((_BLOCK, 2, 3))
        direction *= np.array([[force], [moment]]) / np.sqrt((direction**2).sum(axis=2, keepdims=True))
        steps.append(np.maximum(length + interval * rng.standard_exponential(_BLOCK), tick))
        peaks.append(direction.reshape(_BLOCK, 6))
        reached += float(steps[-1].sum())
    starts = np.cumsum(np.concatenate(steps))
    given = np.concatenate(peaks) * (2.0 * length / np.pi)
    before = np.cumsum(given, axis=0) - given
    edges = np.arange(ticks + 1) * tick
    last = np.searchsorted(starts, edges, side="right") - 1
    part = 0.5 - 0.5 * np.cos(np.pi * np.clip((edges - starts[last]) / length, 0.0, 1.0))
    return np.ascontiguousarray(np.diff(before[last] + part[:, None] * given[last], axis=0) / tick)


def tilting_gravity(rng: np.random.Generator, times: Array, gravity: Array, angle: float, period: float) -> Array:
    """(T, 3) gravity [m/s^2], world frame, that swings to `angle` [rad] either way about an axis drawn at random.

    The axis is orthogonal to `gravity` (3,). The swing is a sinusoid of `period` [s] that fades in over the first
    one: it starts upright and without rate. The hand's own accelerations, were it really tilted, are left out.
    """
    heading = 2.0 * np.pi * rng.random()
    size = float(np.sqrt((gravity**2).sum()))
    if size == 0.0:
        return np.zeros((len(times), 3))
    down = gravity / size
    first = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    first /= np.sqrt((first**2).sum())
    sideways = np.cos(heading) * first + np.sin(heading) * np.cross(down, first)
    phase = times / period
    tilt = angle * blend(phase)[0] * np.sin(2.0 * np.pi * phase)
    return size * (np.cos(tilt)[:, None] * down + np.sin(tilt)[:, None] * sideways)


def six_pushes(times: Array, force: float, length: float) -> Array:
    """(T, 3) force [N], world frame: along +x, -x, +y, -y, +z and -z for `length` [s] each, then nothing.

    Each push grows out of the one before by a minimum-jerk ramp within its first `RAMP` seconds, or the first quarter
    of `length` where that is shorter: a step would ask for a jump of the contact forces.
    """
    pushes = np.zeros((8, 3))  # nothing before the first and after the last
    pushes[1:7:2] = force * np.eye(3)
    pushes[2:7:2] = -force * np.eye(3)
    index = np.minimum(times / length, 6.0).astype(np.int64)
    share = blend((times - index * length) / min(RAMP, 0.25 * length))[0][:, None]
    return (1.0 - share) * pushes[index] + share * pushes[index + 1]
