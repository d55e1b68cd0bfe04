"""External wrenches: the paper's two examples, and samplers, which take a random generator."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.errors import InvalidInputError
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import (
    Array,
    Wrench,
    as_array,
    as_wrench,
    as_wrenches,
    instance,
    number,
    positive,
    unit_vectors,
    whole,
)

PAPER_CONSTANT: tuple[float, ...] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
"""The constant external wrench of the paper's Sec. IV.A [N, N m]."""
FORCE_RADIUS, MOMENT_RADIUS = 2.0, 0.05
"""Radii of the standard held-out ball [N, N m]."""
MAGNITUDE_LENGTH = 0.05
"""Length [m] that converts a moment to a force in `magnitude`."""


def paper_path(time: ArrayLike) -> Array:
    """Return the wrench W_ext(t) of the paper's Sec. IV.B, (6,) or (T, 6) [N, N m].

    `time` is a scalar or (T,) [s]; the paper's example ends at 2.

    Example:
        >>> paper_path(0.0)
        array([1. , 1. , 3. , 0. , 0.2, 0. ])
    """
    t = as_array(time, None, "time", ranges.SIZE)
    c = np.cos(np.pi * t)
    s = np.sin(np.pi * t)
    c2 = np.cos(0.5 * np.pi * t) ** 2
    s2 = np.sin(0.5 * np.pi * t) ** 2
    return np.stack([c, c**2, 8.0 * c2 - 5.0, 0.2 * s, 0.2 * c, s2], axis=-1)


def magnitude(wrench: Array, length: float = MAGNITUDE_LENGTH) -> Array:
    """Return |(force, moment / length)| (...,) [N] of `wrench` (..., 6) [N, N m].

    Example:
        >>> float(magnitude([3, 0, 0, 0, 0, 0.2]))
        5.0
    """
    wrenches = as_wrenches(wrench)
    scaled = np.concatenate(
        [wrenches[..., :3], wrenches[..., 3:] / positive(length, "length", ranges.LENGTH)], axis=-1
    )
    return np.sqrt((scaled**2).sum(axis=-1))


def sample_ball(
    rng: np.random.Generator, count: int, force: float = FORCE_RADIUS, moment: float = MOMENT_RADIUS
):
    """Draw (count, 6) wrenches by `rng`, uniform in balls of radius `force` [N], `moment` [N m].

    Example:
        >>> sample_ball(np.random.default_rng(0), 100).shape
        (100, 6)
    """
    _check_draw(rng, count)
    force = number(force, "force", ranges.SIZE)
    moment = number(moment, "moment", ranges.SIZE)
    return np.concatenate([_ball(rng, count) * force, _ball(rng, count) * moment], axis=1)


def sample_magnitudes(
    rng: np.random.Generator, count: int, low: float = 0.1, high: float = 20.0
) -> Array:
    """Draw (count, 6) wrenches by `rng`, uniform directions of (force, moment / 0.05 m).

    Their `magnitude` is log-uniform from `low` to `high` [N].

    Raises:
        InvalidInputError: low > high, or values out of range.

    Example:
        >>> bool((magnitude(sample_magnitudes(np.random.default_rng(0), 100, high=4.0)) < 4.001).all())
        True
    """
    _check_draw(rng, count)
    low = positive(low, "low", ranges.BALL)
    high = positive(high, "high", ranges.BALL)
    if low > high:
        raise InvalidInputError(f"low must be <= high, got {low:g} and {high:g}")
    direction = unit_vectors(rng.standard_normal((count, 6)))
    wrench = direction * np.exp(rng.uniform(np.log(low), np.log(high), (count, 1)))
    wrench[:, 3:] *= MAGNITUDE_LENGTH
    return wrench


def sample_path(rng: np.random.Generator, count: int, step: float = 0.03) -> Array:
    """Draw (count, 6) wrenches by `rng`, a random walk in the standard ball.

    `step` is the largest change between successive wrenches as a fraction of each radius, 0 to 1.

    Example:
        >>> sample_path(np.random.default_rng(0), 50, step=0.01).shape
        (50, 6)
    """
    _check_draw(rng, count)
    step = number(step, "step", ranges.Range(0.0, 1.0))
    path = np.empty((count, 6))
    point = sample_ball(rng, 1)[0]
    for k in range(count):
        path[k] = point
        move = np.concatenate([_ball(rng, 1)[0] * FORCE_RADIUS, _ball(rng, 1)[0] * MOMENT_RADIUS])
        point = point + step * move
        for axes, radius in ((slice(0, 3), FORCE_RADIUS), (slice(3, 6), MOMENT_RADIUS)):
            norm = float(np.sqrt((point[axes] ** 2).sum()))
            if norm > radius:  # reflect at the surface of the ball
                point[axes] *= (2.0 * radius - norm) / norm
    return path


def _ball(rng: np.random.Generator, count: int) -> Array:
    return unit_vectors(rng.standard_normal((count, 3))) * rng.random((count, 1)) ** (1.0 / 3.0)


def constant(wrench: Wrench, count: int) -> Array:
    """Return the same wrench (6,) [N, N m] `count` times, (count, 6).

    Example:
        >>> constant(PAPER_CONSTANT, 3).shape
        (3, 6)
    """
    return np.tile(as_wrench(wrench), (whole(count, "count", 0, ranges.NUMBERS // 6), 1))


def _check_draw(rng: np.random.Generator, count: int) -> None:
    instance(rng, np.random.Generator, "rng")
    whole(count, "count", 1, ranges.NUMBERS // 6)
