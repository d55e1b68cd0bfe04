"""The few statistics the reports quote."""

from __future__ import annotations

from typing import Any

import numpy as np

_RESAMPLES = 1000


def spread(values: np.ndarray) -> dict[str, Any]:
    """Median with a 95 % interval, p90, p95, p99 and maximum of finite values (n,).

    The interval is between order statistics, free of any distribution: what a bootstrap of the median comes to.

    Example:
        >>> row = spread(np.arange(101.0))
        >>> row["median"], row["median_low"], row["median_high"], row["p99"]
        (50.0, 40.0, 60.0, 99.0)
    """
    names = ("median", "p90", "p95", "p99", "max")
    if values.size == 0:
        return {"n": 0, **dict.fromkeys((*names, "median_low", "median_high"))}
    order = np.sort(values.astype(np.float64))
    half, centre = 0.98 * np.sqrt(order.size), 0.5 * (order.size - 1)
    low, high = int(np.floor(centre - half + 0.5)), int(np.ceil(centre + half - 0.5))
    points = np.percentile(order, [50, 90, 95, 99, 100])
    return {
        "n": int(order.size),
        **{name: float(point) for name, point in zip(names, points, strict=True)},
        "median_low": float(order[max(low, 0)]),
        "median_high": float(order[min(high, order.size - 1)]),
    }


def ratio_interval(numerator: np.ndarray, denominator: np.ndarray, seed: int = 0) -> tuple[float, float, float]:
    """median(numerator) / median(denominator) of paired samples, with a 95 % paired bootstrap interval."""
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, numerator.size, (_RESAMPLES, numerator.size))
    tops, bottoms = np.median(numerator[picks], axis=1), np.median(denominator[picks], axis=1)
    ratios = np.sort(np.minimum(tops / np.maximum(bottoms, 1e-12), 1e12))  # infinite medians stay comparable
    low, high = ratios[int(0.025 * _RESAMPLES)], ratios[int(0.975 * _RESAMPLES)]
    return float(np.median(numerator) / max(float(np.median(denominator)), 1e-12)), float(low), float(high)


def wilson(count: int, total: int) -> tuple[float, float]:
    """95 % Wilson interval of a rate of `count` in `total`.

    Example:
        >>> wilson(500, 500), wilson(0, 10)
        ((0.992, 1.0), (0.0, 0.278))
    """
    if total == 0:
        return 0.0, 1.0
    z, rate = 1.959963984540054, count / total
    centre = (rate + z * z / (2 * total)) / (1 + z * z / total)
    half = z * np.sqrt(rate * (1 - rate) / total + z * z / (4 * total * total)) / (1 + z * z / total)
    return (0.0 if count == 0 else float(centre - half)), (1.0 if count == total else float(centre + half))


def mean_interval(values: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Mean of finite values (n,) with a 95 % bootstrap interval; of paired differences too.

    Example:
        >>> mean_interval(np.full(7, 2.0))
        {'n': 7, 'mean': 2.0, 'low': 2.0, 'high': 2.0}
    """
    values = np.asarray(values, dtype=np.float64)
    if values.size == 0:
        return {"n": 0, "mean": None, "low": None, "high": None}
    picks = np.random.default_rng(seed).integers(0, values.size, (_RESAMPLES, values.size))
    low, high = np.percentile(values[picks].mean(axis=1), [2.5, 97.5])
    return {"n": int(values.size), "mean": float(values.mean()), "low": float(low), "high": float(high)}


def iqm(values: np.ndarray) -> float:
    """Interquartile mean: of the middle half of all values, whatever their shape.

    Example:
        >>> iqm(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]))
        3.5
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean())


def iqm_interval(values: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Interquartile mean of (seeds, episodes) with a 95 % bootstrap interval over both: training seeds and episodes are drawn anew.

    Example:
        >>> iqm_interval(np.full((3, 8), 2.0))
        {'n': 24, 'iqm': 2.0, 'low': 2.0, 'high': 2.0}
    """
    values = np.atleast_2d(np.asarray(values, dtype=np.float64))
    rng, (rows, columns) = np.random.default_rng(seed), values.shape
    draws = [iqm(values[rng.integers(0, rows, rows)][:, rng.integers(0, columns, columns)]) for _ in range(_RESAMPLES)]
    low, high = np.percentile(draws, [2.5, 97.5])
    return {"n": values.size, "iqm": iqm(values), "low": float(low), "high": float(high)}
