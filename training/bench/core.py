"""This checkout beside an earlier one, taking turns on one core: the same problems, the same calls, ratios of their times."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError
from training.bench.core_sides import Checkout, Side, first_solve
from training.bench.timing import Effort
from training.runs import provenance
from training.runs.claims import bounded

EFFORT = Effort((3, 4, 5, 8, 16, 50), wrenches=400, rounds=5, passes=4)
ROWS = {
    "newton": "Newton on Phi from the 12-basis to 1e-8, compiled call",
    "newton_python": "the same, ForceOptimizer.solve from Python",
    "newton_default": "the same to 1e-4, the default",
    "newton_previous": "ForceOptimizer.solve to 1e-8, initial='previous', wrenches on a smooth path",
    "conic": "conic to 1e-6, compiled call",
    "conic_python": "the same, ForceOptimizer.solve from Python",
    "pipeline_newton": "moving contacts to certified force: ForcePipeline(method='newton').solve on a smooth path",
    "from_contacts": "Grasp.from_contacts",
    "unchecked": "Grasp.unchecked",
    "flow": "the paper's flow, ForceOptimizer(method='reduced_flow').solve",
    "pipeline_flow": "moving contacts, ForcePipeline(method='reduced_flow').solve on a smooth path",
    "soft": "soft contacts, ForceOptimizer(method='newton').solve to 1e-4",
    "max": "least largest normal force, ForceOptimizer(method='conic', criterion='max').solve to 1e-6",
}
"""What is timed, see `core_worker.ROWS`; after each solve from Python `.force` and `.status` are read."""
SLOWER = 1.05
"""Most time of a row, in parts of the baseline's."""
START_S = 0.5
"""Most seconds from the start of a process to its first force."""
STARTED = ("newton", "conic", "reduced_flow", "full_flow")


def core(
    effort: Effort = EFFORT,
    baseline: Path | None = None,
    start: int = 0,
    rows: tuple[str, ...] = tuple(ROWS),
    tick: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Times all rows in rounds, this checkout first, then the baseline, never both at once.

    Args:
        effort: how much.
        baseline: another checkout with its own .venv; None: only this one is timed.
        start: first solves of so many new processes per method and side; 0: none.
        rows: those of `ROWS` to time.
        tick: told what runs.

    Returns:
        {"rows": [...], "starts": [...], "claims": [...], "missing": {row: reason}, "baseline": its commit and versions or None}.

    Raises:
        InvalidInputError: the baseline is no installed checkout, or makes other problems.
        GraspError: a process ended.
    """
    checkouts = {"now": Checkout.here()} | ({} if baseline is None else {"baseline": Checkout.at(baseline)})
    found: list[dict[str, Any]] = []
    missing: dict[str, str] = {}
    with ExitStack() as stack:
        sides: dict[str, Side] = {}
        for name, checkout in checkouts.items():
            tick(f"starting the worker of {name}")
            sides[name] = stack.enter_context(closing(Side(checkout)))
        for count in effort.sizes:
            tick(f"{count} contacts: problems")
            made = [
                side.ask(contacts=count, wrenches=effort.wrenches, seed=effort.seed)["problems"]
                for side in sides.values()
            ]
            if not np.allclose(made[0], made[-1], rtol=0.0, atol=1e-9):
                raise InvalidInputError(
                    "the baseline's training/bench/grasps.py makes other problems: nothing to compare"
                )
            best: dict[str, dict[str, Array]] = {}
            for turn in range(effort.rounds):
                for key in rows:
                    tick(f"{count} contacts, round {turn + 1} of {effort.rounds}: {key}")
                    taken = _turn(sides, missing, count, key, effort.passes)
                    before = best.get(key, taken)
                    best[key] = {name: np.minimum(before[name], taken[name]) for name in taken}
            for key in rows:
                answers = _turn(sides, missing, count, key, 0)
                if answers:
                    found.append(_row(key, count, best[key], answers))
        about = {name: {key: side.about[key] for key in ("commit", "versions")} for name, side in sides.items()}
    starts = _starts(checkouts, start, tick)
    return {
        "kind": "core",
        "settings": effort.settings(),
        "rows": found, "starts": starts, "claims": claims(found, starts), "missing": missing,
        "baseline": about.get("baseline"), "load": os.getloadavg(), "provenance": provenance(),
    }  # fmt: skip


def _turn(sides: dict[str, Side], missing: dict[str, str], count: int, key: str, passes: int) -> dict[str, Array]:
    """Of each side in turn (n,) seconds of a row, or its answers where passes = 0; {} and a reason where one has none."""
    out: dict[str, Array] = {}
    for name, side in sides.items():
        if key not in missing:
            answer = side.ask(row=key, passes=passes)
            if "error" in answer:
                missing[key] = f"{name}, {count} contacts: {answer['error']}"
            else:
                out[name] = np.array(answer["values"], dtype=np.float64)  # None: nan
    return {} if key in missing else out


def _row(key: str, count: int, best: dict[str, Array], answers: dict[str, Array]) -> dict[str, Any]:
    """Medians and p99 [us] of both sides, their ratios, failures, and how far the objectives differ, relative."""
    row: dict[str, Any] = {"method": key, "contacts": count, "problems": len(best["now"])}
    for name in best:
        prefix = "" if name == "now" else f"{name}_"
        row[f"{prefix}p50_us"] = 1e6 * float(np.median(best[name]))
        row[f"{prefix}p99_us"] = 1e6 * float(np.percentile(best[name], 99))
        row[f"{prefix}failed"] = int(np.isnan(answers[name]).sum())
    if "baseline" in best:
        row["ratio_p50"] = row["p50_us"] / row["baseline_p50_us"]
        row["ratio_p99"] = row["p99_us"] / row["baseline_p99_us"]
        apart = np.abs(answers["now"] / answers["baseline"] - 1.0)
        row["apart_max"] = float(np.nanmax(apart, initial=0.0))
    return row


def _starts(checkouts: dict[str, Checkout], number: int, tick: Callable[[str], None]) -> list[dict[str, Any]]:
    out = []
    for method in STARTED if number else ():
        taken: dict[str, list[dict[str, Any]]] = {name: [] for name in checkouts}
        for turn in range(number):
            for name, checkout in checkouts.items():
                tick(f"first solve, {method}, {turn + 1} of {number}: {name}")
                taken[name].append(first_solve(checkout, method))
        for name, runs in taken.items():
            seconds = [run["seconds"] for run in runs]
            out.append({
                "method": method, "side": name, "processes": number, "median_s": float(np.median(seconds)),
                "min_s": min(seconds), "max_s": max(seconds),
                "import_median_s": float(np.median([run["import_seconds"] for run in runs])),
                "loaded": runs[-1]["loaded"],
            })  # fmt: skip
    return out


def claims(rows: list[dict[str, Any]], starts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """No row slower than the baseline's, by the worst of its numbers of contacts; first solves in time."""
    out = []
    for key in dict.fromkeys(row["method"] for row in rows if "ratio_p50" in row):
        worst = max((row for row in rows if row["method"] == key), key=lambda row: row["ratio_p50"])
        said = f" (N = {worst['contacts']}, the worst)"
        out.append(
            bounded(f"{key}: time over the baseline's, medians", "at most", SLOWER, worst["ratio_p50"], said=said)
        )
    return out + [
        bounded(f"first solve of a new process, {row['method']}", "at most", START_S, row["median_s"], "s")
        for row in starts if row["side"] == "now"
    ]  # fmt: skip
