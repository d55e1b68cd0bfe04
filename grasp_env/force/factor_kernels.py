"""What `flow.matrices` is made of, compiled, from one orthonormalisation.

Rows are orthonormalised by two Cholesky factors (Cholesky QR twice: to rounding for condition numbers up to 1e7).
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import cholesky
from grasp_env.force.lanes import LANES


@compiled
def orthonormal_rows(matrix, rows, lower):
    """Rows (6, M) orthonormal and lower (6, 6) triangular with matrix = lower @ rows; False: rank lost."""
    gram = np.empty((6, 6))
    rows[:] = matrix
    for again in range(2):
        for i in range(6):
            for j in range(i + 1):
                total = 0.0
                for k in range(rows.shape[1]):
                    total += rows[i, k] * rows[j, k]
                gram[i, j] = total
        if not cholesky(gram):
            return False
        for i in range(6):
            for j in range(i):
                factor = gram[i, j]
                for k in range(rows.shape[1]):
                    rows[i, k] -= factor * rows[j, k]
            scale = 1.0 / gram[i, i]
            for k in range(rows.shape[1]):
                rows[i, k] *= scale
        if again == 0:
            lower[:] = gram
        else:
            # lower times the second factor, from the last column of a row backwards: only entries not yet replaced are read
            for i in range(6):
                for j in range(i + 1):
                    total = 0.0
                    for k in range(j, i + 1):
                        total += lower[i, k] * gram[k, j]
                    lower[i, j] = total
    return True


@compiled
def flow_lanes(cone_rows):
    """`flow.matrices`, first of the fastest form, from G (6, 3N) in cone coordinates; (0, 1, 0): rank lost."""
    size = cone_rows.shape[1]
    count = size // 3
    three, two = math.sqrt(3.0), math.sqrt(2.0)
    scaled, rows, lower = np.empty((6, size)), np.empty((6, size)), np.empty((6, 6))
    for r in range(6):
        for j in range(size):
            scaled[r, j] = cone_rows[r, j] / (three if j % 3 == 0 else two)
    if not orthonormal_rows(scaled, rows, lower):
        return np.zeros((0, 1, 0))
    for r in range(6):
        for j in range(size):
            rows[r, j] /= three if j % 3 == 0 else two
    if count > LANES:
        out = np.zeros(((count + LANES - 1) // LANES, 1, 72))
        for j in range(size):
            for r in range(6):
                out[j // 12, 0, 24 * (j % 3) + 4 * r + j // 3 % 4] = rows[r, j]
        return out
    out = np.zeros((1, 1, 144))
    for a in range(12):
        out[0, 0, 13 * a] = -1.0 / 3.0 if a < 4 else -0.5
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for r in range(6):
                total += rows[r, i] * rows[r, j]
            p, q = 4 * (i % 3) + i // 3, 4 * (j % 3) + j // 3
            if i == j:
                out[0, 0, 13 * p] += total
            else:
                out[0, 0, 12 * p + q] = out[0, 0, 12 * q + p] = total
    for a in range(12):
        if a % 4 >= count:
            out[0, 0, 13 * a] = 0.0
    return out
