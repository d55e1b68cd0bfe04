"""The first solve of a new process, for `grasp bench core --start`: `python -c <this source> method`, in any checkout."""

from __future__ import annotations

import json
import sys
import time

HEAVY = ("scipy", "torch")


def first_solve(method: str) -> None:
    """Imports, solves once, reads the force; prints when (CLOCK_MONOTONIC [s]) and which of `HEAVY` were imported by then."""
    from grasp_env.force import ForceOptimizer
    from grasp_env.grasp import presets

    imported = time.monotonic()
    solution = ForceOptimizer(presets.paper_cuboid(), method=method).solve([1, 0.5, -0.6, -0.1, 0.2, 0])
    status = (solution.force, solution.status)[1]
    solved = time.monotonic()
    loaded = [name for name in HEAVY if name in sys.modules]
    print(json.dumps({"imported": imported, "solved": solved, "status": status.name, "loaded": loaded}))


if __name__ == "__main__":
    first_solve(sys.argv[1])
