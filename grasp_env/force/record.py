"""Layout of the row that a solver writes and `ForceSolution` reads; a batch is a table of rows.

The core's `Record` (`core/include/grasp/record.hpp`) defines the layout; the offsets are read from
the compiled module.
"""

from __future__ import annotations

from grasp_env.core import codes, codes_with_a_force, record_fields

_AT = record_fields()
_CODES = codes()

CODE = _AT["code"]
ITERATIONS = _AT["iterations"]
TRIALS = _AT["trials"]
OBJECTIVE = _AT["objective"]
BOUND = _AT["lower_bound"]
RESIDUAL = _AT["residual"]
MARGIN = _AT["margin"]
START = _AT["start"]
REPLACED = _AT["replaced"]
OUTSIDE = _AT["outside"]
CONTACTS = _AT["contacts"]
"""Offset of N; those above are of the outcome, the certificates and the start."""
JOINTS = _AT["joints"]
LIMITS = _AT["limits"]
"""Offsets of the numbers of torques and of limits."""
WRENCH = _AT["wrench"]
"""Offset of the balanced wrench, 6 numbers."""
WRENCH_WITH_PRELOAD = _AT["wrench_with_preload"]
"""Offset of the same plus what the preloads make, 6 numbers."""
MULTIPLIERS = _AT["multipliers"]
"""Offset of `ForceSolution.multipliers`, 6 numbers; the twist if infeasible."""
FORCE = _AT["force"]
"""Offset of the force, 3N numbers; 3N initial force, N torsion, 9N frames, N shares of friction,
joint torques and multipliers of limits follow."""

CONVERGED = _CODES["converged"]
LIMIT = _CODES["limit"]
STALLED = _CODES["stalled"]
INFEASIBLE = _CODES["infeasible"]
REFUSED = _CODES["refused"]
LIMITS_EXCEEDED = _CODES["limits_exceeded"]
RANK_LOST = _CODES["rank_lost"]
UNDECIDED = _CODES["undecided"]
STARTED = _CODES["started"]
RESULTS = codes_with_a_force()
"""Codes of rows that contain a force."""
