"""How forces follow contacts and wrench between two optimisations."""

from __future__ import annotations

import numpy as np
from oracles.newton import tangent_correction
from oracles.phi import phi

CARRIED, REPAIRED, CLIPPED = 0, 1, 2


def turn(x: np.ndarray, divisor: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """x (3N,) with its tangential parts turned from the tangents of `old` frames (N, 3, 3) into those of `new`."""
    force = x.reshape(-1, 3) / divisor
    along = np.einsum("nij,nj->ni", old[:, :, 1:], force[:, 1:])
    turned = np.column_stack([force[:, 0], np.einsum("nij,ni->nj", new[:, :, 1:], along)])
    return (turned * divisor).reshape(-1)


def carry(
    x: np.ndarray, combined: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray]:
    """What becomes of x and of the combination in these frames: how, and the ends of the segment on which the force lies.

    Carried: both are the tangent correction. Repaired: from the carried combination to it. Clipped: both are the force in the cones.
    """
    moved = tangent_correction(x, matrix, wrench, weights)
    if phi(moved, weights) < np.inf:
        return CARRIED, moved, moved
    safe = tangent_correction(combined, matrix, wrench, weights)
    if phi(safe, weights) < np.inf:
        return REPAIRED, safe, moved
    clipped = moved.reshape(-1, 3).copy()
    clipped[:, 0] = np.maximum(clipped[:, 0], 1.05 * np.hypot(clipped[:, 1], clipped[:, 2]))
    return CLIPPED, clipped.reshape(-1), clipped.reshape(-1)
