"""One solution as one row of numbers: what compiled solvers write, single or in a batch, and `ForceSolution` reads."""

from __future__ import annotations

CODE, ITERATIONS, TRIALS, OBJECTIVE, BOUND, RESIDUAL, MARGIN = range(7)
"""How it ended and what certifies it."""
INFEASIBLE, REFUSED = 3, 4
"""Codes besides `descent_kernels`' CONVERGED, LIMIT, STALLED: proven infeasible; a wrench that is not finite."""
WRENCH = 8
"""6: the wrench that is balanced."""
MULTIPLIERS = 14
"""6: nu of balance: grad objective = G^T nu (+ the cone multipliers), d objective / d w = -nu."""
FORCE = 20
"""3N force, then 3N initial force, then N torsion."""


def record_size(count: int) -> int:
    """Numbers in a record of N contacts."""
    return FORCE + 7 * count
