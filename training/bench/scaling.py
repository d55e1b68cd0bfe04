"""Cost per iteration against the number of contacts, with a straight line through it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from grasp_env.force import ForceOptimizer
from grasp_env.force.record import ITERATIONS, record_size
from training.bench.grasps import problems
from training.bench.timing import Effort, compiled_times
from training.report.style import new_figure
from training.runs import provenance

EFFORT = Effort((3, 4, 5, 8, 12, 16, 24, 32, 48, 64, 80, 100), wrenches=200, rounds=1, passes=20)
TOLERANCES = {"conic": 1e-6, "newton": 1e-8}


def scaling(effort: Effort = EFFORT, tick: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Microseconds and iterations of compiled `conic` and `newton` calls, and the line through microseconds per iteration.

    Returns:
        {"rows": [...], "fits": {method: {slope_us, offset_us, r2, exponent}}, ...}; `exponent` is the slope in log-log from
        16 contacts on, 1 for linear cost.
    """
    rows = []
    for count in effort.sizes:
        tick(f"{count} contacts")
        for method, tolerance in TOLERANCES.items():
            times, steps = [], []
            for grasp, loads in problems(effort.seed, count, effort.wrenches):
                records = np.empty((len(loads), record_size(count)))
                optimizer = ForceOptimizer(grasp, method=method, tolerance=tolerance)
                times.append(compiled_times(optimizer, loads, effort.rounds * effort.passes, records))
                steps.append(records[:, ITERATIONS].copy())
            micro, iterations = 1e6 * np.concatenate(times), np.concatenate(steps)
            rows.append({
                "method": method, "contacts": count, "p50_us": float(np.median(micro)),
                "iterations": float(iterations.mean()),
                "us_per_iteration": float(np.median(micro / np.maximum(iterations, 1.0))),
            })  # fmt: skip
    fits = {}
    for method in TOLERANCES:
        n, us = np.array([(row["contacts"], row["us_per_iteration"]) for row in rows if row["method"] == method]).T
        slope, offset = np.polyfit(n, us, 1)
        left = us - (slope * n + offset)
        large = n >= 16
        fits[method] = {
            "slope_us": float(slope),
            "offset_us": float(offset),
            "r2": float(1.0 - (left**2).sum() / ((us - us.mean()) ** 2).sum()),
            "exponent": float(np.polyfit(np.log(n[large]), np.log(us[large]), 1)[0]) if large.sum() > 1 else None,
        }
    return {"kind": "scaling", "rows": rows, "fits": fits, "provenance": provenance()}


def scaling_figure(result: dict[str, Any]) -> Figure:
    """Microseconds per iteration against contacts, with the fitted lines."""
    figure, axes = new_figure(7.0, 4.0)
    for (method, fit), colour in zip(result["fits"].items(), ("#1f5fa8", "#b3261e"), strict=False):
        rows = [row for row in result["rows"] if row["method"] == method]
        n = np.array([row["contacts"] for row in rows])
        axes.plot(n, [row["us_per_iteration"] for row in rows], "o", color=colour, label=method)
        line = fit["slope_us"] * n + fit["offset_us"]
        label = f"{fit['offset_us']:.2f} + {fit['slope_us']:.3f} N us, r2 = {fit['r2']:.3f}"
        axes.plot(n, line, "-", color=colour, alpha=0.6, label=label)
    axes.set_xlabel("contacts N")
    axes.set_ylabel("microseconds per iteration, median")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    return figure
