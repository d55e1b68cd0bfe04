"""The offline part, compiled: the optima of Phi for the 12 unit wrenches and for no wrench (paper, Sec. III)."""

from __future__ import annotations

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import cone_slack
from grasp_env.force.newton_kernels import GIVEN, newton
from grasp_env.force.record import BOUND, FORCE, OBJECTIVE
from grasp_env.force.start_kernels import ray_interval, squeeze_scale, tangent

BASIS_TOLERANCE = 1e-10
BASIS_ITERATIONS = 200
ACCEPTED_GAP = 1e-2
"""Basis forces are starts: where floating point ends before 1e-10 (tiny lambda), one within a hundredth still serves."""


@compiled
def offline_basis(basis, warm, interior, constants, cone_matrix, pseudoinverse, divisor, weights, options):
    """Fills `basis` (13, 3N) with argmin Phi for +-e_k and for w = 0; returns the worst relative gap (inf: failed).

    Args:
        basis: overwritten; where `warm` is set it holds the basis of a nearby grasp to start from.
        interior: (3N,) a strictly interior internal force of this grasp, any scale.
        constants: from `lanes.pack`.
        cone_matrix, pseudoinverse: (6, 3N), (3N, 6), in cone coordinates.
        divisor: (N, 3) of cone coordinates.
        weights: (N, 2) omega and lambda.
        options: (8,) from `lanes.options`.
    """
    size = interior.size
    count = size // 3
    x, start = np.empty(size), np.empty(size)
    wrench = np.zeros(6)
    record, no_trace = np.empty(FORCE + 7 * count), np.empty(0)
    worst = 0.0
    for row in range(12, -1, -1):  # rest (12) first: the others start from it
        wrench[:] = 0.0
        if row < 12:
            wrench[row % 6] = 1.0 if row < 6 else -1.0
        started = False
        if warm and tangent(basis[row], cone_matrix, wrench, weights, x):
            # twice: the second correction takes the rounding of the first out of the balance
            started = cone_slack(x) > 0.0 and tangent(x, cone_matrix, wrench, weights, basis[row])
            started = started and cone_slack(basis[row]) > 0.0
            x[:] = basis[row]
        if not started:
            if row == 12:
                x[:] = interior * squeeze_scale(interior, weights)
            else:
                for j in range(size):
                    total = 0.0
                    for i in range(6):
                        total -= pseudoinverse[j, i] * wrench[i]
                    x[j] = total
                low, _ = ray_interval(x, basis[12])
                x[:] = x + max(1.1 * low, 1.0) * basis[12]
        for j in range(size):
            start[j] = x[j] / divisor[j // 3, j % 3]
        newton(constants, basis, GIVEN, start, wrench, weights, options, record, no_trace)
        if not record[BOUND] > 0.0:
            return np.inf
        worst = max(worst, (record[OBJECTIVE] - record[BOUND]) / record[BOUND])
        for j in range(size):
            scale = divisor[j // 3, j % 3]
            basis[row, j] = record[FORCE + j] * scale if scale < np.inf else 0.0
    return worst
