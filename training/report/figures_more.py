"""Figures of microseconds, continuity, forces and roll-outs, from saved trials."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from grasp_env.grasp.wrench import paper_path
from training.cases.start_table import LABELS
from training.report.starts import short
from training.report.style import INK, WIDTH, Drawing, colour, decades, entry, new_figure
from training.trials.arrays import SCENARIO_LABELS, Trials

FINGERS = ("thumb", "middle finger", "left finger", "right finger")
_CURVE = ("finger_1", "finger_2", "finger_0")
_SCENARIOS = ("finger_0", "finger_1", "finger_3", "finger_2", "other_0", "other_1", "other_2")


def violins(timing: Trials) -> Drawing | None:
    """Latency per start: above the line start and reduced flow, below it start and Newton; the bar is the median."""
    keys = [key for key in LABELS if f"reduced_flow/{key}/total_us" in timing]
    if not keys:
        return None
    figure, axes = new_figure(WIDTH, 0.9 + 0.34 * len(keys))
    for row, key in enumerate(keys):
        for method, side in (("reduced_flow", -1.0), ("newton", 1.0)):
            values = timing.get(f"{method}/{key}/total_us")
            if values is not None and np.isfinite(values).any():
                _half(axes, row, side, _best(values), colour(key))
    axes.set(xscale="log", xlabel="microseconds per call, best of the repeats", ylim=(len(keys) - 0.4, -0.6))
    axes.set_yticks(range(len(keys)), [short(key) for key in keys])
    axes.tick_params(axis="y", length=0)
    decades(axes.xaxis)
    return Drawing(figure)


def _best(values: np.ndarray) -> np.ndarray:
    """(n,) least of the repeats (R, n), those without any left out."""
    kept = values[:, np.isfinite(values).any(axis=0)]
    return np.where(np.isfinite(kept), kept, np.inf).min(axis=0)


def _half(axes: Any, row: int, side: float, values: np.ndarray, tint: str) -> None:
    """Half a violin on a logarithmic axis: its height is the density of the logarithm."""
    logs = np.log10(values)
    low, high = np.percentile(logs, [0.5, 99.5])
    width = max(0.9 * np.std(np.clip(logs, low, high)) * len(logs) ** -0.2, 0.004)
    grid = np.linspace(low - 2 * width, high + 2 * width, 60)
    density = np.exp(-0.5 * ((grid[:, None] - logs) / width) ** 2).sum(axis=1)
    shape = 0.42 * density / density.max()
    axes.fill_between(10**grid, row, row + side * shape, color=tint, alpha=0.75 if side < 0 else 0.35, linewidth=0)
    middle = float(np.median(values))
    axes.plot([middle, middle], [row, row + side * 0.42], color=INK, linewidth=1.2, solid_capstyle="butt")


def continuity(metrics: dict[str, Any]) -> Drawing | None:
    """|df| / |dw| per start: median (dot), p99 (bar) and largest (cross)."""
    rows = {key: row for key, row in (metrics.get("continuity") or {}).items() if row["slope"]["median"] is not None}
    if not rows:
        return None
    figure, axes = new_figure(WIDTH, 0.9 + 0.26 * len(rows))
    for k, (key, row) in enumerate(rows.items()):
        tint = colour("ink" if key == "optimum" else key)
        middle, p99, most = (row["slope"][part] for part in ("median", "p99", "max"))
        axes.plot([middle, p99], [k, k], color=tint, linewidth=3, alpha=0.5, solid_capstyle="butt")
        axes.plot([middle], [k], marker="o", markersize=5, color=tint)
        axes.plot([most], [k], marker="x", markersize=6, color=tint)
    axes.set(xscale="log", xlabel="|df| / |dw|", ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(range(len(rows)), ["optimum" if key == "optimum" else short(key) for key in rows])
    axes.tick_params(axis="y", length=0)
    decades(axes.xaxis)
    return Drawing(figure)


def forces_over_time(trials: Trials) -> Drawing:
    """Optimal contact forces along W_ext(t): normal and tangential force of every finger."""
    force = trials["optimum/force"]
    times = np.arange(len(force)) * 0.01
    figure, (top, bottom) = new_figure(WIDTH, 4.2, rows=2)
    for finger in range(force.shape[1]):
        tint = colour(f"finger_{finger}")
        top.plot(times, force[:, finger, 0], color=tint)
        bottom.plot(times, np.hypot(force[:, finger, 1], force[:, finger, 2]), color=tint)
    moment = np.abs(paper_path(times)[:, 5])
    top.fill_between(times, 0, moment * top.get_ylim()[1] * 0.98, color=INK, alpha=0.07, linewidth=0)
    top.annotate("shaded: moment about z (peak 1 N m)", (0.5, 0.03), xycoords="axes fraction", ha="center", fontsize=8)
    top.set(ylabel="normal force [N]")
    bottom.set(xlabel="time [s]", ylabel="tangential force [N]")
    return Drawing(figure, [entry(text, f"finger_{k}") for k, text in enumerate(FINGERS[: force.shape[1]])])


def start_against_optimum(trials: Trials) -> Drawing:
    """Normal forces of the paper's start and of learned ones beside the optimum along W_ext(t) (the paper's Fig. 4)."""
    optimum = trials["optimum/force"]
    times = np.arange(len(optimum)) * 0.01
    shown = [key for key in ("linear_combination", "learned_fixed", "learned_any") if f"{key}/force" in trials]
    figure, axes = new_figure(WIDTH, 4.2, rows=2, columns=2)
    for finger, panel in enumerate(axes.ravel()[: optimum.shape[1]]):
        panel.plot(times, optimum[:, finger, 0], color=INK, linewidth=1.6)
        for key in shown:
            panel.plot(times, trials[f"{key}/force"][:, finger, 0], color=colour(key), linestyle="--", linewidth=1.2)
        panel.set_title(FINGERS[finger], fontsize=10)
        panel.set(ylim=(0, None))
    for panel in axes[1]:
        panel.set_xlabel("time [s]")
    for panel in axes[:, 0]:
        panel.set_ylabel("normal force [N]")
    return Drawing(figure, [entry("optimum", "ink"), *((f"start: {short(key)}", key, True) for key in shown)])


def rollout(rollouts: Trials, start: str = "linear_combination") -> Drawing | None:
    """The simulated hand: drift, commanded and measured thumb force, iterations, for every scenario; None without any."""
    figure, (top, middle, bottom) = new_figure(WIDTH, 5.6, rows=3)
    legend = []
    for name, (scenario, text) in zip(_SCENARIOS, SCENARIO_LABELS.items(), strict=False):
        base = f"{scenario}/{start}/0"
        if f"{base}/time" not in rollouts:
            continue
        times, tint = rollouts[f"{base}/time"], colour(name)
        top.plot(times, np.maximum(rollouts[f"{base}/drift"] * 1e3, 1e-6), color=tint)
        middle.plot(times, rollouts[f"{base}/commanded_force"][:, 0, 0], color=tint)
        middle.plot(times, rollouts[f"{base}/measured_force"][:, 0, 0], color=INK, linestyle=":", linewidth=0.9)
        bottom.plot(times, rollouts[f"{base}/iterations"], color=tint, linewidth=1.0)
        legend.append(entry(text, name))
    if not legend:
        return None
    top.axhline(1.0, color=INK, linewidth=0.8, linestyle=":")
    top.set(yscale="log", ylabel="object drift [mm]")
    middle.set(ylabel="thumb normal force [N]")
    bottom.set(xlabel="time [s]", ylabel="flow iterations")
    decades(top.yaxis)
    return Drawing(figure, [*legend, ("measured", "ink", True)])


def training_curve(card: dict[str, Any]) -> Drawing | None:
    """The held-out gaps of a model while it was fitted: the last columns of its card's curve; None without one."""
    curve = card.get("curve")
    if not isinstance(curve, dict) or len(curve.get("rows") or []) < 2:
        return None
    rows = [row.split() if isinstance(row, str) else row for row in curve["rows"]]
    columns, rows = curve["columns"], np.array(rows, dtype=float)
    figure, axes = new_figure(WIDTH, 2.8)
    shown = range(max(2, len(columns) - len(_CURVE)), len(columns))
    for name, column in zip(_CURVE, shown, strict=False):
        axes.plot(rows[:, 0], np.maximum(rows[:, column], 1e-12), color=colour(name))
    axes.set(yscale="log", xlabel="optimisation steps", ylabel="held-out gap")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    decades(axes.yaxis)
    legend = [entry(columns[column], name) for name, column in zip(_CURVE, shown, strict=False)]
    return Drawing(figure, legend) if legend else None
