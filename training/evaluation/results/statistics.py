"""Intervals and robust means of finite values (n,), n > 0 unless stated otherwise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_RESAMPLES = 1000


def median_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return a 95 % interval of the median, between order statistics, of any distribution.

    Example:
        >>> median_interval(np.arange(101.0))
        (40.0, 60.0)
    """
    order = np.sort(values)
    half = 0.98 * np.sqrt(order.size)
    centre = 0.5 * (order.size - 1)
    low = int(np.floor(centre - half + 0.5))
    high = int(np.ceil(centre + half - 0.5))
    return float(order[max(low, 0)]), float(order[min(high, order.size - 1)])


def mean_interval(values: NDArray[np.float64], seed: int = 0) -> tuple[float, float]:
    """Return a 95 % bootstrap interval of the mean.

    Example:
        >>> mean_interval(np.full(7, 2.0))
        (2.0, 2.0)
    """
    picks = np.random.default_rng(seed).integers(0, values.size, (_RESAMPLES, values.size))
    low, high = np.percentile(values[picks].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def ratio_interval(
    numerator: NDArray[np.float64],
    denominator: NDArray[np.float64],
    seed: int = 0,
    of: Callable[..., Any] = np.median,
) -> tuple[float, float, float]:
    """Return the ratio of medians of paired samples, and its 95 % paired bootstrap interval.

    `of` replaces the median: a function of an array and `axis`.

    Example:
        >>> ratio_interval(np.full(9, 3.0), np.full(9, 2.0))
        (1.5, 1.5, 1.5)
    """
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, numerator.size, (_RESAMPLES, numerator.size))
    tops = of(numerator[picks], axis=1)
    bottoms = of(denominator[picks], axis=1)
    # infinite medians stay comparable
    ratios = np.sort(np.minimum(tops / np.maximum(bottoms, 1e-12), 1e12))
    low = ratios[int(0.025 * _RESAMPLES)]
    high = ratios[int(0.975 * _RESAMPLES)]
    ratio = of(numerator, axis=0) / max(float(of(denominator, axis=0)), 1e-12)
    return float(ratio), float(low), float(high)


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a rate of `count` in `total`.

    Example:
        >>> wilson(500, 500), wilson(0, 10)
        ((0.992, 1.0), (0.0, 0.278))
    """
    if total == 0:
        return 0.0, 1.0
    z = 1.959963984540054
    rate = count / total
    centre = (rate + z * z / (2 * total)) / (1 + z * z / total)
    root = np.sqrt(rate * (1 - rate) / total + z * z / (4 * total * total))
    half = z * root / (1 + z * z / total)
    low = 0.0 if count == 0 else float(centre - half)
    high = 1.0 if count == total else float(centre + half)
    return low, high


def iqm(values: ArrayLike) -> float:
    """Return the interquartile mean, that of the middle half, for an array of any shape.

    Example:
        >>> iqm(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]))
        3.5
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean())


def iqm_interval(values: ArrayLike, seed: int = 0) -> tuple[float, float]:
    """Return a 95 % bootstrap interval of the `iqm` of (n,) or (seeds, episodes), over both axes.

    Example:
        >>> iqm_interval(np.full((3, 8), 2.0))
        (2.0, 2.0)
    """
    values = np.atleast_2d(np.asarray(values, dtype=np.float64))
    rng = np.random.default_rng(seed)
    rows, columns = values.shape
    draws = [
        iqm(values[rng.integers(0, rows, rows)][:, rng.integers(0, columns, columns)])
        for _ in range(_RESAMPLES)
    ]
    low, high = np.percentile(draws, [2.5, 97.5])
    return float(low), float(high)
