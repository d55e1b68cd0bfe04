"""Reinforcement learning: the report of `grasp rl`, and its part in others, from rl.json; a file of another form is shown as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from training.report.first import found_section
from training.report.glossary import LEARNING
from training.report.page import Fold, Picture, Section, Table, at, flat, png, present, write_page
from training.report.style import INK, WIDTH, Drawing, colour, entry, new_figure
from training.runs import Run
from training.runs.words import number, percent

_COLOURS = {
    "ppo/initial_force": "linear_combination",
    "sac/initial_force": "learned_fixed",
    "ppo/contact_force": "previous_tangent",
    "sac/contact_force": "lagrange",
}
"""Names of `style.THEME`."""
ALGORITHMS = {"sac": "Soft actor-critic", "ppo": "Proximal policy optimisation"}


def write_report(run: Run, found: dict[str, Any]) -> None:
    """Writes rl.json, rl.md and learning_curve.png into the run's folder.

    Args:
        run: receives them.
        found: of `evaluate.evaluate_runs`.
    """
    run.write_json("rl.json", found)
    text = "Thin: training seeds, thick: their mean; dashed: the zero policy, the paper's start, on the same episodes. All of the deterministic policy."
    picture = png(run, "learning_curve.png", all_curves(found), "Learning curves", text)
    title = "Reinforcement learning on FourFingerGrasp-v0"
    sections = [found_section(learning_found(found), (), LEARNING), rl_section(found, [picture])]
    write_page(run, title, found["quick"], sections, "rl", html=False)


def learning_found(found: dict[str, Any]) -> list[str]:
    """What the agents came to beside the paper's start, in up to three sentences from the run's own numbers."""
    rows, agents = dict(_items(found.get("rows"))), dict(_items(found.get("training")))
    rows = {key: row for key, row in rows.items() if isinstance(row, dict)}
    solving = {
        key: row["iterations_against_paper"] for key, row in rows.items()
        if not key.endswith("contact_force") and at(row, "iterations_against_paper", "ratio") is not None and key != "zero"
    }  # fmt: skip
    out = []
    for about, keys in (
        ("Agents", [key for key in solving if key in agents]),
        ("Other starts", [key for key in solving if key not in agents]),
    ):
        if keys:
            told = "; ".join(
                f"{_label(rows, key)} {_interval(solving[key], 'ratio')}, {_against(solving[key])}" for key in keys
            )
            out.append(f"{about}: iterations per episode, in parts of the paper's start's with 95 % intervals: {told}.")
    trained = [key for key in agents if at(rows, key, "return", "iqm") is not None]
    if trained:
        told = "; ".join(_outcome(rows, key) for key in (*trained, *(["zero"] if "zero" in rows else [])))
        out.append(f"Held and return: {told}.")
    return out


def _against(row: dict[str, Any]) -> str:
    """In words, by the interval."""
    low, high = at(row, "low"), at(row, "high")
    if low is None or high is None:
        return "no interval"
    return "fewer" if high < 1.0 else "more" if low > 1.0 else "no clear difference"


def _outcome(rows: dict[str, Any], key: str) -> str:
    row = rows[key]
    return f"{_label(rows, key)} {number(at(row, 'held'))} of {number(at(row, 'episodes'))}, return {_interval(at(row, 'return'), 'iqm')}"


def _label(rows: dict[str, Any], key: str) -> str:
    return f"“{at(rows, key, 'label') or key}”"


def rl_section(found: dict[str, Any] | None, pictures: list[Picture]) -> Section | None:
    """Agents beside the paper's, the learned and the previous start on the same held-out episodes; None without a file."""
    if not found:
        return None
    keys = [key for key, _ in _items(found.get("training"))]
    names = [text for name, text in ALGORITHMS.items() if any(key.startswith(f"{name}/") for key in keys)]
    notes = [
        f"{' and '.join(names) or 'Agents'} on FourFingerGrasp-v0, scored by the same evaluator as every other start. A policy that does "
        "nothing is the paper's start, where the curves of agents that adjust it begin. None need win.",
        *_protocol(found),
        "What an agent sees is the wrench of one control tick ago; the learned start and the previous solution, which the solver "
        "calls itself, see the wrench of now.",
    ]
    if any(key.endswith("/contact_force") for key in keys):
        notes.append(
            "Agents without solver make no iterations by construction: their held rate, squeeze and drift are what compares; their curves do "
            "not start at the paper."
        )
    if found.get("quick"):
        notes.insert(0, "A quick run: too short to say anything about learning.")
    settings = {key: value for key, value in found.items() if key not in ("rows", "training", "quick")}
    saved = Table("As saved in rl.json", ("", "value"), [list(line) for line in flat(settings)], words=2)
    blocks = present(
        [_scores(found), *pictures, _training(found), Fold("Settings and versions of these runs", present([saved]))]
    )
    return Section("rl", "Reinforcement learning", notes, blocks)


def _protocol(found: dict[str, Any]) -> list[str]:
    """How agents were scored, in the numbers of this run; nothing of a file that does not say."""
    seeds, prices = at(found, "held_out_seeds"), at(found, "env_settings") or {}
    out = []
    if isinstance(seeds, list) and len(seeds) == 2:
        out.append(
            f"{number(at(found, 'episodes'))} held-out episodes, seeds {seeds[0]} to {seeds[1]}, the same for every row; random wrench, "
            "default cuboid, deterministic actions. An agent's row is over all its training seeds. Intervals are 95 %: Wilson for the "
            "rate, bootstrap for the rest (return: interquartile mean, over training seeds and episodes)."
        )
    if {"held_reward", "iteration_cost", "force_cost", "failure_cost"} <= set(prices):
        out.append(
            f"Reward: {prices['held_reward']:g} per step held, -{prices['iteration_cost']:g} per iteration, -{prices['force_cost']:g} "
            f"per newton of total normal force, -{prices['failure_cost']:g} when the object is lost. Seconds are of training alone, "
            "without the scores along the curve, on one thread; other programs shared the cores where the two differ."
        )
    return out


def _scores(found: dict[str, Any]) -> Table:
    rows = []
    for key, row in _items(found.get("rows")):
        held = f"{number(at(row, 'held'))} of {number(at(row, 'episodes'))}"
        if at(row, "held_low") is not None:
            held += f" [{percent(at(row, 'held_low'))}, {percent(at(row, 'held_high'))}]"
        solver = not key.endswith("contact_force")
        counts = " / ".join(number(at(row, "iterations", part)) for part in ("median", "p95", "p99"))
        rows.append([
            str(row.get("label", key)), number(at(row, "seeds")) if at(found, "training", key) else "–", held, counts if solver else "no solver",
            _interval(at(row, "iterations_against_paper"), "ratio") if solver else "no solver",
            _interval(at(row, "squeeze"), "mean"), number(at(row, "drift_mm", "mean")), _interval(at(row, "return"), "iqm"),
        ])  # fmt: skip
    columns = (
        "policy", "seeds", "held, 95 % interval", "iterations per step, median / p95 / p99", "of the paper's, per episode",
        "squeeze [N]", "largest drift [mm]", "return, IQM",
    )  # fmt: skip
    count = number(found.get("episodes") if not isinstance(found.get("episodes"), (dict, list)) else None)
    return Table(f"{count} held-out episodes, the same for every row; 95 % intervals", columns, rows)


def _training(found: dict[str, Any]) -> Table:
    rows = []
    for key, several in _items(found.get("training")):
        for one in several if isinstance(several, list) else []:
            curve = one.get("curve") or [{}]
            ends = {name: [number(at(curve[k], name)) for k in (0, -1)] for name in ("median_iterations", "return")}
            change = {name: f"{first} → {last}" for name, (first, last) in ends.items()}
            if key.endswith("contact_force"):
                change["median_iterations"] = "no solver"
            steps, spent = one.get("steps"), one.get("cpu_seconds")
            rows.append([
                at(found, "rows", key, "label") or key, number(one.get("seed")), number(steps), number(one.get("seconds")),
                number(spent), number(round(steps / max(spent, 1e-9)) if steps and spent else None), *change.values(),
            ])  # fmt: skip
    columns = (
        "agent", "seed", "environment steps", "seconds", "of processor", "steps per processor second",
        "median iterations, first → last", "return, first → last",
    )  # fmt: skip
    return Table("Training, every seed", columns, rows)


PANELS = {
    "iterations": ("iterations per step, mean", "/initial_force"),
    "length": ("steps until the object is lost", "/contact_force"),
    "return": ("return of an episode", ""),
}
"""What can be drawn along a training: its label, and of which agents."""


def learning_curves(found: dict[str, Any] | None, name: str) -> Drawing | None:
    """One of `PANELS` against environment steps; None without curves."""
    figure, axes = new_figure(WIDTH, 3.0)
    legend = _draw(axes, found or {}, name)
    return Drawing(figure, legend) if legend else None


def all_curves(found: dict[str, Any]) -> Figure:
    """Those of `PANELS` that this run has agents for, side by side, with their legend."""
    training = dict(_items(found.get("training")))
    names = [name for name, (_, ending) in PANELS.items() if any(key.endswith(ending) for key in training)]
    figure, grid = new_figure(WIDTH * len(names), 4.2, columns=len(names))
    entries: dict[str, tuple[str, str, bool]] = {}
    for axes, name in zip(np.ravel(grid), names, strict=True):
        entries |= {label: (label, tone, dashed) for label, tone, dashed in _draw(axes, found, name)}
    handles = [
        Line2D([], [], color=colour(tone), linestyle="--" if dashed else "-") for _, tone, dashed in entries.values()
    ]
    figure.legend(handles, list(entries), ncols=3, fontsize=8, frameon=False, loc="outside lower center")
    return figure


def _draw(axes: Axes, found: dict[str, Any], name: str) -> list[tuple[str, str, bool]]:
    """Every seed thin, their mean thick, the zero policy dashed; the legend's entries, empty without curves."""
    label, ending = PANELS[name]
    legend = []
    for key, several in _items(found.get("training")):
        if not key.endswith(ending) or not isinstance(several, list):
            continue
        curves = [_curve(one, name) for one in several if isinstance(one, dict)]
        curves = [(steps, values) for steps, values in curves if len(steps) > 1]
        if not curves:
            continue
        tone = _COLOURS.get(key, "other_0")
        for steps, values in curves:
            axes.plot(steps, values, color=colour(tone), linewidth=0.7, alpha=0.55)
        shared = np.linspace(0.0, min(steps[-1] for steps, _ in curves), 60)
        mean = np.mean([np.interp(shared, steps, values) for steps, values in curves], axis=0)
        axes.plot(shared, mean, color=colour(tone), linewidth=2.2)
        legend.append(entry(str(at(found, "rows", key, "label") or key), tone))
    zero = at(found, "curve_of_zero", name)
    if legend and zero is not None:
        axes.axhline(zero, color=INK, linewidth=1.0, linestyle="--")
        legend.append(("zero policy: the paper's start", "ink", True))
    axes.set(xlabel="environment steps", ylabel=label, xlim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    return legend


def _curve(one: dict[str, Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    points = [(at(p, "steps"), at(p, name)) for p in one.get("curve") or [] if at(p, name) is not None]
    rows = np.array(points, dtype=float).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _items(tree: Any) -> list[tuple[str, Any]]:
    return list(tree.items()) if isinstance(tree, dict) else []


def _interval(row: Any, key: str) -> str:
    value, low, high = (at(row, part) for part in (key, "low", "high"))
    return number(value) if value is None or low is None else f"{number(value)} [{number(low)}, {number(high)}]"
