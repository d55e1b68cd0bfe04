"""One solution as one row of numbers: what solvers write, single or in a batch, and `ForceSolution` reads.

The layout is the core's `Summary` (`core/include/grasp/record.hpp`); its places are read off there.
"""

from __future__ import annotations

from grasp_env.core import codes, record_fields, record_size

_PLACES, _CODES = record_fields(), codes()

CODE, ITERATIONS, TRIALS, OBJECTIVE, BOUND, RESIDUAL, MARGIN, EXCESS = (
    _PLACES[name]
    for name in ("code", "iterations", "trials", "objective", "lower_bound", "residual", "margin", "limit_excess")
)
"""How it ended and what certifies it."""
WRENCH = _PLACES["wrench"]
"""6: the wrench that is balanced."""
MULTIPLIERS = _PLACES["multipliers"]
"""6: nu of balance: grad objective = G^T nu (+ the cone multipliers), d objective / d w = -nu."""
FORCE = _PLACES["force"]
"""3N force, then 3N initial force, then N torsion."""
CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED, LIMITS_EXCEEDED = (
    _CODES[name] for name in ("converged", "limit", "stalled", "infeasible", "refused", "limits_exceeded")
)
"""How a solve ends; REFUSED: numbers that are not finite, or no start: the general path says in words what is wrong."""

__all__ = [
    "BOUND",
    "CODE",
    "CONVERGED",
    "EXCESS",
    "FORCE",
    "INFEASIBLE",
    "ITERATIONS",
    "LIMIT",
    "LIMITS_EXCEEDED",
    "MARGIN",
    "MULTIPLIERS",
    "OBJECTIVE",
    "REFUSED",
    "RESIDUAL",
    "STALLED",
    "TRIALS",
    "WRENCH",
    "record_size",
]
