"""Where no force keeps the limits: the balanced force inside the cones that exceeds them least, by the general program.

    min t  s.t.  G x + w = 0,  x in the cones,  torsion within its friction,  A x <= b + t limit,  t >= 0

What the core's `excess.hpp` does for limits on one contact each, for joints that fingers share and for soft contacts too.
"""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.core import EXCESS_FLOOR, EXCESS_WITHIN
from grasp_env.force.limits import ForceLimits
from grasp_env.force.program import ForceProgram, _by_contact
from grasp_env.force.record import (
    BOUND,
    CODE,
    EXCESS,
    FORCE,
    ITERATIONS,
    LIMITS_EXCEEDED,
    MARGIN,
    MULTIPLIERS,
    OBJECTIVE,
    RESIDUAL,
    WRENCH,
    record_size,
)
from grasp_env.force.solution import ForceSolution
from grasp_env.grasp.grasp import Grasp

HALF = 0.5
"""Of what is allowed, that is given away for a force well inside the cones."""
LARGEST = 1e3
"""Times wrench and limits: normal forces among which the bound holds."""


def least_excess(grasp: Grasp, limits: ForceLimits, wrench: Wrench, method: str) -> ForceSolution | None:
    """The solution with status LIMITS_EXCEEDED, or None where none is found: not even the cones balance the wrench.

    Args:
        grasp: any contacts.
        limits: that no force keeps.
        wrench: (6,).
        method: whose solution it is.
    """
    program = ForceProgram(grasp, limits)
    count, (given, limited) = grasp.n_contacts, limits._rows(grasp)
    own = len(program.bound) - len(given.bound)  # torsions, which no excess moves
    size = program._size(wrench)
    unit, bounds = program.frame @ wrench / size, program.bound / size
    share = np.concatenate([np.zeros(own), limited / program.row_size[own:]])
    scale = float(share.max()) / size
    share = share / size / scale  # t in units in which the largest share is one
    structure = _by_contact(np.concatenate([program.balance, program.rows, np.zeros((1, count, 4))]))
    coupling = np.concatenate([np.zeros(6), -share, [-1.0]])[:, None]
    right = np.concatenate([-unit, bounds, [0.0]])
    state, info = program._run(structure, coupling, right, 6, np.zeros((count, 4)), np.ones(1), 1e-4, 200, 1e-10)
    bound, nu = _bound(program, state.y, share, unit, bounds)
    least = float(state.t[0])
    # the force deepest inside limits that are raised by a little more
    program.bound = program.bound + size * share * max(
        (1.0 + HALF * EXCESS_WITHIN) * least, least + HALF * EXCESS_FLOOR * scale
    )
    deepest, twist = program.deepest(wrench)
    if twist is not None:
        return None
    z, bound = deepest.z, bound / scale
    force, torsion = program.force(z), program.torsion(z)
    f = np.column_stack([force, torsion]).reshape(-1)
    excess = float(((given.matrix @ f - given.bound) / limited).max(initial=0.0))
    margin, residual = grasp.cone_margin(force), program.residual(z, wrench)
    turned = program.bound[:own] - np.einsum("kia,ia->k", program.rows[:own], z)
    inside = margin > 0.0 and (z[program.soft, 3] >= 0.0).all() and (turned >= 0.0).all()
    if not (inside and residual <= 1e-9 * size and excess - bound <= max(EXCESS_WITHIN * bound, EXCESS_FLOOR)):
        return None
    record = np.zeros(record_size(count))
    record[CODE], record[ITERATIONS], record[OBJECTIVE] = LIMITS_EXCEEDED, info[1] + deepest.iterations, excess
    record[BOUND], record[EXCESS], record[MARGIN], record[RESIDUAL] = bound, excess, margin, residual
    record[WRENCH : WRENCH + 6] = wrench
    record[MULTIPLIERS : MULTIPLIERS + 6] = program.frame.T @ nu / size / scale
    record[FORCE : FORCE + 3 * count] = record[FORCE + 3 * count : FORCE + 6 * count] = force.reshape(-1)
    record[FORCE + 6 * count :] = torsion
    return ForceSolution(record, method, "central")


def _bound(program: ForceProgram, y: Array, share: Array, unit: Array, bounds: Array) -> tuple[float, Array]:
    """(bound of t, nu of balance) of multipliers y: scaled to price t at one; what they lack of the dual cones is paid for."""
    prices = np.maximum(y[6 : 6 + len(share)], 0.0)
    total = max(float(prices @ share), 1e-300)
    y, prices = y[:6] / total, prices / total
    q = np.einsum("rna,r->na", program.balance, y) + np.einsum("kna,k->na", program.rows, prices)
    for row, k in enumerate(np.flatnonzero(program.soft)):
        # w has no price to move away from: its row's, at the expense of u
        raised = max(0.0, -float(q[k, 3])) / program.rows[row, k, 3]
        prices[row] += raised
        q[k] += raised * program.rows[row, k]
    lacking = float(np.maximum(0.0, np.hypot(q[:, 1], q[:, 2]) - q[:, 0]).max())
    return float(y @ unit - prices @ bounds) - lacking * LARGEST, -y
