"""What `flow.matrices`, `Grasp.pseudoinverse` and `null_space_basis` are made of, compiled, from one orthonormalisation.

Rows are orthonormalised by two Cholesky factors (Cholesky QR twice: to rounding for condition numbers up to 1e7).
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.force.kernels import cholesky
from grasp_env.force.lanes import LANES

CLOSE = 1e-14
"""Largest entry of B^T B - 1 at which the columns of B count as orthonormal."""
MOST_ROUNDS = 60
"""Of a polar factor; six halve the distance of a singular value of 0.1, the last three take all digits."""


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
def write_inverse(rows, lower, divisor, out):
    """Out (3N, 6) = diag(divisor) rows^T lower^-1: from G in forces to G^+ in cone coordinates."""
    for j in range(rows.shape[1]):
        for r in range(5, -1, -1):
            total = rows[r, j] * divisor[j // 3, j % 3]
            for i in range(r + 1, 6):
                total -= lower[i, r] * out[j, i]
            out[j, r] = total / lower[r, r]


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


@compiled
def smooth_null_space(frames, rows, reference, out):
    """`null_space_basis` into out (3N, 3N - 6); False where the reference does not span the null space.

    The polar factor B (B^T B)^-1/2 is the limit of B <- B (3 - B^T B) / 2, as a projection has no singular value above one.

    Args:
        frames: (N, 3, 3) contact frames.
        rows: (6, 3N) orthonormal rows that span those of G (forces).
        reference: (3N, 3N - 6) object-frame directions.
        out: overwritten.
    """
    size, columns = out.shape
    for j in range(size):
        k = j // 3
        for c in range(columns):
            out[j, c] = 0.0
            for a in range(3):
                out[j, c] += frames[k, a, j % 3] * reference[3 * k + a, c]
    _reject(rows, out)
    gram, line = np.empty((columns, columns)), np.empty(columns)
    for _ in range(MOST_ROUNDS):
        worst = 0.0
        for b in range(columns):
            for c in range(b + 1):
                total = 0.0
                for j in range(size):
                    total += out[j, b] * out[j, c]
                gram[b, c] = gram[c, b] = total
                worst = max(worst, abs(total - (1.0 if b == c else 0.0)))
        if worst <= CLOSE:
            _reject(rows, out)
            return True
        for j in range(size):
            for c in range(columns):
                line[c] = 1.5 * out[j, c]
                for b in range(columns):
                    line[c] -= 0.5 * out[j, b] * gram[b, c]
            out[j] = line
    return False


@compiled
def _reject(rows, columns):
    """Takes off columns (3N, d) what lies along the orthonormal rows (6, 3N)."""
    for c in range(columns.shape[1]):
        for r in range(6):
            total = 0.0
            for j in range(columns.shape[0]):
                total += rows[r, j] * columns[j, c]
            for j in range(columns.shape[0]):
                columns[j, c] -= total * rows[r, j]
