"""A pinch of two soft contacts whose least forces are known in closed form.

The contacts push along +x and -x, half a width before and behind the origin. A force F along y and
a moment M about x leave the mirror image in x = 0 as it is, so the contacts bear half of each, and
one number remains: the normal force n of both. With bounds of friction and torsion apart n is the
larger of the two needs in place of their root sum of squares.
"""

from __future__ import annotations

import numpy as np

MU, GAMMA = 0.5, 0.01
"""Friction and torsional friction [m] of both contacts."""
HALF = 0.02
"""Half the width [m]."""
POSITIONS = np.array([[-HALF, 0.0, 0.0], [HALF, 0.0, 0.0]])
NORMALS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
FRAMES = np.array([np.eye(3), [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]])
"""Columns (n, o, t): o is y."""


def wrench(force: float, moment: float) -> np.ndarray:
    """The wrench (6,) of F [N] along y and M [N m] about x."""
    return np.array([0.0, force, 0.0, moment, 0.0, 0.0])


def least_normal(force: float, moment: float, margin: float = 1.0, preload: float = 0.0) -> float:
    """The least n [N]: (F / 2 mu)^2 + (M / 2 gamma)^2 = (margin (n - preload))^2."""
    return float(np.hypot(0.5 * force / MU, 0.5 * moment / GAMMA)) / margin + preload


def least_normal_apart(force: float, moment: float) -> float:
    """The least n [N] with bounds of friction and torsion apart, which is too little."""
    return max(0.5 * force / MU, 0.5 * moment / GAMMA)


def forces(normal: float, force: float, moment: float) -> np.ndarray:
    """The balanced forces (2, 4), (n, o, t, torsion), with this normal force."""
    sides = [normal, -0.5 * force, 0.0]
    return np.array([[*sides, -0.5 * moment], [*sides, 0.5 * moment]])


def multipliers(force: float, moment: float) -> np.ndarray:
    """nu (6,), minus the slope of the least 2 n along the wrench."""
    return -wrench(force / MU**2, moment / GAMMA**2) / np.hypot(force / MU, moment / GAMMA)
