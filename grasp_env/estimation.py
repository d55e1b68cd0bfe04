"""What the controller can know: the external wrench from motion and tactile forces, late rows, sensor noise."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._check import Array
from grasp_env._compile import compiled

ESTIMATOR_STATE = 13
"""Size of the state of `estimate_wrench`: started, momentum [N s], angular momentum [N m s] (world), estimate (6)."""


def keep_factor(time: float, tick: float) -> float:
    """The share of its last value that a first-order filter of time constant `time` [s] keeps over `tick` [s].

    Example:
        >>> keep_factor(0.0, 0.004), keep_factor(0.02, 0.004)
        (0.0, 0.8187...)
    """
    return math.exp(-tick / time) if time > 1e-3 * tick else 0.0


@compiled
def estimate_wrench(state, rotation, linear, angular, points, forces, mass, inertia, gravity, dt, keep, out):
    """Estimate the external wrench on the object: what moved it besides the contacts and gravity, filtered.

    force = d(m v)/dt - sum f - m g and moment = d(R I R^T omega)/dt - sum p x f over one tick, written in the object
    frame at its end. A mass that differs from `mass` shows up as a wrench, as does gravity that is not `gravity`.

    Args:
        state: (13,) all zeros before the first call of an episode, which only takes the momentum and writes zeros.
        rotation: (3, 3) object frame to world frame, at the end of the tick.
        linear: (3,) velocity of the object's centre [m/s], world frame, at the end of the tick.
        angular: (3,) angular velocity [rad/s], world frame, at the end of the tick.
        points: (N, 3) contacts [m], object frame.
        forces: (N, 3) measured forces of the fingers on the object [N], object frame, mean over the tick.
        mass: [kg] of the object, as known.
        inertia: (3, 3) [kg m^2] about its centre, object frame, as known.
        gravity: (3,) [m/s^2], world frame, as known.
        dt: [s] since the last call.
        keep: see `keep_factor`.
        out: (6,) receives the estimate [N, N m], object frame.
    """
    spin, momentum, change = np.empty(3), np.empty(6), np.empty(6)
    for i in range(3):
        spin[i] = 0.0
        for k in range(3):
            spin[i] += rotation[k, i] * angular[k]
    for i in range(3):
        momentum[i], momentum[3 + i] = mass * linear[i], 0.0
        for k in range(3):
            for j in range(3):
                momentum[3 + i] += rotation[i, k] * inertia[k, j] * spin[j]
    started = state[0] != 0.0
    for i in range(6):
        change[i] = (momentum[i] - state[1 + i]) / dt
        state[1 + i] = momentum[i]
    state[0] = 1.0
    if not started:
        state[7:], out[:] = 0.0, 0.0
        return
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        force, moment = 0.0, 0.0
        for k in range(3):
            force += rotation[k, i] * (change[k] - mass * gravity[k])
            moment += rotation[k, i] * change[3 + k]
        for n in range(len(points)):
            force -= forces[n, i]
            moment -= points[n, a] * forces[n, b] - points[n, b] * forces[n, a]
        state[7 + i] = keep * state[7 + i] + (1.0 - keep) * force
        state[10 + i] = keep * state[10 + i] + (1.0 - keep) * moment
    out[:] = state[7:]


@compiled
def add_force_noise(forces, level, normals, out):
    """Write forces (N, 3) with errors whose standard deviation per axis is `level` times the force's length.

    Args:
        forces: (N, 3) [N], any frame.
        level: relative standard deviation, `tactile_noise`.
        normals: (3N,) standard normal numbers.
        out: (N, 3) receives the noisy forces [N]; may be `forces`.
    """
    for n in range(len(forces)):
        x, y, z = forces[n, 0], forces[n, 1], forces[n, 2]
        size = level * math.sqrt(x * x + y * y + z * z)
        for k in range(3):
            out[n, k] = forces[n, k] + size * normals[3 * n + k]


class Delay:
    """Rows of numbers, given back a fixed number of ticks late; nothing is allocated after construction.

    Args:
        ticks: how late; 0 gives back the row of now.
        width: numbers per row.

    Example:
        >>> late = Delay(ticks=1, width=2)
        >>> late.reset(np.zeros(2))
        >>> late(np.array([1.0, 2.0]))
        array([0., 0.])
        >>> late(np.array([3.0, 4.0]))
        array([1., 2.])
    """

    def __init__(self, ticks: int, width: int) -> None:
        self._rows = np.zeros((ticks + 1, width))
        self._next = 0

    @classmethod
    def of_time(cls, time: float, rate: float, width: int) -> Delay:
        """A delay of `time` [s], rounded to ticks of `rate` [Hz]."""
        return cls(round(time * rate), width)

    @property
    def ticks(self) -> int:
        """How many ticks late rows come back."""
        return len(self._rows) - 1

    def reset(self, row: Array) -> None:
        """Every row before the first call was `row` (width,)."""
        self._rows[:] = row

    def __call__(self, row: Array) -> Array:
        """Takes this tick's row (width,), returns that of `ticks` ago: a view, valid until the next call."""
        rows, place = self._rows, self._next
        rows[place] = row
        self._next = place = (place + 1) % len(rows)
        return rows[place]


class NoiseRows:
    """Rows of standard normal numbers for the sensors, the same for a seed however many are asked for.

    Args:
        rng: source; used up in blocks of rows, so give it one of its own.
        width: numbers per row.

    Example:
        >>> noise = NoiseRows(np.random.default_rng(0), width=3)
        >>> noise().shape
        (3,)
    """

    _BLOCK = 64

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng = rng
        self._rows = np.empty((self._BLOCK, width))
        self._next = self._BLOCK

    def __call__(self) -> Array:
        """The next row (width,): a view, valid until the next call."""
        if self._next == self._BLOCK:
            self._rng.standard_normal(out=self._rows)
            self._next = 0
        self._next += 1
        return self._rows[self._next - 1]
