"""The timer of compiled calls: per problem, best of several passes, the time taken inside the loop. From Python: `peers.best_times`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.force import ForceOptimizer
from training.peers.problem import WARM_UP


@dataclass(frozen=True)
class Effort:
    """How much a benchmark times.

    Attributes:
        sizes: numbers of contacts.
        wrenches: problems per size, shared out over four grasps; at least 8.
        rounds: in which the contestants take turns, so that a busy second of the machine hits all alike.
        passes: of a round; a problem's time is the best of rounds * passes calls.
        seed: of the problems.
    """

    sizes: tuple[int, ...]
    wrenches: int
    rounds: int
    passes: int
    seed: int = 0

    def settings(self) -> dict[str, Any]:
        """For the JSON, all but the sizes, which its rows say."""
        return {name: value for name, value in vars(self).items() if name != "sizes"} | {"threads": 1}


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
