"""How a grasp lies in memory for the fast kernels: blocks of four contacts, structure of arrays inside a block.

Row `b` of `pack(grasp, ...)` holds contacts 4b .. 4b + 3; number j of contact 4b + l is entry 4 j + l of the row, so
one vector instruction works on four contacts. Unused lanes hold a contact without effect: G = 0, weight 0. A kernel
copies the constants into a row of its own that is longer, and keeps its variables behind them.

Two things make LLVM vectorise this: all arrays of a block lie in one array at constant distances, and the loop over the
lanes has a trip count that is only known at run time (a constant 4 is unrolled first and stays scalar).
"""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env._compile import compiled
from grasp_env.grasp.grasp import Grasp

LANES = 4
G = 0
"""18: column a of G in cone coordinates, row r, at G + 6 a + r."""
K = 18
"""21: G_i J G_i^T, J = diag(1, -1, -1), packed lower triangle."""
PINV = 39
"""18: G^+ in cone coordinates, row a, column r, at PINV + 6 a + r."""
REST = 57
"""3: an internal force strictly inside the cones [N]."""
DIVISOR = 60
"""3: force = cone coordinates / divisor."""
COST = 63
"""1: price of u in the conic problem, 1 / mu: the normal force."""
MASK = 64
"""1: 1 for a contact, 0 for an unused lane."""
OMEGA, LAM = 65, 66
"""Weights of Phi."""
CONSTANTS = 67


def pack(grasp: Grasp, rest: Array, weights: Array) -> Array:
    """(blocks, 4 * CONSTANTS) constants of a grasp.

    Args:
        grasp: the grasp.
        rest: (3N,) an internal force strictly inside the cones, cone coordinates [N].
        weights: (N, 2) omega and lambda of each contact.
    """
    out = np.empty((-(-grasp.n_contacts // LANES), LANES * CONSTANTS))
    inverse = grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]
    pack_into(grasp.cone_matrix.copy(), inverse, rest, grasp.models.cone_divisor.copy(), weights, out)
    return out


@compiled
def pack_into(cone_matrix, inverse, rest, divisor, weights, out):
    """`pack` on arrays: G and G^+ (3N, 6) in cone coordinates, the rest force, divisors (N, 3), weights (N, 2)."""
    count = divisor.shape[0]
    out[:] = 0.0
    for i in range(LANES * out.shape[0]):
        row, lane = out[i // LANES], i % LANES
        row[LANES * REST + lane] = row[LANES * COST + lane] = 1.0
        row[LANES * OMEGA + lane] = row[LANES * LAM + lane] = 1.0
        for a in range(3):
            row[LANES * (DIVISOR + a) + lane] = 1.0
        if i >= count:
            continue
        row[LANES * MASK + lane] = 1.0
        row[LANES * COST + lane] = 1.0 / divisor[i, 0]
        row[LANES * OMEGA + lane], row[LANES * LAM + lane] = weights[i, 0], weights[i, 1]
        for a in range(3):
            row[LANES * (REST + a) + lane] = rest[3 * i + a]
            row[LANES * (DIVISOR + a) + lane] = divisor[i, a]
            for r in range(6):
                row[LANES * (G + 6 * a + r) + lane] = cone_matrix[r, 3 * i + a]
                row[LANES * (PINV + 6 * a + r) + lane] = inverse[3 * i + a, r]
        k = K
        for r in range(6):
            for s in range(r + 1):
                row[LANES * k + lane] = (
                    cone_matrix[r, 3 * i] * cone_matrix[s, 3 * i]
                    - cone_matrix[r, 3 * i + 1] * cone_matrix[s, 3 * i + 1]
                    - cone_matrix[r, 3 * i + 2] * cone_matrix[s, 3 * i + 2]
                )
                k += 1
