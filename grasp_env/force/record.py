"""Layout of the row that a solver writes and `ForceSolution` reads; a batch is a table of rows.

The core's `Record` (`core/include/grasp/record.hpp`) defines the layout; the offsets are read from
the compiled module.
"""

from __future__ import annotations

from grasp_env.core import codes, codes_with_a_force, record_fields

_PLACES = record_fields()
_CODES = codes()

CODE, ITERATIONS, TRIALS, OBJECTIVE, BOUND, RESIDUAL, MARGIN, START, REPLACED, OUTSIDE, CONTACTS = (
    _PLACES[name]
    for name in (
        "code",
        "iterations",
        "trials",
        "objective",
        "lower_bound",
        "residual",
        "margin",
        "start",
        "replaced",
        "outside",
        "contacts",
    )
)
"""Offsets of the outcome, the certificates, the start, and N."""
WRENCH = _PLACES["wrench"]
"""Offset of the balanced wrench, 6 numbers."""
MULTIPLIERS = _PLACES["multipliers"]
"""Offset of nu, 6 numbers: grad objective = G^T nu (+ the cone multipliers), d objective / d w =
-nu; the twist if infeasible."""
FORCE = _PLACES["force"]
"""Offset of the force, 3N numbers; 3N initial force, N torsion, 9N frames, joint torques and
multipliers of limits follow."""
CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED, LIMITS_EXCEEDED, RANK_LOST, UNDECIDED, STARTED = (
    _CODES[name]
    for name in (
        "converged",
        "limit",
        "stalled",
        "infeasible",
        "refused",
        "limits_exceeded",
        "rank_lost",
        "undecided",
        "started",
    )
)
"""Codes of the outcomes."""
RESULTS = codes_with_a_force()
"""Codes of rows that contain a force."""
