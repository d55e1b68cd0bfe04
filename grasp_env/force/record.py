"""The row of numbers that a solver writes and `ForceSolution` reads; batches are tables of them.

The layout is the core's `Record` (`core/include/grasp/record.hpp`); its places are read off there.
"""

from __future__ import annotations

from grasp_env.core import codes, record_fields, record_size

_PLACES, _CODES = record_fields(), codes()

CODE, ITERATIONS, TRIALS, OBJECTIVE, BOUND, RESIDUAL, MARGIN, EXCESS, START, REPLACED, OUTSIDE, CONTACTS = (
    _PLACES[name]
    for name in (
        "code", "iterations", "trials", "objective", "lower_bound", "residual", "margin", "limit_excess", "start", "replaced",
        "outside", "contacts",
    )
)  # fmt: skip
"""How it ended, what certifies it, where it began, and N."""
WRENCH = _PLACES["wrench"]
"""6: the wrench that is balanced."""
MULTIPLIERS = _PLACES["multipliers"]
"""6: nu of balance: grad objective = G^T nu (+ the cone multipliers), d objective / d w = -nu; the twist where infeasible."""
FORCE = _PLACES["force"]
"""3N force, then 3N initial force, then N torsion; then 9N frames, joint torques and prices of limits."""
CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED, LIMITS_EXCEEDED, RANK_LOST, UNDECIDED = (
    _CODES[name]
    for name in (
        "converged", "limit", "stalled", "infeasible", "refused", "limits_exceeded", "rank_lost", "undecided"
    )
)  # fmt: skip
"""How a solve ends."""
RESULTS = (CONVERGED, LIMIT, STALLED, LIMITS_EXCEEDED)
"""The codes of rows that hold a force."""


__all__ = [
    "BOUND",
    "CODE",
    "CONTACTS",
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
    "OUTSIDE",
    "RANK_LOST",
    "REFUSED",
    "REPLACED",
    "RESIDUAL",
    "RESULTS",
    "STALLED",
    "START",
    "TRIALS",
    "UNDECIDED",
    "WRENCH",
    "record_size",
]
