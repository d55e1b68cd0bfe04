"""Grasps and wrenches that our solvers are timed on, and the clock of their compiled calls."""

from __future__ import annotations

import numpy as np

from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.grasp.wrench import sample_ball
from grasp_env.inputs.arguments import Array
from training.data.grasps import BENCH, PRESETS

LEVER = 0.05
"""Scale of a finger's Jacobian [m/rad]."""
WARM_UP = 20
"""Number of untimed calls."""


def problems(seed: int, count: int, wrenches: int, number: int = 4) -> list[tuple[Grasp, Array]]:
    """Return `number` grasps with wrenches (n, 6) of the standard ball, `wrenches` in all.

    The first grasp is a preset if there is one of `count` contacts, others are random.
    """
    rng = np.random.default_rng([seed, count])
    loads = np.array_split(sample_ball(rng, wrenches), number)
    grasps = [PRESETS[count]()] if count in PRESETS else []
    grasps += [BENCH.closed(rng, count) for _ in range(number - len(grasps))]
    return list(zip(grasps, loads, strict=True))


def compiled_times(optimizer: ForceOptimizer, wrenches: Array, passes: int) -> tuple[Array, Array]:
    """Return seconds (n,) of a compiled call for each wrench (n, 6), and the solutions' records.

    Certificates are included. Loop and clock are compiled, too; every call is the first of its
    optimizer.
    """
    loads = np.array(wrenches)
    best = np.empty(len(loads))
    records = np.zeros((len(loads), optimizer.core.size))
    optimizer.core.times(loads[:WARM_UP], 1, records[:WARM_UP], best[:WARM_UP])
    optimizer.core.times(loads, passes, records, best)
    return best, records
