"""The report of `grasp rl`: rl.json, rl.md and the learning curves, from scores and checkpoints; nothing is simulated."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from training.runs import Run

COLOURS = {
    "ppo/initial_force": "#1f5fa8",
    "sac/initial_force": "#b3261e",
    "ppo/contact_force": "#2e8b57",
    "sac/contact_force": "#c08a3e",
}
FIGURE = "learning_curve.png"


def write_report(run: Run, report: dict[str, Any]) -> None:
    """Writes the three files into the run's folder.

    Args:
        run: receives them.
        report: of `evaluate.evaluate_runs`.
    """
    run.write_json("rl.json", report)
    run.write_text("rl.md", markdown(report))
    figure = learning_curves(report)
    run.write(FIGURE, lambda path: figure.savefig(path, format="png", dpi=150, bbox_inches="tight"))
    plt.close(figure)


def markdown(report: dict[str, Any]) -> str:
    """The report as text, the table first."""
    lines = [
        "# Reinforcement learning on FourFingerGrasp-v0",
        "",
        *(["**A quick run: too short to say anything about learning.**", ""] if report["quick"] else []),
        f"{report['episodes']} held-out episodes of at most 100 steps (2 s), seeds {report['held_out_seeds'][0]} to "
        f"{report['held_out_seeds'][1]}, the same for every row; random wrench, default cuboid, deterministic actions. An agent's "
        "row is over all its training seeds. Intervals are 95 %: Wilson for the rate, bootstrap for the rest (return: interquartile "
        "mean, over training seeds and episodes).",
        "",
        "| policy | seeds | held | iterations per step: median / p95 / p99 | per episode, against the paper | squeeze [N] "
        "| largest drift [mm] | return, IQM |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(row, key in report["training"]) for key, row in report["rows"].items()),
        "",
        f"![learning curves]({FIGURE})",
        "",
        "Thin lines are training seeds, thick ones their mean; the dashed line is the zero policy, the paper's start, on the same "
        "episodes. Iterations and return are of the deterministic policy.",
        "",
        "## Training",
        "",
        "| agent | seed | steps | seconds, of processor | steps per processor second | median iterations, first -> last | return, first -> last |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, several in report["training"].items():
        for one in several:
            first, last = one["curve"][0], one["curve"][-1]
            lines.append(
                f"| {report['rows'][key]['label']} | {one['seed']} | {one['steps']} | {one['seconds']:.0f}, {one['cpu_seconds']:.0f} "
                f"| {one['steps'] / max(one['cpu_seconds'], 1e-9):.0f} | {_iterations(key, first)} -> {_iterations(key, last)} "
                f"| {first['return']:.1f} -> {last['return']:.1f} |"
            )
    prices = {
        name: report["env_settings"][name] for name in ("held_reward", "iteration_cost", "force_cost", "failure_cost")
    }
    machine = report["machine"]
    lines += [
        "",
        f"Reward: {prices['held_reward']:g} per step held, -{prices['iteration_cost']:g} per iteration, "
        f"-{prices['force_cost']:g} per newton of total normal force, -{prices['failure_cost']:g} when the object is lost. Seconds "
        "are of training alone, without the scores along the curve, on one thread; other programs shared the cores where the two differ.",
        "",
        "What an agent sees is the wrench of one control tick ago; the learned start and the previous solution, which the solver "
        "calls itself, see the wrench of now. Agents without solver make no iterations by construction: their held rate, squeeze "
        "and drift are what compares; their curves do not start at the paper.",
        "",
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}, Python {machine['python']}, "
        + ", ".join(f"{name} {number}" for name, number in report["versions"].items())
        + f"; commit {report['commit']}; {report['time']}.",
        "",
    ]
    return "\n".join(lines)


_PANELS = {
    "iterations": ("iterations per step, mean", "/initial_force"),
    "length": ("steps until the object is lost (100: never)", "/contact_force"),
    "return": ("return of an episode (100 steps)", ""),
}
"""Of the figure: what is drawn, its label, and of which agents."""


def learning_curves(report: dict[str, Any]) -> Figure:
    """Iterations of agents with a solver, steps held of those without, and return, against environment steps."""
    training = report["training"]
    panels = {name: told for name, told in _PANELS.items() if any(key.endswith(told[1]) for key in training)}
    figure, grid = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 4.4), squeeze=False)
    for axis, (name, (label, ending)) in zip(grid[0], panels.items(), strict=True):
        for key in [key for key in training if key.endswith(ending)]:
            curves = [np.array([[p["steps"], p[name]] for p in one["curve"]]).T for one in training[key]]
            for steps, values in curves:
                axis.plot(steps, values, color=COLOURS[key], linewidth=0.7, alpha=0.55)
            shared = np.linspace(0.0, min(steps[-1] for steps, _ in curves), 60)
            mean = np.mean([np.interp(shared, steps, values) for steps, values in curves], axis=0)
            axis.plot(shared, mean, color=COLOURS[key], linewidth=2.2, label=report["rows"][key]["label"])
        zero = report["curve_of_zero"][name]
        axis.axhline(zero, color="black", linewidth=1.0, linestyle="--", label="zero policy: the paper")
        axis.set(xlabel="environment steps", ylabel=label, xlim=(0, None))
        if name != "return":
            axis.set_ylim(0, None)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    handles = {
        label: handle for axis in grid[0] for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), ncol=3, fontsize=8, frameon=False, loc="lower center")
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    return figure


def _line(row: dict[str, Any], trained: bool) -> str:
    low, high = 100 * row["held_low"], 100 * row["held_high"]
    several, told, squeeze, drift = row["iterations"], row["iterations_against_paper"], row["squeeze"], row["drift_mm"]
    solver = "no solver" not in row["label"]
    numbers = f"{several['median']:.0f} / {several['p95']:.0f} / {several['p99']:.0f}" if solver else "no solver"
    ratio = f"{told['ratio']:.2f} ({told['low']:.2f} to {told['high']:.2f})" if solver else "no solver"
    gain = row["return"]
    return (
        f"| {row['label']} | {row['seeds'] if trained else '-'} | {row['held']} of {row['episodes']} ({low:.1f} to {high:.1f} %) | {numbers} | {ratio} "
        f"| {squeeze['mean']:.1f} ({squeeze['low']:.1f} to {squeeze['high']:.1f}) | {drift['mean']:.2f} "
        f"| {gain['iqm']:.1f} ({gain['low']:.1f} to {gain['high']:.1f}) |"
    )


def _iterations(key: str, point: dict[str, Any]) -> str:
    return f"{point['median_iterations']:.0f}" if key.endswith("initial_force") else "no solver"
