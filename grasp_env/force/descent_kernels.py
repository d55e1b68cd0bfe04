"""How a descent on Phi ends, for all loops: codes of the compiled ones and of their plain twins."""

from __future__ import annotations

CONVERGED, LIMIT, STALLED = 0, 1, 2
SHORTEST = 1e-10
"""The first trial of an iteration moves x by at least this fraction of its length."""
BALANCE_TOLERANCE = 1e-8
"""A start may miss balance by this much of the wrench and force it carries; the rest is an error of the rule."""
