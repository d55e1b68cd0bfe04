"""Parts of the starts: forces in other frames, and the least Phi on a segment by a fine search."""

from __future__ import annotations

import numpy as np


def turned(
    x: np.ndarray, before: np.ndarray, now: np.ndarray, divisor: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Cone coordinates x (3N,) with tangential forces kept as vectors in space: written along
    `before`, read along `now`.

    Frames are (N, 3, 3) with columns (n, o, t); force = x / divisor before, x = scale * force now,
    both (N, 3).
    """
    out = x.reshape(-1, 3).copy()
    for k, force in enumerate(x.reshape(-1, 3) / divisor):
        vector = before[k][:, 1:] @ force[1:]
        out[k, 1:] = scale[k, 1:] * (now[k][:, 1:].T @ vector)
    return out.reshape(-1)
