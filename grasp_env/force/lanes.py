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
    count = grasp.n_contacts
    blocks = -(-count // LANES)
    table = np.zeros((blocks * LANES, CONSTANTS))
    g = grasp.cone_matrix.reshape(6, count, 3).transpose(1, 2, 0)
    signed = g * np.array([1.0, -1.0, -1.0])[None, :, None]
    products = np.einsum("nar,nas->nrs", g, signed)
    rows, columns = np.tril_indices(6)
    table[:count, G : G + 18] = g.reshape(count, 18)
    table[:count, K : K + 21] = products[:, rows, columns]
    inverse = grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]
    table[:count, PINV : PINV + 18] = inverse.reshape(count, 18)
    table[:, REST] = 1.0
    table[:count, REST : REST + 3] = rest.reshape(count, 3)
    table[:, DIVISOR : DIVISOR + 3] = 1.0
    table[:count, DIVISOR : DIVISOR + 3] = grasp.models.cone_divisor
    table[:, COST] = 1.0
    table[:count, COST] = 1.0 / grasp.models.cone_divisor[:, 0]
    table[:count, MASK] = 1.0
    table[:, OMEGA] = table[:, LAM] = 1.0
    table[:count, OMEGA : LAM + 1] = weights
    return table.reshape(blocks, LANES, CONSTANTS).transpose(0, 2, 1).reshape(blocks, LANES * CONSTANTS).copy()
