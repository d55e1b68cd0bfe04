"""The unit frame (`Grasp.unit_frame`) for the learned starts' kernels: moments about the contacts' centre, divided by the grasp's length."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env._compile import compiled
from grasp_env.grasp.grasp import Grasp


def options(grasp: Grasp, tolerance: float, limit: int, optimum: float = float("nan")) -> Array:
    """(8,) numbers that the kernels take; they read length and centre [m]."""
    return np.array([tolerance, float(limit), 4.0, grasp.length, *grasp.centre, optimum])


LENGTH, CENTRE = 3, 4
"""Where they stand."""


@compiled
def load(wrench, options, out):
    """Out (6,) = wrench as (force, moment about the contacts' centre / length) [N]: `Grasp.unit_frame`."""
    x, y, z, length = options[CENTRE], options[CENTRE + 1], options[CENTRE + 2], options[LENGTH]
    out[0], out[1], out[2] = wrench[0], wrench[1], wrench[2]
    out[3] = (wrench[3] - (y * wrench[2] - z * wrench[1])) / length
    out[4] = (wrench[4] - (z * wrench[0] - x * wrench[2])) / length
    out[5] = (wrench[5] - (x * wrench[1] - y * wrench[0])) / length


@compiled
def pull_back(options, n):
    """Multipliers of the given wrench from those (6 numbers) of `load`: the transposed map."""
    x, y, z, length = options[CENTRE], options[CENTRE + 1], options[CENTRE + 2], options[LENGTH]
    a, b, c = n[3] / length, n[4] / length, n[5] / length
    return n[0] - (b * z - c * y), n[1] - (c * x - a * z), n[2] - (a * y - b * x), a, b, c
