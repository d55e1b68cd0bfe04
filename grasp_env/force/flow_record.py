"""Balance, for the learned starts' kernels."""

from __future__ import annotations

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import residual
from grasp_env.force.lanes import load


@compiled
def least_change(x, cone_matrix, inverse, wrench):
    """Takes what misses balance off x (3N,) by G^+."""
    left = np.empty(6)
    residual(cone_matrix, x, wrench, left)
    for j in range(x.size):
        for r in range(6):
            x[j] -= inverse[j, r] * left[r]


@compiled
def unit_size(wrench, options, unit):
    """Largest |component| of a wrench in the unit frame [N]; `unit` (6,) is work space."""
    load(wrench, options, unit)
    most = 0.0
    for r in range(6):
        most = max(most, abs(unit[r]))
    return most
