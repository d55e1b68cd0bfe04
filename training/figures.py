"""Figures of a report, from saved trials. One function per figure: (trials...) -> matplotlib figure."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from grasp_env.grasp.wrench import paper_path
from training.metrics import Trials
from training.rollouts import SCENARIO_LABELS
from training.starts import LABELS, TOLERANCE

COLOURS = {
    "single_value": "#8a8a8a",
    "lagrange": "#c08a3e",
    "linear_combination_printed": "#7fb2e5",
    "linear_combination": "#1f5fa8",
    "previous_pseudoinverse": "#8fc98f",
    "previous_tangent": "#2e8b57",
    "learned_fitted": "#e07a5f",
    "learned_shipped": "#b3261e",
}
FINGERS = ("thumb", "middle finger", "left finger", "right finger")
_FINGER_COLOURS = ("#b3261e", "#1f5fa8", "#2e8b57", "#c08a3e")
_SCENARIO_COLOURS = (*_FINGER_COLOURS, "#7a4fa3", "#5b5b5b")
_STYLE: Any = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "figure.dpi": 130,
    "savefig.bbox": "tight",
}


def convergence(traces: Trials) -> Figure:
    """Relative gap of Phi against accepted steps, per start, on the paper's constant wrench (the paper's Fig. 3)."""
    figure, axes = new_figure(9.2, 4.2)
    for key, label in LABELS.items():
        if f"{key}/trace" in traces:
            values = traces[f"{key}/trace"]
            style = {"linestyle": "--"} if key == "linear_combination_printed" else {}
            axes.semilogy(np.arange(len(values)), values, color=COLOURS[key], label=label, **style)
    axes.axhline(TOLERANCE, color="black", linewidth=0.8, linestyle=":")
    axes.annotate("1e-4", (1.0, TOLERANCE), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8)
    axes.set(xlabel="accepted steps of the reduced flow", ylabel="(Phi - min Phi) / min Phi", ylim=(1e-8, None))
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def iterations_ecdf(trials: Trials) -> Figure:
    """Share of held-out wrenches solved within k accepted steps, per start."""
    figure, axes = new_figure(9.2, 4.2)
    for key, label in LABELS.items():
        name = f"ball/{key}/iterations"
        if name not in trials:
            continue
        steps = trials[name]
        solved = np.where(trials[f"ball/{key}/status"] == 0, steps, np.iinfo(np.int64).max)
        solved = solved[1:] if key.startswith("previous") else solved
        order = np.sort(solved)
        keep = order < np.iinfo(np.int64).max
        share = np.arange(1, len(order) + 1) / len(order)
        style = {"linestyle": "--"} if key == "linear_combination_printed" else {}
        axes.step(order[keep] + 1, share[keep], where="post", color=COLOURS[key], label=label, **style)
    axes.set(
        xscale="log", xlabel="1 + accepted steps to a relative gap of 1e-4", ylabel="share of wrenches", ylim=(0, 1)
    )
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def forces_over_time(trials: Trials) -> Figure:
    """Optimal contact forces along W_ext(t): normal and tangential force of every finger."""
    force = trials["paper_path/optimum/force"]
    times = np.arange(len(force)) * 0.01
    figure, (top, bottom) = new_figure(7.2, 5.6, rows=2)
    for finger, (label, colour) in enumerate(zip(FINGERS, _FINGER_COLOURS, strict=True)):
        top.plot(times, force[:, finger, 0], color=colour, label=label)
        bottom.plot(times, np.hypot(force[:, finger, 1], force[:, finger, 2]), color=colour, label=label)
    moment = np.abs(paper_path(times)[:, 5])
    top.fill_between(times, 0, moment * top.get_ylim()[1] * 0.98, color="black", alpha=0.06, linewidth=0)
    top.annotate("shaded: moment about z (peak 1 N m)", (0.5, 0.02), xycoords="axes fraction", ha="center", fontsize=8)
    top.set(ylabel="normal force [N]")
    bottom.set(xlabel="time [s]", ylabel="tangential force [N]")
    top.legend(fontsize=8, frameon=False)
    return figure


def start_against_optimum(trials: Trials) -> Figure:
    """Normal forces of the paper's start and of the learned one beside the optimum along W_ext(t) (Fig. 4)."""
    optimum = trials["paper_path/optimum/force"]
    times = np.arange(len(optimum)) * 0.01
    shown = [key for key in ("linear_combination", "learned_shipped") if f"paper_path/{key}/force" in trials]
    figure, axes = new_figure(7.2, 5.6, rows=2, columns=2)
    for finger, panel in enumerate(axes.ravel()):
        panel.plot(times, optimum[:, finger, 0], color="black", linewidth=1.6, label="optimum")
        for key in shown:
            force = trials[f"paper_path/{key}/force"][:, finger, 0]
            panel.plot(times, force, color=COLOURS[key], linestyle="--", linewidth=1.2, label=f"start: {LABELS[key]}")
        panel.set_title(FINGERS[finger], fontsize=9)
        panel.set(ylim=(0, None))
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, frameon=False, loc="outside upper center", ncols=3)
    for panel in axes[1]:
        panel.set_xlabel("time [s]")
    for panel in axes[:, 0]:
        panel.set_ylabel("normal force [N]")
    return figure


def rollout(rollouts: Trials, start: str = "linear_combination") -> Figure:
    """The simulated hand: drift, commanded against measured thumb force, iterations, for every scenario."""
    figure, (top, middle, bottom) = new_figure(7.2, 8.2, rows=3)
    for colour, (scenario, label) in zip(_SCENARIO_COLOURS, SCENARIO_LABELS.items(), strict=True):
        base = f"{scenario}/{start}/0"
        if f"{base}/time" not in rollouts:
            continue
        times = rollouts[f"{base}/time"]
        top.semilogy(times, np.maximum(rollouts[f"{base}/drift"] * 1e3, 1e-6), color=colour, label=label)
        middle.plot(times, rollouts[f"{base}/commanded_force"][:, 0, 0], color=colour)
        middle.plot(times, rollouts[f"{base}/measured_force"][:, 0, 0], color="black", linestyle=":", linewidth=1.2)
        bottom.plot(times, rollouts[f"{base}/iterations"], color=colour)
    top.axhline(1.0, color="black", linewidth=0.8, linestyle=":")
    top.set(ylabel="object drift [mm]\n(at least 1e-6 drawn)")
    figure.legend(fontsize=8, frameon=False, loc="outside upper left")
    middle.set(ylabel="thumb normal force [N]\n(dotted: measured)")
    bottom.set(xlabel=f"time [s]   (start: {LABELS[start]})", ylabel="flow iterations")
    return figure


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """A figure of the house style, size in inches, and its axes."""
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=(width, height), sharex=rows > 1, layout="constrained")
    for axis in np.ravel(axes):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    return figure, axes


def close(figure: Figure) -> None:
    """Frees a figure."""
    plt.close(figure)
