"""The way from a point to the surface of the cones u > |(o, t)|, or u > |(o, t, v)|."""

from __future__ import annotations

import numpy as np


def longest_step(x: np.ndarray, step: np.ndarray, wide: int = 3) -> float:
    """The largest step from x, strictly inside, that stays in every cone; inf where the whole ray
    does.

    wide: numbers of a contact, 3 or 4.
    """
    far = np.inf
    for p, d in zip(x.reshape(-1, wide), step.reshape(-1, wide), strict=True):
        s = np.hypot.reduce(p[1:])
        # q(k) = a k^2 + 2 b k + c falls from c > 0: its first root, as c / (root - b), which does
        # not cancel
        a = d[0] ** 2 - float(d[1:] @ d[1:])
        b = p[0] * d[0] - float(p[1:] @ d[1:])
        c = (p[0] - s) * (p[0] + s)
        root = np.sqrt(max(b * b - a * c, 0.0))
        if root > b:
            far = min(far, c / (root - b))
    return far
