"""Intersections of rays with the cones u > |(o, t)|, by the roots of (u^2 - o^2 - t^2) along them."""

from __future__ import annotations

import numpy as np


def inside(x: np.ndarray) -> np.ndarray:
    """True for points (..., 3) strictly inside the cone."""
    u, o, t = np.moveaxis(x, -1, 0)
    return u > np.hypot(o, t)


def crossings(point: np.ndarray, ray: np.ndarray) -> list[float]:
    """The k >= 0, ascending, at which point + k ray meets the surface of the cone or of its opposite, one contact (3,)."""
    j = np.array([1.0, -1.0, -1.0])
    # of one size: the roots do not change, and the squares neither overflow nor vanish
    size, far = np.abs(point).max(), np.abs(ray).max()
    if size == 0.0 or far == 0.0:
        return []
    p, d = point / size, ray / far
    roots = np.roots([d @ (j * d), 2.0 * (p @ (j * d)), p @ (j * p)])
    return sorted(float(r.real) * size / far for r in roots if r.real >= 0.0 and abs(r.imag) <= 1e-7 * abs(r))


def ray_interval(point: np.ndarray, ray: np.ndarray) -> tuple[float, float]:
    """Return the interval of k >= 0 with point + k ray strictly inside every cone; (inf, -inf) if it is empty.

    A sample between two crossings decides. The set is convex, so the pieces form one interval.
    """
    low, high = np.inf, -np.inf
    pairs = list(zip(point.reshape(-1, 3), ray.reshape(-1, 3), strict=True))
    ends = sorted({0.0, *(k for p, d in pairs for k in crossings(p, d))})
    for first, last in zip(ends, [*ends[1:], np.inf], strict=True):
        sample = 0.5 * (first + last) if last < np.inf else 2.0 * first + 1.0
        if all(inside(p + sample * d) for p, d in pairs):
            low, high = min(low, first), max(high, last)
    return low, high


def longest_step(x: np.ndarray, step: np.ndarray) -> float:
    """The largest step from x, strictly inside, that stays in every cone; inf where the whole ray does."""
    far = np.inf
    for p, d in zip(x.reshape(-1, 3), step.reshape(-1, 3), strict=True):
        s = np.hypot(p[1], p[2])
        # q(k) = a k^2 + 2 b k + c falls from c > 0: its first root, as c / (root - b), which does not cancel
        a, b, c = d[0] ** 2 - d[1] ** 2 - d[2] ** 2, p[0] * d[0] - float(p[1:] @ d[1:]), (p[0] - s) * (p[0] + s)
        root = np.sqrt(max(b * b - a * c, 0.0))
        if root > b:
            far = min(far, c / (root - b))
    return far
