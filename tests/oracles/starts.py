"""Parts of the starts: forces in other frames, and the least Phi on a segment by a fine search."""

from __future__ import annotations

import numpy as np
from oracles.phi import phi


def least_on_segment(safe: np.ndarray, x: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """(theta, Phi) of the least Phi(safe + theta (x - safe)), theta in [0, 1]: a scan, refined around its best point."""
    low, high = 0.0, 1.0
    best = (phi(safe, weights), 0.0)
    for _ in range(12):
        thetas = np.linspace(low, high, 9)
        best = min([best, *((phi(safe + k * (x - safe), weights), float(k)) for k in thetas)])
        width = (high - low) / 8.0  # Phi is convex: its least is next to the best point of the scan
        low, high = max(0.0, best[1] - width), min(1.0, best[1] + width)
    return best[1], float(best[0])


def turned(x: np.ndarray, before: np.ndarray, now: np.ndarray, divisor: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Cone coordinates x (3N,) with tangential forces kept as vectors in space: written along `before`, read along `now`.

    Args:
        x: (3N,) cone coordinates.
        before: (N, 3, 3) columns (n, o, t), the frames x is written in.
        now: (N, 3, 3) frames of the result.
        divisor: (N, 3) force = x / divisor.
        scale: (N, 3) x = scale * force.
    """
    out = x.reshape(-1, 3).copy()
    for k, force in enumerate(x.reshape(-1, 3) / divisor):
        vector = before[k][:, 1:] @ force[1:]
        out[k, 1:] = scale[k, 1:] * (now[k][:, 1:].T @ vector)
    return out.reshape(-1)
