"""A run folder as `grasp evaluate` leaves it, with made-up numbers: reports are tested without solving."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from training.cases.set_table import SETS
from training.cases.start_table import LEARNED, STARTS
from training.runs import Run
from training.runs.statistics import spread
from training.trials.arrays import BUDGETS, LEVELS, METHODS, SCENARIOS
from training.trials.findings import findings

SPEED = {
    "single_value": 60.0,
    "lagrange": 50.0,
    "linear_combination": 40.0,
    "learned_fixed": 0.5,
    "learned_previous": 3.0,
}
CASES = 30
CURVE = {"columns": ["step", "seconds", "median", "p95", "p99"], "rows": [[k, k, 1e-3, 1e-2, 0.1] for k in range(9)]}
USED = ("constant", "paper_path", "ball", "smooth", "jump_50", "random_4", "random_3", "rollout_changes")
"""Of the sets."""


def synthetic_run(folder: Path, seed: int = 0) -> tuple[Run, dict[str, Any]]:
    """The run with trials, and its metrics."""
    rng, run = np.random.default_rng(seed), Run(folder)
    starts: dict[str, Any] = {method: {} for method in METHODS}
    for name in USED:
        trials = _trials(rng, name)
        run.write_arrays(f"trials/{name}.npz", trials)
        for method in METHODS:
            starts[method][name] = {key: _row(trials, method, key) for key in STARTS}
    timing = _timing(rng)
    run.write_arrays("timing.npz", timing)
    run.write_arrays("rollouts.npz", _rollouts(rng))
    run.write_json("rl.json", _learning())
    pictures = [Image.fromarray(rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)) for _ in range(3)]
    for name in ("hand_paper.webp", "hand_learned.webp"):
        pictures[0].save(run.path(f"figures/{name}"), save_all=True, append_images=pictures[1:], duration=40, loop=0)
    pictures[0].save(run.path("figures/hand.png"))
    metrics = {
        "run": _facts(),
        "sets": {
            name: {"label": SETS[name].label, "group": SETS[name].group, "cases": CASES, "contacts": [4], "note": SETS[name].note}
            for name in USED
        },
        "starts": starts,
        "events": {"rollout_changes": {event: {key: starts["reduced_flow"]["ball"][key] for key in STARTS} for event in ("lost", "landed")}},
        "timing": {
            "repeats": 3, "wrenches": CASES,
            "start": {key: _both(timing[f"{key}/start_us"]) for key in STARTS},
            "total": {m: {key: _both(timing[f"{m}/{key}/total_us"]) for key in STARTS} for m in METHODS},
        },
        "table_one": _table_one(),
        "continuity": {
            key: {"slope": spread(rng.lognormal(0, 0.3, 50)), "kink": spread(rng.lognormal(-3, 1, 50)), "jump_max": 1e-4}
            for key in (*STARTS, "optimum")
        },
        "guarantee": {
            "learned_fixed": {"n": 1000, "worse": 0, "excess_max": -1e-9, "magnitudes": [1e-3, 1e3],
                              "grasps": {"paper_cuboid": {"n": 1000, "worse": 0, "excess_max": -1e-9}}},
        },
        "break_even": {
            "learned_fixed": {"training_seconds": 900.0, "saved_us": 6.5, "basis_offline_us": 180.0, "calls": 1.4e8},
        },
        "rollouts": {"constant": {"linear_combination": {
            "episodes": 1, "held": 1, "failures": [], "max_drift_mm": 0.1, "max_tilt_deg": 0.02, "max_slip_distance_mm": 0.0,
            "force_error_p95": 0.1, "total_normal_force_mean": 9.4, "peak_torque": 0.8, "iterations": spread(np.arange(30.0)),
        }}},
        "wins": [{
            "set": "jump_50", "label": SETS["jump_50"].label, "previous": {"median": 9.0, "p99": 40.0},
            "learned": {"start": "learned_fixed", "median": 0.0, "p99": 12.0}, "basis": {"median": 42.0, "p99": 110.0},
            "winner": "learned",
        }],
        "claims": [
            {"claim": "a claim that is met <&>", "asked": "at most 4", "measured": "3.00 (95 % interval 2 to 3)", "met": True},
            {"claim": "a claim that is missed", "asked": "0", "measured": "7 of 1000", "met": False},
            {"claim": "a claim without a number", "asked": "0", "measured": "not measured", "met": None},
        ],
    }  # fmt: skip
    metrics["found"] = findings(metrics)
    return run, metrics


def _trials(rng: np.random.Generator, name: str) -> dict[str, np.ndarray]:
    n, contacts = CASES, 4
    out = {"optimum/objective": np.ones(n), "optimum/force": 1 + rng.random((n, contacts, 3))}
    for key in STARTS:
        applies = not (name == "random_3" and key == "learned_fixed")
        scale = SPEED.get(key, 8.0)
        gap = scale * 1e-3 * rng.lognormal(0, 1, n)
        counts = rng.poisson(scale, n)
        out[f"{key}/force"] = out["optimum/force"] * 1.1
        out[f"{key}/gap"] = gap
        for method in METHODS:
            levels = LEVELS[method]
            out[f"{method}/{key}/status"] = np.full(n, 0 if applies else 4, np.int8)
            out[f"{method}/{key}/iterations"] = counts if applies else np.full(n, -1)
            out[f"{method}/{key}/iterations_to"] = np.stack(
                [np.maximum(counts - len(levels) + k, 0) for k in range(len(levels))], 1
            )
            decay = np.exp(-np.array(BUDGETS) / (1 + scale))
            out[f"{method}/{key}/gap_after"] = gap[:, None] * decay if applies else np.full((n, len(BUDGETS)), np.nan)
        trace = gap[:, None] * np.exp(-np.arange(301) / (1 + scale))
        out[f"reduced_flow/{key}/trace"] = (trace if applies else trace * np.nan).astype(np.float32)
    return out


def _row(trials: dict[str, np.ndarray], method: str, key: str) -> dict[str, Any]:
    status = trials[f"{method}/{key}/status"]
    pick = status == 0
    counts = trials[f"{method}/{key}/iterations"][pick]
    to = trials[f"{method}/{key}/iterations_to"][pick]
    after = trials[f"{method}/{key}/gap_after"][pick]
    learned = key in LEARNED
    return {
        "cases": int(pick.sum()), "not_applicable": int((status == 4).sum()), "no_start": 0, "not_converged": 0,
        "iterations": spread(counts), "start_gap": spread(trials[f"{key}/gap"][pick]),
        "iterations_to": {f"{level:.0e}".replace("e-0", "e-"): {**spread(to[:, k]), "unreached": 0} for k, level in enumerate(LEVELS[method])},
        "gap_after": {str(count): spread(after[:, k]) for k, count in enumerate(BUDGETS)},
        "margin_min": 1e-3, "residual_max": 1e-15,
        "raw": {"inside": 0.97, "margin_min": -0.01, "residual_max": 1e-15, "gap": spread(trials[f"{key}/gap"][pick])} if learned else None,
        "worse_than_basis": {"count": 0, "of": int(pick.sum())} if learned else None,
    }  # fmt: skip


def _both(values: np.ndarray) -> dict[str, Any]:
    return {"best": spread(values.min(axis=0)), "raw": spread(values.ravel())}


def _timing(rng: np.random.Generator) -> dict[str, np.ndarray]:
    out = {}
    for key in STARTS:
        out[f"{key}/start_us"] = rng.lognormal(1.5, 0.1, (3, CASES))
        for method in METHODS:
            out[f"{method}/{key}/total_us"] = 5 + SPEED.get(key, 8.0) * rng.lognormal(0, 0.3, (3, CASES))
    return out


def _rollouts(rng: np.random.Generator) -> dict[str, np.ndarray]:
    out = {}
    for scenario in SCENARIOS:
        base = f"{scenario}/linear_combination/0"
        out[f"{base}/time"] = np.arange(100) / 50
        out[f"{base}/drift"] = np.full(100, 1e-5)
        out[f"{base}/iterations"] = rng.poisson(30, 100)
        for column in ("commanded_force", "measured_force"):
            out[f"{base}/{column}"] = 1 + rng.random((100, 4, 3))
    return out


def _table_one() -> dict[str, Any]:
    row = {"normals": [4.0, 1.2, 1.1, 1.1], "sum": 7.4, "balance": 0.6, "steps": 40}
    paper = {"normals": [4.15, 1.13, 1.15, 1.26], "steps": 80, "sum": 7.69, "balance": 0.61}
    return {"wrench": [1.0, 0.5, -0.6, -0.1, 0.2, 0.0], "rows": {"linear_combination": {**row, "paper": paper}}}


def _facts() -> dict[str, Any]:
    card = {"optimisation_steps": 9000, "seconds": 950.0, "cpu_seconds": 900.0, "config": {"low": 0.1, "high": 20.0}, "bytes": 150000,
            "held_out_gap": {"ball": {"gap": {"median": 1e-5, "p99": 1e-3}}}, "limits": "one grasp", "curve": CURVE}  # fmt: skip
    return {
        "command": "grasp evaluate --quick", "time": "2026-01-01 00:00:00 UTC", "kind": "starts", "quick": True, "commit": "abc1234",
        "machine": {"processor": "a processor", "cores": 2, "system": "Linux", "python": "3.11"}, "versions": {"numpy": "2.4"},
        "config": {"name": "synthetic", "seed": 0}, "models": {"learned_fixed": card}, "friction": 0.4, "grasp": "paper_cuboid",
        "force_weight": 1.0, "barrier_weight": 0.01, "step_rule": {"name": "AdaptiveStep", "grow": 1.5, "shrink": 0.5},
        "seconds": {"trials": 12.0}, "fit": None,
    }  # fmt: skip


def _learning() -> dict[str, Any]:
    mean, ratio = {"n": 9, "mean": 9.0, "low": 8.0, "high": 10.0}, {"ratio": 0.8, "low": 0.7, "high": 0.9}
    row = {
        "seeds": 3, "held": 29, "episodes": 30, "held_low": 0.9, "held_high": 1.0, "iterations": spread(np.arange(30.0)),
        "iterations_against_paper": ratio, "squeeze": mean, "drift_mm": mean, "return": {"iqm": -3.0, "low": -4.0, "high": -2.0},
    }  # fmt: skip
    curve = [
        {"steps": 1000 * k, "iterations": 30.0 - k, "median_iterations": 30.0 - k, "return": -3.0 + 0.1 * k}
        for k in range(9)
    ]
    return {
        "quick": True, "episodes": 30,
        "rows": {"zero": {**row, "label": "the paper's start"}, "sac/initial_force": {**row, "label": "SAC, adjusts the start"}},
        "training": {"sac/initial_force": [{"seed": k, "steps": 8000, "seconds": 60.0, "curve": curve} for k in range(3)]},
        "curve_of_zero": {"iterations": 30.0, "return": -3.0},
    }  # fmt: skip
