"""`grasp report --compare A B`: comparison of two runs, with intervals."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env.errors import InvalidInputError
from training.evaluation.report.page import facts_of, render
from training.evaluation.results.columns import KEYS
from training.evaluation.results.run import Run, understood
from training.evaluation.results.statistics import mean_interval, ratio_interval
from training.evaluation.results.table import Rows, numbers, pd

METRICS: dict[str, bool] = {
    "iterations": True,
    "microseconds": True,
    "per_second": True,
    "nanoseconds": True,
    "held": False,
    "drift": True,
    "normal_force": True,
    "return": False,
}
"""Columns to compare; True: by the ratio of medians, False: by the difference of means."""
INTRO = (
    "This page compares two runs row by row: rows with equal keys, problem and seed are pairs. "
    "Iterations, times, drift and force are compared by the ratio of the medians B / A, hold rates and returns by the difference of "
    "the means B - A, each with a 95 % bootstrap interval over the pairs; if the interval contains 1, or 0, the verdict is a tie. "
    "The columns are defined in the run.json of each run."
)


def compare(a: Rows, b: Rows) -> Rows:
    """Compare two tables: one row for each combination of keys and metric that both have.

    Returns:
        The keys, "metric", "pairs", "A" and "B" (medians, or means), the ratio or difference as
        "change" with "low" and "high", and "verdict": "lower", "higher" or "tie". Ties come last.
    """
    shared = a.columns.intersection(b.columns)
    keys = [name for name in KEYS if name in shared]
    pairing = [*keys, *shared.intersection(["problem", "seed", "training_seed", "step"])]
    if not pairing:
        raise InvalidInputError("the two runs have no key in common: compare runs of one command")
    both = a.merge(b, on=pairing, suffixes=("_a", "_b"))
    rows: list[dict[str, Any]] = []
    for _, group in both.groupby(keys or pairing[:1], sort=False, dropna=False):
        values = {key: group[key].iloc[0] for key in keys}
        for metric in (name for name in METRICS if name in shared):
            first = numbers(group, f"{metric}_a")
            second = numbers(group, f"{metric}_b")
            known = np.isfinite(first) & np.isfinite(second)
            if known.any():
                row = _row(first[known], second[known], METRICS[metric])
                rows.append({**values, "metric": metric, **row})
    rows.sort(key=lambda row: row["verdict"] == "tie")
    return pd.DataFrame(rows)


def _row(first: np.ndarray, second: np.ndarray, by_ratio: bool) -> dict[str, Any]:
    if by_ratio:
        change, low, high = ratio_interval(second, first)
        level = 1.0
        middles = (np.median(first), np.median(second))
        if middles == (0.0, 0.0):
            change = low = high = 1.0
    else:
        change = float((second - first).mean())
        low, high = mean_interval(second - first)
        level = 0.0
        middles = (first.mean(), second.mean())
    verdict = "tie" if low <= level <= high else "lower" if high < level else "higher"
    columns = {"pairs": len(first), "A": float(middles[0]), "B": float(middles[1])}
    return {**columns, "change": change, "low": low, "high": high, "verdict": verdict}


def write(a: Run, b: Run, out: Run) -> Rows:
    """Write compare.html into `out` and return its table.

    Raises:
        InvalidInputError: a run is not finished, or the two have no row in common.
    """
    with understood(a.folder), understood(b.folder):
        (rows_a, about_a), (rows_b, about_b) = a.load(), b.load()
        table = compare(rows_a, rows_b)
    if table.empty:
        raise InvalidInputError(
            f"{a.folder} and {b.folder} have no rows in common: compare runs of one command"
        )
    ties = int((table["verdict"] == "tie").sum())
    note = f"{len(table) - ties} of {len(table)} comparisons differ, {ties} are ties."
    page = render(
        title=f"{a.folder.name} (A) against {b.folder.name} (B)",
        intro=INTRO,
        quick=bool(about_a.get("quick") or about_b.get("quick")),
        tables=[("What differs first", note, table)],
        facts=[(f"A: {name}", value) for name, value in facts_of(about_a)]
        + [(f"B: {name}", value) for name, value in facts_of(about_b)],
    )
    out.write_text("compare.html", page)
    return table
