"""The golden files, one group of cases each."""

from __future__ import annotations

from collections.abc import Callable

from golden import edges, environment, learned, memory, pipeline, refused, solver
from golden.case import Case

GROUPS: dict[str, Callable[[], dict[str, Case]]] = {
    "solver": solver.cases,
    "memory": memory.cases,
    "edges": edges.cases,
    "refused": refused.cases,
    "pipeline": pipeline.cases,
    "learned": learned.cases,
    "environment": environment.cases,
}
"""What a file of that name holds."""
