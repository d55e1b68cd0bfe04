"""The way from a point to the surface of the cones u > |(o, t)|."""

from __future__ import annotations

import numpy as np


def longest_step(x: np.ndarray, step: np.ndarray) -> float:
    """The largest step from x, strictly inside, that stays in every cone; inf where the whole ray
    does."""
    far = np.inf
    for p, d in zip(x.reshape(-1, 3), step.reshape(-1, 3), strict=True):
        s = np.hypot(p[1], p[2])
        # q(k) = a k^2 + 2 b k + c falls from c > 0: its first root, as c / (root - b), which does
        # not cancel
        a = d[0] ** 2 - d[1] ** 2 - d[2] ** 2
        b = p[0] * d[0] - float(p[1:] @ d[1:])
        c = (p[0] - s) * (p[0] + s)
        root = np.sqrt(max(b * b - a * c, 0.0))
        if root > b:
            far = min(far, c / (root - b))
    return far
