"""The timer of compiled calls: per problem, best of several passes, the time taken inside the loop. From Python: `peers.best_times`."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.force import ForceOptimizer
from training.peers.problem import WARM_UP


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
