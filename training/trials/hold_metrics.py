"""Hold rates, drift and squeeze from saved trials: pure functions, nothing is simulated here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from training.runs.claims import Claim, claim
from training.runs.statistics import mean_interval, wilson
from training.trials.arrays import Trials
from training.trials.hold_findings import holds_found
from training.trials.hold_plan import (
    BASELINES,
    CONTROLLER_LABELS,
    CONTROLLERS,
    CURVES,
    NOT_STARTED,
    RANDOM_WRENCH,
    SCENARIO_LABELS,
)

ASKED_RATE = 0.99
ASKED_DRIFT = 1e-3
"""[m] mean of the largest drift, random cuboids."""
PATH_DRIFT = 1e-4
"""[m] under W_ext(t) x 0.25."""
MARGIN_RULE = (
    f"the largest friction margin, which is the least squeeze, that holds at least {100 * ASKED_RATE:g} % of the episodes; where "
    "none does, the one that holds most (of equals the largest)"
)
SAME_RULE = f"the least squeeze that holds at least {100 * ASKED_RATE:g} %; where none does, the one that holds most (of equals the least)"


class Episodes:
    """The trials of a cell: which were held, which started at all."""

    def __init__(self, trials: Trials) -> None:
        self.trials, self.held = trials, trials["held"].astype(bool)
        self.started = ~np.isin(trials["failure"], NOT_STARTED)

    def of(self, name: str, which: np.ndarray, factor: float = 1.0) -> np.ndarray:
        """A column of some of them."""
        return factor * self.trials[name][which]


CELL_METRICS: dict[str, Callable[[Episodes], Any]] = {
    "episodes": lambda cell: len(cell.held),
    "held": lambda cell: int(cell.held.sum()),
    "rate": lambda cell: float(cell.held.mean()),
    "rate_low": lambda cell: wilson(int(cell.held.sum()), len(cell.held))[0],
    "rate_high": lambda cell: wilson(int(cell.held.sum()), len(cell.held))[1],
    "started": lambda cell: int(cell.started.sum()),
    "failures": lambda cell: _counted(_causes(cell.trials)[~cell.held]),
    "unreachable": lambda cell: int(cell.trials["redrawn"].sum()),
    "max_drift_mm": lambda cell: mean_interval(cell.of("max_drift", cell.held, 1e3)),
    "mean_drift_mm": lambda cell: mean_interval(cell.of("mean_drift", cell.held, 1e3)),
    "largest_drift_mm": lambda cell: float(cell.of("max_drift", cell.held, 1e3).max(initial=0.0)),
    "max_tilt_deg": lambda cell: mean_interval(np.degrees(cell.of("max_tilt", cell.held))),
    "slip_mm": lambda cell: mean_interval(cell.of("slip_distance", cell.held, 1e3)),
    "normal_force": lambda cell: mean_interval(cell.of("normal_force", cell.started)),
    "peak_torque": lambda cell: float(cell.of("peak_torque", cell.started).max(initial=0.0)),
    "iterations": lambda cell: mean_interval(cell.of("iterations", cell.started)),
}
"""Of every cell: drift, tilt and slip of the episodes that were held, squeeze, torque and iterations of those that started."""


def cell_metrics(trials: Trials) -> dict[str, Any]:
    """All of `CELL_METRICS`."""
    return {name: metric(Episodes(trials)) for name, metric in CELL_METRICS.items()}


def shape_metrics(trials: Trials) -> dict[str, dict[str, Any]]:
    """`cell_metrics` of the episodes of each shape."""
    shapes = np.unique(trials["shape"]).tolist()
    return {shape: cell_metrics(_pick(trials, trials["shape"] == shape)) for shape in shapes}


def paired(trials: Trials, base: Trials) -> dict[str, Any]:
    """Difference to `base` over the seeds that both ran: held (share) and, where both started, total normal force [N].

    Raises:
        ValueError: the same seed drew different objects.
    """
    seeds, mine, theirs = np.intersect1d(trials["seed"], base["seed"], return_indices=True)
    a, b = _pick(trials, mine), _pick(base, theirs)
    for name in ("shape", "size_x", "size_y", "size_z", "mass", "friction"):
        if not np.array_equal(a[name], b[name]):
            raise ValueError(f"the trials are not paired: {name} differs between the same seeds")
    both = ~(np.isin(a["failure"], NOT_STARTED) | np.isin(b["failure"], NOT_STARTED))
    return {
        "pairs": len(seeds),
        "held": mean_interval(a["held"].astype(float) - b["held"].astype(float)),
        "only_this": int((a["held"] & ~b["held"]).sum()),
        "only_base": int((~a["held"] & b["held"]).sum()),
        "normal_force": mean_interval((a["normal_force"] - b["normal_force"])[both]),
    }


def failures(name: str, trials: Trials) -> list[dict[str, Any]]:
    """Every trial that was not held: its cause in words, seed and object."""
    out = []
    causes = _causes(trials)
    for k in np.flatnonzero(~trials["held"].astype(bool)).tolist():
        size = [float(trials[f"size_{axis}"][k]) for axis in "xyz"]
        out.append({
            "cell": name,
            "seed": int(trials["seed"][k]),
            "cause": str(causes[k]),
            "how": _how(trials, k),
            "object": f"{trials['shape'][k]} {' x '.join(f'{1e3 * side:.0f}' for side in size if side > 0) or '100'} mm, "
            f"{1e3 * float(trials['mass'][k]):.0f} g, friction {float(trials['friction'][k]):.2f}",
        })  # fmt: skip
    return out


def choose(curve: list[dict[str, Any]], key: str, largest: bool) -> dict[str, Any] | None:
    """The row of a swept curve that `MARGIN_RULE` (largest) or `SAME_RULE` names; None of an empty curve.

    Args:
        curve: rows with "rate" and the swept value under `key`.
        key: name of the swept value.
        largest: whether a larger value is less squeeze.
    """
    order = sorted(curve, key=lambda row: row[key], reverse=largest)
    for row in order:
        if row["rate"] >= ASKED_RATE:
            return row
    return max(order, key=lambda row: row["rate"], default=None)


def env_metrics(cells: list[dict[str, Any]], trials: dict[str, Trials]) -> dict[str, Any]:
    """All numbers of a report.

    Args:
        cells: as `holds.cell_json` saved them.
        trials: by the cell's name.
    """
    rows = []
    for cell in cells:
        mine = trials[cell["name"]]
        row = {key: cell[key] for key in ("name", "scenario", "controller", "swept")} | cell_metrics(mine)
        base = f"{cell['scenario']}/paper"
        row["against_paper"] = paired(mine, trials[base]) if base in trials and base != cell["name"] else None
        rows.append(row)
    chosen: dict[str, dict[str, dict[str, Any]]] = {}
    for scenario in CURVES:
        for key in CONTROLLERS:
            curve = [row for row in rows if (row["scenario"], row["controller"]) == (scenario, key)]
            best = choose(curve, "swept", key not in BASELINES)
            if best is not None:
                chosen.setdefault(scenario, {})[key] = best
    for row in rows:
        best = chosen.get(row["scenario"], {}).get("paper")
        if best is not None and row is not best:
            row["against_paper"] = paired(trials[row["name"]], trials[best["name"]])
    named = {row["name"]: row for row in rows}
    metrics: dict[str, Any] = {
        "cells": rows,
        "shapes": {key: shape_metrics(trials[f"objects/{key}"]) for key in CONTROLLERS if f"objects/{key}" in trials},
        "chosen": {curve: {key: row["name"] for key, row in best.items()} for curve, best in chosen.items()},
        "margin_rule": MARGIN_RULE,
        "failures": [row for cell in cells for row in failures(cell["name"], trials[cell["name"]])],
    }
    metrics["claims"] = list(claims(named, metrics["shapes"], chosen))
    metrics["found"] = holds_found(metrics)
    return metrics


def claims(
    named: dict[str, dict[str, Any]], shapes: dict[str, Any], chosen: dict[str, dict[str, dict[str, Any]]]
) -> Iterator[Claim]:
    """What was asked for, what was measured, and whether that is enough."""
    force, moment, seconds = (RANDOM_WRENCH[name] for name in ("random_force", "random_moment", "duration"))
    against = f"against a random wrench ({force:g} N, {moment:g} N m per axis) for {seconds:g} s"
    for name, text in (("objects/paper", against), ("six_directions/paper", "in six_directions")):
        if name in named:
            row, asked = named[name], f"at least {100 * ASKED_RATE:g} % of episodes"
            yield claim(
                f"the paper's pipeline holds random objects {text}", asked, rate_text(row), row["rate"] >= ASKED_RATE
            )
    if "cuboid" in shapes.get("paper", {}):
        drift = shapes["paper"]["cuboid"]["max_drift_mm"]
        text = "mean over the random cuboids that were held of an episode's largest drift"
        met = drift["mean"] is not None and drift["mean"] < 1e3 * ASKED_DRIFT
        yield claim(text, f"below {1e3 * ASKED_DRIFT:g} mm", interval_text(drift, "mm"), met)
    if "path_0.25/paper" in named:
        row = named["path_0.25/paper"]
        met = row["held"] == row["episodes"] and row["largest_drift_mm"] < 1e3 * PATH_DRIFT
        measured = f"{'held' if row['held'] else 'lost'}, {row['largest_drift_mm']:.2g} mm, torque up to {row['peak_torque']:.2g} N m"
        yield claim("W_ext(t) x 0.25 on the 0.1 m cuboid", f"held, drift below {1e3 * PATH_DRIFT:g} mm", measured, met)
    for scenario, rows in chosen.items():
        for key in [key for key in BASELINES if key in rows and "paper" in rows]:
            best, other = rows["paper"], rows[key]
            text = (
                f"{SCENARIO_LABELS[scenario]}: the paper's pipeline with friction margin {best['swept']:g}, chosen from its curve, "
                f"against {CONTROLLER_LABELS[key]} at its own choice of {other['swept']:g} N"
            )
            better = (best["rate"], -_mean(best)) > (other["rate"], -_mean(other))
            measured = f"{_with_force(best)}; against {_with_force(other)}"
            yield claim(text, "a higher rate, or the same with less squeeze", measured, better)


def rate_text(row: dict[str, Any]) -> str:
    """The rate with its interval."""
    return (
        f"{row['held']} of {row['episodes']}, {100 * row['rate']:.1f} % "
        f"(95 % interval {100 * row['rate_low']:.1f} to {100 * row['rate_high']:.1f})"
    )


def interval_text(mean: dict[str, Any], unit: str) -> str:
    """A mean with its interval; a dash where there is none."""
    if mean["mean"] is None:
        return "–"
    return f"{mean['mean']:.3g} {unit} [{mean['low']:.3g}, {mean['high']:.3g}]"


def _with_force(row: dict[str, Any]) -> str:
    return f"{rate_text(row)} at {interval_text(row['normal_force'], 'N')}"


def _mean(row: dict[str, Any]) -> float:
    return np.inf if row["normal_force"]["mean"] is None else row["normal_force"]["mean"]


def _counted(words: np.ndarray) -> dict[str, int]:
    names, counts = np.unique(words, return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


def _pick(trials: Trials, which: np.ndarray) -> Trials:
    return {name: values[which] for name, values in trials.items()}


def _causes(trials: Trials) -> np.ndarray:
    """One word per trial; not lost but beyond the task's limits at the end: "drifted"; lost after torques were cut: "torque"."""
    lost = np.where(trials["failure"] == "", "drifted", trials["failure"])
    if "cut_in_place" in trials:  # not in runs of older versions
        weak = (trials["cut_in_place"] > 0.0) & ~np.isin(trials["failure"], NOT_STARTED)
        lost = np.where(weak, "torque", lost)
    return np.where(trials["held"].astype(bool), "", lost)


def _how(trials: Trials, k: int) -> str:
    if str(trials["failure"][k]) in NOT_STARTED:
        return str(trials["detail"][k])
    status = str(trials["status"][k])
    solver = "" if status in ("none", "failed") else f"solver {status}, "
    return (
        f"at {float(trials['time'][k]):.2f} s, drift {1e3 * float(trials['end_drift'][k]):.1f} mm, tilt "
        f"{np.degrees(float(trials['end_tilt'][k])):.1f} deg, {int(trials['touching'][k])} fingers touching, "
        f"{int(trials['contact_changes'][k])} contact changes, {solver}total normal force "
        f"{float(trials['normal_force'][k]):.1f} N on average, torque up to {float(trials['peak_torque'][k]):.1f} N m"
    )
