"""Numbers of a report from saved trials: pure functions of arrays, numpy only, nothing is solved here.

A new number of a start is a function and its line in `PER_START`, a new part of the report's numbers one in `METRICS`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from training.cases.set_table import SETS
from training.cases.start_table import LEARNED, STARTS
from training.runs.statistics import spread
from training.trials.arrays import (
    BUDGETS,
    LEVELS,
    LIMIT,
    MAGNITUDES,
    METHODS,
    NO_START,
    NOT_APPLICABLE,
    SCENARIOS,
    Trials,
    starts_in,
    worse,
)
from training.trials.claims import claims, training_seconds
from training.trials.findings import findings
from training.trials.ranks import wins

if TYPE_CHECKING:
    from training.runs import Run

BASIS = "linear_combination"
PAPER_TABLE: dict[str, dict[str, Any]] = {
    "single_value": {"normals": [8.30, 2.73, 2.57, 2.40], "steps": 160},
    "lagrange": {"normals": [5.19, 1.59, 1.50, 1.51], "steps": 120},
    "linear_combination": {"normals": [4.15, 1.13, 1.15, 1.26], "steps": 80},
    "optimum": {"normals": [3.25, 0.66, 0.79, 1.21], "steps": None},
}
"""Table I and the steps quoted below it."""


class Saved:
    """What a run has saved, each file read once."""

    def __init__(self, run: Run) -> None:
        self.run, self.about = run, run.read_json("run.json")
        self.trials = {
            name: run.read_arrays(f"trials/{name}.npz") for name in SETS if run.path(f"trials/{name}.npz").is_file()
        }

    @cached_property
    def timing(self) -> Trials:
        """Microseconds, see `timing.time_calls`."""
        return self.run.read_arrays("timing.npz")


def metrics_of(run: Run) -> dict[str, Any]:
    """Everything that a report says, from the files of a run."""
    saved = Saved(run)
    metrics: dict[str, Any] = {name: metric(saved) for name, metric in METRICS.items()}
    metrics["wins"] = wins(metrics)
    metrics["claims"] = claims(metrics)
    metrics["found"] = findings(metrics)
    return metrics


def set_metrics(name: str, trials: Trials) -> dict[str, Any]:
    """What a set holds."""
    info = SETS[name]
    contacts = sorted({int(n) for n in trials["case/n_contacts"]})
    count = len(trials["case/n_contacts"])
    return {"label": info.label, "group": info.group, "cases": count, "contacts": contacts, "note": info.note}


class Column:
    """What a trials file holds of one start by one method; `exists` says where there is a start at all."""

    def __init__(self, trials: Trials, method: str, key: str) -> None:
        self.trials, self.method, self.key = trials, method, key
        self.status = trials[f"{method}/{key}/status"]
        self.exists = self.status < NO_START

    def run(self, name: str) -> np.ndarray:
        """Of the runs from this start, where there are some."""
        return self.trials[f"{self.method}/{self.key}/{name}"][self.exists]

    def start(self, name: str) -> np.ndarray:
        """Of the start itself, nan where there is none."""
        return self.trials[f"{self.key}/{name}"]


def iterations_to(column: Column) -> dict[str, Any]:
    """Iterations to every gap of `LEVELS`, and how many runs never got there."""
    reached = column.run("iterations_to")
    return {
        f"1e-{k + 1}": {**spread(censored(reached[:, k])), "unreached": int((reached[:, k] < 0).sum())}
        for k in range(len(LEVELS[column.method]))
    }


def reasons(said: np.ndarray) -> dict[str, int]:
    """Why cases have no start, and how many: what was raised counts by its kind, with the first message."""
    counts: dict[str, int] = {}
    first: dict[str, str] = {}
    for text in said[said != ""].tolist():
        kind = first.setdefault(text.partition(": ")[0], text)
        counts[kind] = counts.get(kind, 0) + 1
    return counts


def raw_metrics(trials: Trials, key: str) -> dict[str, Any] | None:
    """A network's own output before the repair; None where it applies to no case."""
    gaps = trials[f"{key}/raw_gap"]
    known = ~np.isnan(gaps)
    if not known.any():
        return None
    return {
        "inside": float(np.isfinite(gaps[known]).mean()),
        "margin_min": _extreme(trials[f"{key}/raw_margin"], np.nanmin),
        "residual_max": _extreme(trials[f"{key}/raw_residual"], np.nanmax),
        "gap": spread(gaps[np.isfinite(gaps)]),
    }


def worse_than_basis(trials: Trials, key: str) -> dict[str, int]:
    """How often a start is worse in Phi than the 12-basis of the same grasp; one that does not exist is."""
    status = trials[f"{METHODS[0]}/{key}/status"]
    both = (status != NOT_APPLICABLE) & np.isfinite(trials[f"{BASIS}/gap"])
    ratio = (1.0 + trials[f"{key}/gap"][both]) / (1.0 + trials[f"{BASIS}/gap"][both]) - 1.0
    ratio[status[both] == NO_START] = np.nan  # out of balance: its Phi is of another wrench
    return {"count": int(worse(ratio).sum()), "of": int(both.sum())}


PER_START: dict[str, Callable[[Column], Any]] = {
    "cases": lambda column: int((column.status != NOT_APPLICABLE).sum()),
    "not_applicable": lambda column: int((column.status == NOT_APPLICABLE).sum()),
    "no_start": lambda column: int((column.status == NO_START).sum()),
    "reasons": lambda column: reasons(column.trials.get(f"{column.key}/reason", np.empty(0, str))),
    "not_converged": lambda column: int(((column.status == 1) | (column.status == 2)).sum()),
    "iterations": lambda column: spread(censored(column.run("iterations"))),
    "start_gap": lambda column: spread(column.start("gap")[column.exists]),
    "iterations_to": iterations_to,
    "gap_after": lambda column: {
        str(n): spread(rows) for n, rows in zip(BUDGETS, column.run("gap_after").T, strict=True)
    },
    "margin_min": lambda column: _extreme(column.start("margin"), np.nanmin),
    "residual_max": lambda column: _extreme(column.start("residual"), np.nanmax),
    "raw": lambda column: raw_metrics(column.trials, column.key) if f"{column.key}/raw_gap" in column.trials else None,
    "worse_than_basis": lambda column: (
        worse_than_basis(column.trials, column.key) if column.key in LEARNED or column.key not in STARTS else None
    ),
}
"""Of every start, by every method, on every set."""


def start_metrics(trials: Trials, method: str) -> dict[str, Any]:
    """Per start: iterations, gaps, feasibility, and what did not work."""
    columns = {key: Column(trials, method, key) for key in starts_in(trials, method)}
    return {key: {name: metric(column) for name, metric in PER_START.items()} for key, column in columns.items()}


def event_metrics(name: str, trials: Trials) -> dict[str, Any]:
    """Iterations of the flow per event of a set and start; empty where a set has no events."""
    events = trials["case/event"]
    if name == "directions" or not (events != "").any():
        return {}
    shown, out = ("cases", "no_start", "iterations"), {}
    for event in np.unique(events).tolist():
        chosen = {column: values[events == event] for column, values in trials.items() if len(values) == len(events)}
        columns = {key: Column(chosen, METHODS[0], key) for key in starts_in(chosen)}
        out[event] = {key: {part: PER_START[part](column) for part in shown} for key, column in columns.items()}
    return out


def timing_metrics(timing: Trials) -> dict[str, Any]:
    """Microseconds of the start alone and of the whole call: best of the repeats per wrench, and all of them."""
    keys = [name.split("/")[0] for name in timing if name.endswith("/start_us")]
    repeats, count = timing[f"{keys[0]}/start_us"].shape

    def both(values: np.ndarray) -> dict[str, Any]:
        some = np.isfinite(values).any(axis=0)
        return {"best": spread(np.nanmin(values[:, some], axis=0)), "raw": spread(values[np.isfinite(values)])}

    return {
        "repeats": repeats,
        "wrenches": count,
        "start": {key: both(timing[f"{key}/start_us"]) for key in keys},
        "total": {method: {key: both(timing[f"{method}/{key}/total_us"]) for key in keys} for method in METHODS},
    }


def break_even(timing: Trials, models: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """After how many calls the seconds of training are earned back against the 12-basis, which costs its offline part."""
    offline = float(np.median(timing["basis/offline_us"]))

    def typical(key: str) -> float:
        return float(np.nanmedian(np.nanmin(timing[f"{METHODS[0]}/{key}/total_us"], axis=0)))

    out: dict[str, Any] = {}
    for key in models:
        if not np.isfinite(timing.get(f"{METHODS[0]}/{key}/total_us", np.nan)).any():
            continue
        seconds = training_seconds(models[key])
        saved = typical(BASIS) - typical(key)
        out[key] = {
            "training_seconds": seconds,
            "saved_us": saved,
            "basis_offline_us": offline,
            "calls": None if seconds is None or saved <= 0.0 else max(0.0, 1e6 * seconds - offline) / saved,
        }
    return out


def table_one(trials: Trials, path: Trials | None = None) -> dict[str, Any]:
    """Normal forces (N) and steps on the constant wrench, ours beside the paper's; of the path the largest total."""
    rows: dict[str, Any] = {}
    for key, paper in PAPER_TABLE.items():
        steps = None if key == "optimum" else int(trials[f"{METHODS[0]}/{key}/iterations"][0])
        normals = trials[f"{key}/force"][0][:, 0]
        rows[key] = {"normals": [float(value) for value in normals], "sum": float(normals.sum()), "steps": steps}
        rows[key]["balance"] = float(normals[0] - normals[1:].sum())
        rows[key]["paper"] = {**paper, "sum": round(sum(paper["normals"]), 2)}
        rows[key]["paper"]["balance"] = round(paper["normals"][0] - sum(paper["normals"][1:]), 2)
    most = float(path["optimum/force"][:, :, 0].sum(axis=1).max()) if path else None
    return {"wrench": trials["case/wrench"][0].tolist(), "rows": rows, "path_normal": most}


def continuity_metrics(paths: Trials) -> dict[str, Any]:
    """Slopes, kinks and the largest jump of every start, and of the optimum."""
    out: dict[str, Any] = {}
    for key in (name.split("/")[0] for name in paths if name.endswith("/slope")):
        slope, kink = (paths[f"{key}/{column}"] for column in ("slope", "kink"))
        out[key] = {
            "slope": spread(slope[np.isfinite(slope)]),
            "kink": spread(kink[np.isfinite(kink)]),
            "jump_max": _extreme(paths[f"{key}/jump"], np.nanmax),
        }
    return out


def guarantee_metrics(trials: Trials) -> dict[str, Any]:
    """How often a model's start was worse than the 12-basis's, over six decades of magnitude."""
    out: dict[str, Any] = {}
    for key in dict.fromkeys(name.split("/")[0] for name in trials):
        grasps = {
            name.split("/")[1]: trials[name] for name in trials if name.startswith(f"{key}/") and "excess" in name
        }
        rows = {
            name: {"n": int(e.size), "worse": int(worse(e).sum()), "excess_max": _extreme(e, np.nanmax)}
            for name, e in grasps.items()
        }
        out[key] = {
            "n": sum(row["n"] for row in rows.values()),
            "worse": sum(row["worse"] for row in rows.values()),
            "excess_max": _extreme(np.concatenate(list(grasps.values())), np.nanmax),
            "magnitudes": list(MAGNITUDES),
            "grasps": rows,
        }
    return out


def rollout_metrics(rollouts: Trials) -> dict[str, Any]:
    """Per scenario and start over its episodes: held, drift, slip, force error, iterations."""
    out: dict[str, Any] = {}
    keys = dict.fromkeys(tuple(name.split("/")[:3]) for name in rollouts)
    for scenario in SCENARIOS:
        out[scenario] = {}
        starts = dict.fromkeys(key for found, key, _ in keys if found == scenario)
        for start in starts:
            episodes = sorted((e for s, k, e in keys if (s, k) == (scenario, start)), key=int)
            begun = [e for e in episodes if f"{scenario}/{start}/{e}/time" in rollouts]
            pick = [{c: rollouts[f"{scenario}/{start}/{e}/{c}"] for c in _COLUMNS} for e in begun]
            failures = [text for e in episodes if (text := str(rollouts[f"{scenario}/{start}/{e}/failure"]))]
            out[scenario][start] = {
                "episodes": len(episodes),
                "held": len(episodes) - len(failures),
                "failures": failures,
                **(_rolled_out(pick) if pick else {}),
            }
    return out


def _rolled_out(pick: list[Trials]) -> dict[str, Any]:
    """Of the episodes that began."""
    error = np.concatenate([rows["force_error"] for rows in pick])
    commanded = np.concatenate([rows["commanded_force"] for rows in pick])
    return {
        "contact_always": bool(all(rows["touching"].all() for rows in pick)),
        "seconds": float(max(rows["time"][-1] for rows in pick)),
        "max_drift_mm": float(max(rows["drift"].max() for rows in pick) * 1e3),
        "max_tilt_deg": float(np.degrees(max(rows["tilt"].max() for rows in pick))),
        "max_slip_distance_mm": float(max(rows["slip_distance"][-1] for rows in pick) * 1e3),
        "force_error_p95": float(np.percentile(error, 95)),
        "force_error_max": float(error.max()),
        "total_normal_force_mean": float(commanded[:, :, 0].sum(axis=1).mean()),
        "peak_torque": float(max(rows["peak_torque"].max() for rows in pick)),
        "iterations": spread(np.concatenate([rows["iterations"] for rows in pick])),
    }


_COLUMNS = (
    "iterations", "drift", "tilt", "slip_distance", "force_error", "commanded_force", "touching", "peak_torque", "time",
)  # fmt: skip


def censored(iterations: np.ndarray) -> np.ndarray:
    """Iterations as numbers that can be ranked: a level never reached counts as `LIMIT` + 1.

    Example:
        >>> censored(np.array([3, -1])).tolist()
        [3, 5001]
    """
    return np.where(iterations < 0, LIMIT + 1, iterations)


def _extreme(values: np.ndarray, kind: Any) -> float | None:
    finite = values[np.isfinite(values)]
    return float(kind(finite)) if finite.size else None


METRICS: dict[str, Callable[[Saved], Any]] = {
    "run": lambda saved: saved.about,
    "sets": lambda saved: {name: set_metrics(name, trials) for name, trials in saved.trials.items()},
    "starts": lambda saved: {
        method: {name: start_metrics(trials, method) for name, trials in saved.trials.items()} for method in METHODS
    },
    "events": lambda saved: {
        name: found for name, trials in saved.trials.items() if (found := event_metrics(name, trials))
    },
    "timing": lambda saved: timing_metrics(saved.timing),
    "table_one": lambda saved: table_one(saved.trials["constant"], saved.trials.get("paper_path")),
    "continuity": lambda saved: continuity_metrics(saved.run.read_arrays("continuity.npz")),
    "guarantee": lambda saved: guarantee_metrics(saved.run.read_arrays("guarantee.npz")),
    "rollouts": lambda saved: rollout_metrics(saved.run.read_arrays("rollouts.npz")),
    "break_even": lambda saved: break_even(saved.timing, saved.about["models"]),
}
"""The parts of metrics.json; wins and claims are made of them."""
