"""Throughput of batches on one core and on all, and the memory of a large one."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from grasp_env.force import ForceLimits, optimize_forces
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import sample_ball
from policies import LearnedInitialForce
from training.bench.timing import Effort
from training.runs import provenance

KINDS: dict[str, dict[str, Any]] = {
    "newton": {"method": "newton"},
    "newton, tolerance 1e-8": {"method": "newton", "tolerance": 1e-8},
    "newton from four_finger": {"method": "newton", "initial": LearnedInitialForce.pretrained()},
    "newton within limits": {"method": "newton", "limits": ForceLimits(max_normal=20.0)},
    "conic": {"method": "conic"},
}
"""What is measured: keywords of `optimize_forces`, the defaults where none is named."""


EFFORT = Effort((4,), wrenches=1_000_000, rounds=3, passes=1)


def batch(effort: Effort = EFFORT, tick: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Solves per second of `optimize_forces` at four contacts (best of the rounds, workers taking turns) and peak memory.

    Returns:
        {"rows": [{method, workers, per_second, optimal}], "speedup": {method: all cores over one}, "peak_gib"}; the peak is
        of the whole process, wrenches and one result included.
    """
    grasp = presets.paper_cuboid()
    loads = sample_ball(np.random.default_rng(effort.seed), effort.wrenches)
    cores = os.cpu_count() or 1
    rows = []
    for kind, options in KINDS.items():
        optimize_forces(grasp, loads[:100], **options)
        best: dict[int, float] = {}
        optimal = 0
        for turn in range(effort.rounds):
            for workers in sorted({1, cores}):
                tick(f"{kind}, {workers} workers, round {turn + 1} of {effort.rounds}")
                begin = time.perf_counter()
                result = optimize_forces(grasp, loads, workers=workers, **options)
                best[workers] = min(best.get(workers, np.inf), time.perf_counter() - begin)
                optimal = int(result.optimal.sum())
                del result
        rows += [
            {"method": kind, "workers": workers, "per_second": effort.wrenches / seconds, "optimal": optimal}
            for workers, seconds in best.items()
        ]
    rate = {(row["method"], row["workers"]): row["per_second"] for row in rows}
    return {
        "kind": "batch",
        "wrenches": effort.wrenches,
        "rows": rows,
        "speedup": {method: rate[method, cores] / rate[method, 1] for method in KINDS},
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "provenance": provenance(),
    }
