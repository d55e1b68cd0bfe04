"""How a grasp lies in memory for the fast kernels: blocks of four contacts, structure of arrays inside a block.

Balance is in the unit frame (`Grasp.unit_frame`): moments about the contacts' centre, divided by the grasp's length.

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
    frame = grasp.unit_frame
    inverse = (grasp.pseudoinverse * grasp.models.cone_scale.reshape(-1)[:, None]) @ np.linalg.inv(frame)
    pack_into(frame @ grasp.cone_matrix, inverse, rest, grasp.models.cone_divisor.copy(), weights, out)
    return out


def options(grasp: Grasp, tolerance: float, limit: int, optimum: float = float("nan")) -> Array:
    """(8,) numbers that the kernels take: relative gap, most iterations, lanes, length and centre [m], a known minimum."""
    # the number of lanes is data, so that the compiler does not know it
    return np.array([tolerance, float(limit), float(LANES), grasp.length, *grasp.centre, optimum])


GAP, STEPS, LANE_COUNT, LENGTH, CENTRE, KNOWN = 0, 1, 2, 3, 4, 7
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


@compiled
def pack_into(cone_matrix, inverse, rest, divisor, weights, out):
    """`pack` on arrays: G and G^+ (3N, 6) in cone coordinates and the unit frame, the rest force, divisors (N, 3), weights (N, 2)."""
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
