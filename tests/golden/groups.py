"""The golden files, one group of cases each."""

from __future__ import annotations

from collections.abc import Callable

from golden import edges, memory, pipeline, solver
from golden.case import Case

GROUPS: dict[str, Callable[[], dict[str, Case]]] = {
    "solver": solver.cases,
    "memory": memory.cases,
    "edges": edges.cases,
    "pipeline": pipeline.cases,
}
"""What a file of that name holds."""
