"""Microseconds of public calls on the fixed grasp: each start alone, and the whole optimisation from it."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np

from grasp_env._check import Array
from grasp_env.force import ForceOptimizer, InitialForceRule, Objective, OfflineBasis
from grasp_env.grasp import Grasp, presets
from training.cases.sets import HELD_OUT
from training.cases.starts import Made, make_starts, phi_options
from training.data.grasps import EVALUATION
from training.trials.arrays import METHODS, Trials

WARM_UP = 20
"""Calls of every kind that are not counted."""
BASES = 20
"""Random grasps whose offline basis is timed."""


def optimizers(grasp: Grasp, method: str, starts: dict[str, Made], objective: Objective) -> dict[str, ForceOptimizer]:
    """One optimizer per start, as a control loop would make it once."""
    phi = phi_options(objective)
    return {key: ForceOptimizer(grasp, method=method, **made.options, **phi) for key, made in starts.items()}


def time_calls(
    wrenches: Array,
    rules: Mapping[str, InitialForceRule],
    objective: Objective,
    repeats: int,
    tick: Callable[[], None] = lambda: None,
) -> Trials:
    """Times every start on every wrench, `repeats` times over, starts taking turns at each repeat.

    A block of one start's calls in a row is what a control loop that does nothing else pays: its code and data are in the cache;
    between the calls of others everything takes longer. The previous solution is that of the wrench before, as in a loop.

    Args:
        wrenches: (n, 6).
        rules: see `make_starts`.
        objective: Phi.
        repeats: R.
        tick: called once per repeat.

    Returns:
        "<start>/start_us" and "<method>/<start>/total_us" (R, n), nan where there is no start; "basis/offline_us" (1 + BASES,).
    """
    grasp, count = presets.paper_cuboid(), len(wrenches)
    starts = make_starts(objective, rules)
    loops = {method: optimizers(grasp, method, starts, objective) for method in METHODS}
    out = {f"{key}/start_us": np.full((repeats, count), np.nan) for key in starts}
    out |= {f"{method}/{key}/total_us": np.full((repeats, count), np.nan) for method in METHODS for key in starts}
    newton = ForceOptimizer(grasp, method="newton", **phi_options(objective))
    optima = [newton.solve(load).force for load in wrenches]
    collecting = gc.isenabled()
    try:
        for turn in range(-1, repeats):
            gc.collect()
            gc.disable()
            loads = wrenches[:WARM_UP] if turn < 0 else wrenches
            for key, start in starts.items():
                calls: dict[str, Callable[[int], object]] = {
                    f"{method}/{key}/total_us": lambda k, m=method, key=key: loops[m][key].solve(wrenches[k])
                    for method in METHODS
                }
                calls[f"{key}/start_us"] = lambda k, s=start: s(grasp, wrenches[k], optima[k - 1])
                for name, call in calls.items():
                    for k in range(WARM_UP):
                        with suppress(Exception):  # a rule of anybody's: what it does wrong is counted in the trials
                            call(k % len(loads))
                    for k in range(len(loads)):
                        begin = time.perf_counter_ns()
                        try:
                            call(k)
                        except Exception:
                            continue
                        end = time.perf_counter_ns()
                        if turn >= 0:
                            out[name][turn, k] = (end - begin) / 1e3
            if turn >= 0:
                tick()
    finally:
        if collecting:
            gc.enable()
    return {**out, "basis/offline_us": time_bases(objective)}


def time_bases(objective: Objective) -> Array:
    """(1 + BASES,) microseconds of the offline basis: of the fixed grasp, and of random ones of four contacts."""
    rng = np.random.default_rng([HELD_OUT, 1 << 21])
    grasps = [presets.paper_cuboid(), *(EVALUATION.closed(rng, 4) for _ in range(BASES))]
    times = []
    for grasp in grasps:
        best = np.inf
        for _ in range(3):
            begin = time.perf_counter_ns()
            OfflineBasis.compute(grasp, objective)
            best = min(best, (time.perf_counter_ns() - begin) / 1e3)
        times.append(best)
    return np.array(times)
