"""Desired motions of the object: smooth, with exact derivatives, at rest at start and end."""

from __future__ import annotations

import numpy as np

from grasp_env.inputs.arguments import Array

MOTIONS: dict[str, str] = {
    "lift": "up along y in the first third of a period, held, down in the last third",
    "shake": "a sinusoid along x, fading in over the first period and out over the last",
    "rotate": "about z, the line through the thumb: turned in the first third of a period, held, turned back",
}
"""The motions by name, with descriptions.

During a rotation about z, the thumb at -z turns on the spot: the built-in four-finger hand reaches
beyond 90 degrees about z, 61 about y and 24 about x."""

MOTION_SIZES: dict[str, float] = {"lift": 0.015, "shake": 0.015, "rotate": 0.3}
"""Default sizes [m], [m], [rad]."""

TARGET_SIZE = 19
POSITION = slice(0, 3)
QUATERNION = slice(3, 7)
LINEAR = slice(7, 10)
ANGULAR = slice(10, 13)
LINEAR_ACCELERATION, ANGULAR_ACCELERATION = slice(13, 16), slice(16, 19)
"""Parts of a target row: [m], (x, y, z, w), [m/s], [rad/s], [m/s^2], [rad/s^2], world frame."""


def blend(phase: Array) -> Array:
    """Return the minimum-jerk step from phase 0 to 1 and its first two derivatives, (3, T).

    Example:
        >>> blend(np.array([-1.0, 0.5, 2.0]))[0]
        array([0. , 0.5, 1. ])
    """
    u = np.clip(phase, 0.0, 1.0)
    rest = 1.0 - u
    squared = u * u
    return np.stack(
        [
            squared * u * (10.0 - 15.0 * u + 6.0 * squared),
            30.0 * squared * rest * rest,
            60.0 * u * rest * (1.0 - 2.0 * u),
        ]
    )


def resting_target(ticks: int) -> Array:
    """Return rows (ticks, 19) of the nominal pose, at rest."""
    target = np.zeros((ticks, TARGET_SIZE))
    target[:, QUATERNION.stop - 1] = 1.0
    return target


def motion_target(motion: str, times: Array, size: float, period: float) -> Array:
    """Return a motion of `MOTIONS`, rows (T, 19) as above, at times (T,) [s] from 0 on.

    `size` is in [m] or [rad], `period` in [s]. As many whole periods as fit before `times[-1]` are
    done, then the object rests; if not even one fits, it is cut short. A shake reaches its full
    size if three or more periods fit.

    Example:
        >>> motion_target("lift", np.array([0.0, 1.0, 2.0]), size=0.05, period=2.0)[:, 1]
        array([0.  , 0.05, 0.  ])
    """
    target = resting_target(len(times))
    repeats = max(1.0, np.floor(times[-1] / period * (1.0 + 1e-12)))
    rule = _shake if motion == "shake" else _there_and_back
    path = size * rule(times, period, repeats)
    if motion == "rotate":
        target[:, QUATERNION.start + 2] = np.sin(0.5 * path[0])
        target[:, QUATERNION.start + 3] = np.cos(0.5 * path[0])
        target[:, ANGULAR.start + 2], target[:, ANGULAR_ACCELERATION.start + 2] = path[1], path[2]
    else:
        axis = 0 if motion == "shake" else 1
        for columns, values in zip((POSITION, LINEAR, LINEAR_ACCELERATION), path, strict=True):
            target[:, columns.start + axis] = values
    return target


def _there_and_back(times: Array, period: float, repeats: float) -> Array:
    """Return 0 to 1 in a third of each period, held, and back, with two derivatives (3, T)."""
    phase = times / period
    phase = 3.0 * np.where(phase < repeats, phase - np.floor(phase), 0.0)
    rate = 3.0 / period
    return (blend(phase) - blend(phase - 2.0)) * np.array([[1.0], [rate], [rate * rate]])


def _shake(times: Array, period: float, repeats: float) -> Array:
    """Return a unit sinusoid that fades in and out, with two derivatives (3, T)."""
    fade = period * min(1.0, 0.5 * repeats)
    a, da, dda = blend(times / fade) * np.array([[1.0], [1.0 / fade], [1.0 / fade**2]])
    b, db, ddb = blend((repeats * period - times) / fade) * np.array(
        [[1.0], [-1.0 / fade], [1.0 / fade**2]]
    )
    envelope = a * b
    rate = da * b + a * db
    curve = dda * b + 2.0 * da * db + a * ddb
    omega = 2.0 * np.pi / period
    sine = np.sin(omega * times)
    cosine = np.cos(omega * times)
    return np.stack(
        [
            envelope * sine,
            rate * sine + envelope * omega * cosine,
            (curve - envelope * omega**2) * sine + 2.0 * rate * omega * cosine,
        ]
    )
