"""Timers of the benchmarks: per problem, best of several passes; the compiled ones take the time inside the loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.force import ForceOptimizer

WARM_UP = 20
"""Calls before the clock starts."""


def python_times(solve: Callable[[Array], object], wrenches: Array, passes: int) -> Array:
    """(n,) seconds per call of `solve` from Python, best of `passes`."""
    loads = [w.copy() for w in wrenches]
    for w in loads[:WARM_UP]:
        solve(w)
    best = np.full(len(loads), np.inf)
    for _ in range(passes):
        for k, w in enumerate(loads):
            begin = time.perf_counter_ns()
            solve(w)
            best[k] = min(best[k], time.perf_counter_ns() - begin)
    return best * 1e-9


def compiled_times(optimizer: ForceOptimizer, wrenches: Array, passes: int, records: Array) -> Array:
    """(n,) seconds per compiled call of a `conic` or `newton` optimizer, start and certificates included.

    Args:
        optimizer: on hard contacts with force closure.
        wrenches: (n, 6).
        passes: best of so many.
        records: (n, 20 + 7N) receives the solutions.
    """
    solver: Any = optimizer._method
    loads, best = np.array(wrenches), np.empty(len(wrenches))
    solver.solver.times(loads[:WARM_UP], 1, records[:WARM_UP], best[:WARM_UP])
    solver.solver.times(loads, passes, records, best)
    return best
