"""Throughput of batches on one core and on all, and the memory of a large one."""

from __future__ import annotations

import os
import resource
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.benchmark import Benchmark, tick
from grasp_env.force import ForceLimits, optimize_forces
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import sample_ball
from policies import LearnedInitialForce
from training.evaluation.results.table import pd, table

KINDS: dict[str, dict[str, Any]] = {
    "newton": {"method": "newton"},
    "newton, tolerance 1e-8": {"method": "newton", "tolerance": 1e-8},
    "newton from four_finger": {"method": "newton", "initial": LearnedInitialForce.pretrained()},
    "newton within limits": {"method": "newton", "limits": ForceLimits(max_normal=20.0)},
    "conic": {"method": "conic"},
}
"""Measured cases: keywords of `optimize_forces`."""


@dataclass(frozen=True)
class BatchSettings:
    """Settings of a benchmark.

    Attributes:
        wrenches: wrenches in a batch, four contacts each.
        rounds: rounds in which one core and all cores take turns.
        seed: seed of the wrenches.
    """

    wrenches: int = 1_000_000
    rounds: int = 3
    seed: int = 0


def run(settings: BatchSettings) -> pd.DataFrame:
    """Return solves per second of `optimize_forces`, a row for each round.

    `ratio` is the time of all cores over that of one. The last row is the peak memory of the
    process, wrenches and one result included.
    """
    grasp = presets.paper_cuboid()
    loads = sample_ball(np.random.default_rng(settings.seed), settings.wrenches)
    rows: list[dict[str, Any]] = []
    for kind, options in KINDS.items():
        optimize_forces(grasp, loads[:100], **options)  # warm-up
        for turn in range(settings.rounds):
            seconds: dict[int, float] = {}
            for workers in sorted({1, os.cpu_count() or 1}):
                tick(f"{kind}, {workers} workers, round {turn + 1} of {settings.rounds}")
                begin = time.perf_counter()
                result = optimize_forces(grasp, loads, workers=workers, **options)
                seconds[workers] = time.perf_counter() - begin
                rows.append(
                    {
                        "method": kind,
                        "workers": workers,
                        "problem": turn,
                        "per_second": len(loads) / seconds[workers],
                        "ratio": None if workers == 1 else seconds[workers] / seconds[1],
                        "solves": len(loads),
                        "failures": int((~result.optimal).sum()),
                    }
                )
                del result
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    return table([*rows, {"method": "peak of the process", "mebibytes": peak}])


SHOWN = ("per_second_max", "ratio_median", "solves_max", "failures_max", "mebibytes_max")
BENCHMARK = Benchmark(run, BatchSettings(), quick={"wrenches": 20_000}, shown=SHOWN)
