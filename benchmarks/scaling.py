"""Cost against the number of contacts, with a straight line through the time of an iteration."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.benchmark import Benchmark, TimingSettings, tick
from benchmarks.problem import compiled_times, problems
from grasp_env.force import ForceOptimizer
from grasp_env.force.record import ITERATIONS
from training.evaluation.results.table import join, pd

TOLERANCES = {"conic": 1e-6, "newton": 1e-8}


def run(settings: TimingSettings) -> pd.DataFrame:
    """Return microseconds and iterations of compiled calls, a row for each problem."""
    tables = []
    for count in settings.contacts:
        tick(f"{count} contacts")
        for method, tolerance in TOLERANCES.items():
            for group, (grasp, loads) in enumerate(
                problems(settings.seed, count, settings.wrenches)
            ):
                optimizer = ForceOptimizer(grasp, method=method, tolerance=tolerance)
                passes = settings.rounds * settings.passes
                seconds, records = compiled_times(optimizer, loads, passes)
                steps = records[:, ITERATIONS]
                tables.append(
                    pd.DataFrame(
                        {
                            "method": method,
                            "contacts": count,
                            "group": group,
                            "microseconds": 1e6 * seconds,
                            "iterations": steps,
                            "step_microseconds": 1e6 * seconds / np.maximum(steps, 1.0),
                        }
                    )
                )
    return join(tables)


def lines(summary: pd.DataFrame) -> Iterator[str]:
    """Yield the line through the medians of each method, and the log-log slope from 16 contacts on."""
    for method, rows in summary.groupby("method", sort=False):
        n, us = (
            rows[name].to_numpy(np.float64) for name in ("contacts", "step_microseconds_median")
        )
        if len(n) < 3:
            continue
        slope, offset = np.polyfit(n, us, 1)
        residuals = us - (slope * n + offset)
        r2 = 1.0 - (residuals**2).sum() / ((us - us.mean()) ** 2).sum()
        power = ""
        large = n >= 16
        if large.sum() > 1:
            exponent = np.polyfit(np.log(n[large]), np.log(us[large]), 1)[0]
            power = f", log-log slope {exponent:.2f} from 16 contacts on"
        yield f"{method}: {offset:.2f} + {slope:.3f} N us for an iteration, r2 {r2:.3f}{power}"


BENCHMARK = Benchmark(
    run,
    TimingSettings(
        (3, 4, 5, 8, 12, 16, 24, 32, 48, 64, 80, 100), wrenches=200, rounds=1, passes=20
    ),
    quick={"wrenches": 80, "passes": 4},
    shown=("microseconds_median", "iterations_median", "step_microseconds_median"),
    notes=lines,
)
