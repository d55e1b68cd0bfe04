"""Figures of the hold rates, from metrics and saved trials. One function per figure."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.report.style import new_figure
from training.trials.hold_metrics import ASKED_RATE, Trials
from training.trials.hold_plan import CONTROLLER_LABELS, SCENARIO_LABELS

COLOURS = {"paper": "#1f5fa8", "estimated": "#2e8b57", "constant_squeeze": "#c08a3e", "pd": "#b3261e"}
_SHAPE_COLOURS = {"cuboid": "#1f5fa8", "cylinder": "#2e8b57", "sphere": "#b3261e", "capsule": "#c08a3e"}
_CAUSE_COLOURS = {
    "no_start": "#8a8a8a", "dropped": "#b3261e", "drifted": "#e07a5f", "closure_lost": "#c08a3e",
    "force_optimisation": "#7a4fa3", "simulation_diverged": "#1b1b1b",
}  # fmt: skip


def rate_against_squeeze(metrics: dict[str, Any]) -> Figure:
    """Hold rate against the mean total normal force that it costs, one panel per scenario, one point per swept value."""
    figure, panels = new_figure(8.2, 3.4 * len(metrics["chosen"]), rows=len(metrics["chosen"]))
    for axes, (scenario, chosen) in zip(np.ravel(panels), metrics["chosen"].items(), strict=True):
        for key, best in chosen.items():
            rows = [row for row in metrics["cells"] if (row["scenario"], row["controller"]) == (scenario, key)]
            _curve(axes, [row for row in rows if row["normal_force"]["mean"] is not None], key, best)
        axes.axhline(100 * ASKED_RATE, color="black", linewidth=0.8, linestyle=":")
        axes.set(xscale="log", ylabel="episodes held [%]", ylim=(-4, 108))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        axes.set_title(SCENARIO_LABELS[scenario], fontsize=9)
    np.ravel(panels)[-1].set_xlabel("mean total normal force [N], measured")
    handles, names = np.ravel(panels)[-1].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, frameon=False, loc="outside upper center", ncols=2)
    return figure


def _curve(axes: Any, rows: list[dict[str, Any]], key: str, best: str) -> None:
    """One controller's points with intervals, each with its swept value, that of `best` bold."""
    if not rows:
        return
    force, rate = np.array([_triple(row["normal_force"]) for row in rows]), np.array([_rate(row) for row in rows])
    axes.errorbar(
        force[:, 0], 100 * rate[:, 0], xerr=_bars(force), yerr=100 * _bars(rate), fmt="o-", color=COLOURS[key],
        label=CONTROLLER_LABELS[key], linewidth=1.0, elinewidth=0.8, markersize=4,
    )  # fmt: skip
    for row, x, y in zip(rows, force[:, 0], 100 * rate[:, 0], strict=True):
        axes.annotate(
            f"{row['swept']:g}", (x, y), textcoords="offset points", xytext=(3, 4), fontsize=7, color=COLOURS[key],
            weight="bold" if row["name"] == best else "normal",
        )  # fmt: skip


def drift_ecdf(trials: dict[str, Trials]) -> Figure:
    """Share of episodes whose largest drift is below x, paper's pipeline on random objects, by shape; lost ones never are."""
    figure, axes = new_figure(7.2, 4.2)
    mine = trials["objects/paper"]
    for shape, colour in _SHAPE_COLOURS.items():
        pick = mine["shape"] == shape
        if not pick.any():
            continue
        drift = np.sort(1e3 * mine["max_drift"][pick & mine["held"]])
        share = np.arange(1, len(drift) + 1) / pick.sum()
        axes.step(np.maximum(drift, 1e-4), share, where="post", color=colour, label=f"{shape} ({pick.sum()})")
    axes.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", xlabel="largest drift of an episode [mm]", ylabel="share of episodes", ylim=(0, 1.01))
    axes.legend(fontsize=8, frameon=False)
    return figure


def failure_bars(metrics: dict[str, Any]) -> Figure:
    """Share of episodes that were not held, by cause, for every cell but the swept ones."""
    chosen = {name for best in metrics["chosen"].values() for name in best.values()}
    rows = [row for row in metrics["cells"] if row["swept"] is None or row["name"] in chosen]
    figure, axes = new_figure(8.8, 0.9 + 0.24 * len(rows))
    left = np.zeros(len(rows))
    for cause, colour in _CAUSE_COLOURS.items():
        share = np.array([100 * row["failures"].get(cause, 0) / row["episodes"] for row in rows])
        if share.any():
            axes.barh(np.arange(len(rows)), share, left=left, color=colour, label=cause.replace("_", " "))
            left += share
    labels = [_cell_label(row) for row in rows]
    axes.set(yticks=np.arange(len(rows)), yticklabels=labels, xlabel="episodes not held [%]", xlim=(0, 100))
    axes.tick_params(axis="y", labelsize=7)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if left.any():
        axes.legend(fontsize=8, frameon=False)
    return figure


def _cell_label(row: dict[str, Any]) -> str:
    swept = "" if row["swept"] is None else f", {row['swept']:g}"
    return f"{SCENARIO_LABELS[row['scenario']]}: {CONTROLLER_LABELS[row['controller']]}{swept}"


def _triple(mean: dict[str, Any]) -> tuple[float, float, float]:
    return mean["mean"], mean["low"], mean["high"]


def _rate(row: dict[str, Any]) -> tuple[float, float, float]:
    return row["rate"], row["rate_low"], row["rate_high"]


def _bars(values: np.ndarray) -> np.ndarray:
    """(2, n) lengths of error bars of (n, 3) values, lower and upper ends."""
    return np.maximum(np.stack([values[:, 0] - values[:, 1], values[:, 2] - values[:, 0]]), 0.0)
