"""Figures of a comparison of starts, from saved trials: convergence, microseconds, continuity, forces, roll-outs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from grasp_env.grasp.wrench import paper_path
from training.cases.set_table import TOLERANCE
from training.cases.start_table import given_in
from training.report.starts import short
from training.report.style import INK, WIDTH, Drawing, colour, decades, entry, line_style, new_figure, tones
from training.runs.words import small
from training.trials.arrays import SCENARIO_LABELS, Trials, starts_in

FLOOR = 1e-7
"""Gaps below are drawn there."""
_FAN = ("linear_combination", "previous_tangent", "network", "learned_previous")
_FAN_MORE = ("basis_tangent", "nearest_tangent")
"""Where the others are few."""


def fan(trials: Trials) -> Drawing | None:
    """Gap after k accepted steps of the reduced flow, a small panel per start: median, p10 to p90, dotted the 12-basis's median."""
    tone = tones(starts_in(trials))
    found = _traces(trials, [*_FAN, *given_in(tone)])
    if len(found) < 3:
        found |= _traces(trials, _FAN_MORE)
    if not found:
        return None
    lines = -(-len(found) // 2)
    figure, axes = new_figure(WIDTH, 0.5 + 1.15 * lines, rows=lines, columns=2, share_all=True)
    base, last = found.get("linear_combination"), 8
    for panel, (key, rows) in zip(np.ravel(axes), found.items(), strict=False):
        low, middle, high = np.percentile(rows, [10, 50, 90], axis=0)
        last = max(last, _reached(high))
        steps, tint = _spread(rows.shape[1]), colour(tone[key])
        if base is not None and rows is not base:
            panel.plot(1 + steps, np.median(base, axis=0)[steps], color=INK, linewidth=0.9, linestyle=":")
        panel.fill_between(1 + steps, low[steps], high[steps], color=tint, alpha=0.25, linewidth=0)
        panel.plot(1 + steps, middle[steps], color=tint, linewidth=2.0)
        panel.set_title(short(key), fontsize=9.5)
    for panel in np.ravel(axes)[len(found) :]:
        panel.set_visible(False)
    first = np.ravel(axes)[0]
    first.set(xscale="log", yscale="log", xlim=(1, 1.15 * last + 1), ylim=(0.5 * FLOOR, None))
    for panel in np.ravel(axes):
        decades(panel.xaxis)
        panel.set_yticks([1e-6, TOLERANCE, 1e-2, 1.0], [small(gap) for gap in (1e-6, TOLERANCE, 1e-2, 1.0)])
    figure.supxlabel("1 + accepted steps", fontsize=10)
    figure.supylabel("relative gap of Phi", fontsize=10)
    return Drawing(figure)


def _reached(gaps: np.ndarray) -> int:
    """After how many steps the gaps (k,) are well below the tolerance."""
    reached = np.flatnonzero(gaps <= 0.1 * TOLERANCE)
    return int(reached[0]) if len(reached) else len(gaps) - 1


def convergence(trials: Trials) -> Drawing | None:
    """The gap of every start after k accepted steps of the reduced flow, of one case."""
    tone = tones(starts_in(trials))
    found = _traces(trials, list(tone))
    if not found:
        return None
    figure, axes = new_figure(WIDTH, 3.2)
    for key, rows in found.items():
        steps = _spread(rows.shape[1])
        axes.plot(1 + steps, np.median(rows, axis=0)[steps], **line_style(tone[key]))
    last = max(8, *(_reached(np.median(rows, axis=0)) for rows in found.values()))
    axes.axhline(TOLERANCE, color=INK, linewidth=0.8, linestyle=":")
    axes.set(
        xscale="log", yscale="log", xlabel="1 + accepted steps", ylabel="relative gap of Phi", xlim=(1, 1.15 * last + 1),
        ylim=(0.5 * FLOOR, None),
    )  # fmt: skip
    decades(axes.xaxis)
    decades(axes.yaxis)
    return Drawing(figure, [entry(short(key), tone[key]) for key in found])


def _traces(trials: Trials, starts: Sequence[str]) -> dict[str, np.ndarray]:
    """(m, k) gaps per start, of the cases that it has a start for."""
    out = {}
    for key in starts:
        rows = trials.get(f"reduced_flow/{key}/trace", np.empty((0, 1)))
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows):
            out[key] = np.maximum(rows, FLOOR)
    return out


def _spread(count: int, wanted: int = 60) -> np.ndarray:
    """At most about `wanted` of range(count), dense at its beginning: what a logarithmic axis shows."""
    return np.unique(np.round(np.geomspace(1, count, wanted)).astype(int)) - 1


FINGERS = ("thumb", "middle finger", "left finger", "right finger")
_CURVE = ("finger_1", "finger_2", "finger_0")
_SCENARIOS = ("finger_0", "finger_1", "finger_3", "finger_2", "other_0", "other_1", "other_2")


def violins(timing: Trials) -> Drawing | None:
    """Latency per start: above the line start and reduced flow, below it start and Newton; the bar is the median."""
    tone = tones(name.split("/")[0] for name in timing if name.endswith("/start_us"))
    keys = [key for key in tone if np.isfinite(timing[f"reduced_flow/{key}/total_us"]).any()]
    if not keys:
        return None
    figure, axes = new_figure(WIDTH, 0.9 + 0.34 * len(keys))
    for row, key in enumerate(keys):
        for method, side in (("reduced_flow", -1.0), ("newton", 1.0)):
            values = timing.get(f"{method}/{key}/total_us")
            if values is not None and np.isfinite(values).any():
                _half(axes, row, side, _best(values), colour(tone[key]))
    axes.set(xscale="log", xlabel="microseconds per call", ylim=(len(keys) - 0.4, -0.6))
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
    tone = tones(key for key in metrics["continuity"] if key != "optimum")
    figure, axes = new_figure(WIDTH, 0.9 + 0.26 * len(rows))
    for k, (key, row) in enumerate(rows.items()):
        tint = colour(tone.get(key, "ink"))
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
    tone = tones(starts_in(trials))
    shown = [key for key in ("linear_combination", "learned_fixed", *given_in(tone)) if f"{key}/force" in trials]
    figure, axes = new_figure(WIDTH, 4.2, rows=2, columns=2)
    for finger, panel in enumerate(axes.ravel()[: optimum.shape[1]]):
        panel.plot(times, optimum[:, finger, 0], color=INK, linewidth=1.6)
        for key in shown:
            panel.plot(
                times, trials[f"{key}/force"][:, finger, 0], color=colour(tone[key]), linestyle="--", linewidth=1.2
            )
        panel.set_title(FINGERS[finger], fontsize=10)
        panel.set(ylim=(0, None))
    for panel in axes[1]:
        panel.set_xlabel("time [s]")
    for panel in axes[:, 0]:
        panel.set_ylabel("normal force [N]")
    return Drawing(figure, [entry("optimum", "ink"), *((f"start: {short(key)}", tone[key], True) for key in shown)])


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
