"""Numbers of a report from saved trials: pure functions, nothing is solved here."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.grasp.wrench import PAPER_CONSTANT
from training.cases.set_table import SETS
from training.cases.start_table import LABELS, LEARNED, MODELS
from training.runs import Run
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
    worse,
)
from training.trials.claims import claims, training_seconds, wins

BASIS = "linear_combination"
PAPER_TABLE: dict[str, dict[str, Any]] = {
    "single_value": {"normals": [8.30, 2.73, 2.57, 2.40], "steps": 160},
    "lagrange": {"normals": [5.19, 1.59, 1.50, 1.51], "steps": 120},
    "linear_combination": {"normals": [4.15, 1.13, 1.15, 1.26], "steps": 80},
    "optimum": {"normals": [3.25, 0.66, 0.79, 1.21], "steps": None},
}
"""Table I and the steps quoted below it."""


def metrics_of(run: Run) -> dict[str, Any]:
    """Everything that a report says, from the files of a run."""
    trials = {name: run.read_arrays(f"trials/{name}.npz") for name in SETS if run.path(f"trials/{name}.npz").is_file()}
    about, timing = run.read_json("run.json"), run.read_arrays("timing.npz")
    metrics: dict[str, Any] = {
        "run": about,
        "sets": {name: set_metrics(name, arrays) for name, arrays in trials.items()},
        "starts": {
            method: {name: start_metrics(arrays, method) for name, arrays in trials.items()} for method in METHODS
        },
        "events": {name: found for name, arrays in trials.items() if (found := event_metrics(name, arrays))},
        "timing": timing_metrics(timing),
        "table_one": table_one(trials["constant"]),
        "continuity": continuity_metrics(run.read_arrays("continuity.npz")),
        "guarantee": guarantee_metrics(run.read_arrays("guarantee.npz")),
        "rollouts": rollout_metrics(run.read_arrays("rollouts.npz")),
    }
    metrics["break_even"] = break_even(timing, about["models"])
    metrics["wins"] = wins(metrics)
    metrics["claims"] = claims(metrics)
    return metrics


def set_metrics(name: str, trials: Trials) -> dict[str, Any]:
    """What a set holds."""
    info = SETS[name]
    contacts = sorted({int(n) for n in trials["case/n_contacts"]})
    count = len(trials["case/n_contacts"])
    return {"label": info.label, "group": info.group, "cases": count, "contacts": contacts, "note": info.note}


def start_metrics(trials: Trials, method: str) -> dict[str, Any]:
    """Per start: iterations, gaps, feasibility, and what did not work."""
    out: dict[str, Any] = {}
    for key in LABELS:
        if f"{method}/{key}/status" not in trials:
            continue
        base = f"{method}/{key}"
        status = trials[f"{base}/status"]
        exists = status < NO_START
        reached = trials[f"{base}/iterations_to"][exists]
        after = trials[f"{base}/gap_after"][exists]
        out[key] = {
            "cases": int((status != NOT_APPLICABLE).sum()),
            "not_applicable": int((status == NOT_APPLICABLE).sum()),
            "no_start": int((status == NO_START).sum()),
            "not_converged": int(((status == 1) | (status == 2)).sum()),
            "iterations": spread(censored(trials[f"{base}/iterations"][exists])),
            "start_gap": spread(trials[f"{key}/gap"][exists]),
            "iterations_to": {
                f"1e-{k + 1}": {**_points(censored(reached[:, k])), "unreached": int((reached[:, k] < 0).sum())}
                for k in range(len(LEVELS[method]))
            },
            "gap_after": {str(budget): _points(after[:, k]) for k, budget in enumerate(BUDGETS)},
            "margin_min": _extreme(trials[f"{key}/margin"], np.nanmin),
            "residual_max": _extreme(trials[f"{key}/residual"], np.nanmax),
            "raw": raw_metrics(trials, key) if f"{key}/raw_gap" in trials else None,
            "worse_than_basis": worse_than_basis(trials, key) if key in LEARNED else None,
        }
    return out


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
    base = f"{METHODS[0]}/{key}/status"
    both = (trials[base] != NOT_APPLICABLE) & np.isfinite(trials[f"{BASIS}/gap"])
    ratio = (1.0 + trials[f"{key}/gap"][both]) / (1.0 + trials[f"{BASIS}/gap"][both]) - 1.0
    return {"count": int(worse(ratio).sum()), "of": int(both.sum())}


def event_metrics(name: str, trials: Trials) -> dict[str, Any]:
    """Iterations of the flow per event of a set and start; empty where a set has no events."""
    events = trials["case/event"]
    if name == "directions" or not (events != "").any():
        return {}
    out: dict[str, Any] = {}
    for event in np.unique(events).tolist():
        chosen = {column: values[events == event] for column, values in trials.items() if len(values) == len(events)}
        rows = {}
        for key in LABELS:
            if f"{METHODS[0]}/{key}/status" in chosen:
                status = chosen[f"{METHODS[0]}/{key}/status"]
                rows[key] = {
                    "cases": int((status != NOT_APPLICABLE).sum()),
                    "no_start": int((status == NO_START).sum()),
                    "iterations": spread(censored(chosen[f"{METHODS[0]}/{key}/iterations"][status < NO_START])),
                }
        out[event] = rows
    return out


def timing_metrics(timing: Trials) -> dict[str, Any]:
    """Microseconds of the start alone and of the whole call: best of the repeats per wrench, and all of them."""
    keys = [key for key in LABELS if f"{key}/start_us" in timing]
    repeats, count = timing[f"{keys[0]}/start_us"].shape

    def both(values: Array) -> dict[str, Any]:
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
    for key in MODELS:
        if f"{METHODS[0]}/{key}/total_us" not in timing or key not in models:
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


def table_one(trials: Trials) -> dict[str, Any]:
    """Normal forces (N) and steps on the constant wrench, ours beside the paper's."""
    rows: dict[str, Any] = {}
    for key, paper in PAPER_TABLE.items():
        steps = None if key == "optimum" else int(trials[f"{METHODS[0]}/{key}/iterations"][0])
        normals = trials[f"{key}/force"][0][:, 0]
        rows[key] = {"normals": [float(value) for value in normals], "sum": float(normals.sum()), "steps": steps}
        rows[key]["balance"] = float(normals[0] - normals[1:].sum())
        rows[key]["paper"] = {**paper, "sum": round(sum(paper["normals"]), 2)}
        rows[key]["paper"]["balance"] = round(paper["normals"][0] - sum(paper["normals"][1:]), 2)
    return {"wrench": list(PAPER_CONSTANT), "rows": rows}


def continuity_metrics(paths: Trials) -> dict[str, Any]:
    """Slopes, kinks and the largest jump of every start, and of the optimum."""
    out: dict[str, Any] = {}
    for key in ("optimum", *LABELS):
        if f"{key}/slope" in paths:
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
    for key in MODELS:
        grasps = {
            name.split("/")[1]: trials[name] for name in trials if name.startswith(f"{key}/") and "excess" in name
        }
        if grasps:
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
    keys = {tuple(name.split("/")[:3]) for name in rollouts}
    for scenario in SCENARIOS:
        out[scenario] = {}
        starts = [key for key in LABELS if any(name[:2] == (scenario, key) for name in keys)]
        for start in starts:
            episodes = sorted((e for s, k, e in keys if (s, k) == (scenario, start)), key=int)
            pick = [{c: rollouts[f"{scenario}/{start}/{e}/{c}"] for c in _COLUMNS} for e in episodes]
            failures = [str(rows["failure"]) for rows in pick if str(rows["failure"])]
            error = np.concatenate([rows["force_error"] for rows in pick])
            commanded = np.concatenate([rows["commanded_force"] for rows in pick])
            out[scenario][start] = {
                "episodes": len(pick),
                "held": len(pick) - len(failures),
                "failures": failures,
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
    return out


_COLUMNS = (
    "iterations", "drift", "tilt", "slip_distance", "force_error", "commanded_force", "touching", "peak_torque", "time",
    "failure",
)  # fmt: skip


def censored(iterations: Array) -> Array:
    """Iterations as numbers that can be ranked: a level never reached counts as `LIMIT` + 1.

    Example:
        >>> censored(np.array([3, -1])).tolist()
        [3, 5001]
    """
    return np.where(iterations < 0, LIMIT + 1, iterations)


def spread(values: Array) -> dict[str, Any]:
    """Median with a 95 % interval, p90, p95, p99 and maximum of finite values (n,).

    The interval is between order statistics, free of any distribution: what a bootstrap of the median comes to.

    Example:
        >>> row = spread(np.arange(101.0))
        >>> row["median"], row["median_low"], row["median_high"], row["p99"]
        (50.0, 40.0, 60.0, 99.0)
    """
    names = ("median", "p90", "p95", "p99", "max")
    if values.size == 0:
        return {"n": 0, **dict.fromkeys((*names, "median_low", "median_high"))}
    order = np.sort(values.astype(np.float64))
    half, centre = 0.98 * np.sqrt(order.size), 0.5 * (order.size - 1)
    low, high = int(np.floor(centre - half + 0.5)), int(np.ceil(centre + half - 0.5))
    points = np.percentile(order, [50, 90, 95, 99, 100])
    return {
        "n": int(order.size),
        **{name: float(point) for name, point in zip(names, points, strict=True)},
        "median_low": float(order[max(low, 0)]),
        "median_high": float(order[min(high, order.size - 1)]),
    }


def _points(values: Array) -> dict[str, float | None]:
    if values.size == 0:
        return {"median": None, "p95": None, "p99": None}
    median, p95, p99 = np.percentile(values, [50, 95, 99])
    return {"median": float(median), "p95": float(p95), "p99": float(p99)}


def _extreme(values: Array, kind: Any) -> float | None:
    finite = values[np.isfinite(values)]
    return float(kind(finite)) if finite.size else None
