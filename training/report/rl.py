"""Reinforcement learning in a report, from the rl.json of `grasp rl`; a file of another form is shown as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from training.report.model import Fold, Picture, Section, Table, at, flat, present
from training.report.style import INK, WIDTH, Drawing, colour, entry, new_figure
from training.runs.words import number, percent

_COLOURS = {
    "ppo/initial_force": "linear_combination",
    "sac/initial_force": "learned_fixed",
    "ppo/contact_force": "previous_tangent",
    "sac/contact_force": "lagrange",
}
"""Names of `figures.THEME`."""


def rl_section(found: dict[str, Any] | None, pictures: list[Picture]) -> Section | None:
    """Agents beside the paper's, the learned and the previous start on the same held-out episodes; None without a file."""
    if not found:
        return None
    notes = [
        "Soft actor-critic and proximal policy optimisation on FourFingerGrasp-v0, scored by the same evaluator as every other "
        "start. A policy that does nothing is the paper's start: the curves begin there. It need not win.",
        "Agents without solver make no iterations by construction: their held rate, squeeze and drift are what compares.",
    ]
    if found.get("quick"):
        notes.insert(0, "A quick run: too short to say anything about learning.")
    settings = {key: value for key, value in found.items() if key not in ("rows", "training")}
    saved = Table("As saved in rl.json", ("", "value"), [list(line) for line in flat(settings)], words=2)
    blocks = present(
        [_scores(found), *pictures, _training(found), Fold("Settings and versions of these runs", present([saved]))]
    )
    return Section("rl", "Reinforcement learning", notes, blocks)


def _scores(found: dict[str, Any]) -> Table:
    rows = []
    for key, row in _items(found.get("rows")):
        held = f"{number(at(row, 'held'))} of {number(at(row, 'episodes'))}"
        if at(row, "held_low") is not None:
            held += f" [{percent(at(row, 'held_low'))}, {percent(at(row, 'held_high'))}]"
        solver = not key.endswith("contact_force")
        counts = " / ".join(number(at(row, "iterations", part)) for part in ("median", "p95", "p99"))
        rows.append([
            str(row.get("label", key)), number(at(row, "seeds")), held, counts if solver else "no solver",
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
            change = [
                f"{number(at(curve[0], name))} → {number(at(curve[-1], name))}"
                for name in ("median_iterations", "return")
            ]
            label = at(found, "rows", key, "label") or key
            rows.append([label, number(one.get("seed")), number(one.get("steps")), number(one.get("seconds")), *change])
    columns = (
        "agent",
        "seed",
        "environment steps",
        "seconds",
        "median iterations, first → last",
        "return, first → last",
    )
    return Table("Training, every seed", columns, rows)


def learning_curves(found: dict[str, Any] | None, name: str) -> Drawing | None:
    """Iterations or return against environment steps, every seed thin, their mean thick; None without curves."""
    figure, axes = new_figure(WIDTH, 3.0)
    legend = []
    for key, several in _items((found or {}).get("training")):
        if name == "iterations" and key.endswith("contact_force"):
            continue
        curves = [_curve(one, name) for one in several if isinstance(one, dict)] if isinstance(several, list) else []
        curves = [(steps, values) for steps, values in curves if len(steps) > 1]
        if not curves:
            continue
        tone = _COLOURS.get(key, "other_0")
        mark = entry(str(at(found, "rows", key, "label") or key), tone)
        for steps, values in curves:
            axes.plot(steps, values, color=colour(tone), linewidth=0.7, alpha=0.55)
        shared = np.linspace(0.0, min(steps[-1] for steps, _ in curves), 60)
        mean = np.mean([np.interp(shared, steps, values) for steps, values in curves], axis=0)
        axes.plot(shared, mean, color=colour(tone), linewidth=2.2)
        legend.append(mark)
    if not legend:
        return None
    zero = at(found, "curve_of_zero", name)
    if zero is not None:
        axes.axhline(zero, color=INK, linewidth=1.0, linestyle="--")
        legend.append(("zero policy: the paper's start", "ink", True))
    label = "iterations per step, mean" if name == "iterations" else "return of an episode"
    axes.set(xlabel="environment steps", ylabel=label, xlim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    return Drawing(figure, legend)


def _curve(one: dict[str, Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    points = [(at(p, "steps"), at(p, name)) for p in one.get("curve") or [] if at(p, name) is not None]
    rows = np.array(points, dtype=float).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _items(tree: Any) -> list[tuple[str, Any]]:
    return list(tree.items()) if isinstance(tree, dict) else []


def _interval(row: Any, key: str) -> str:
    value, low, high = (at(row, part) for part in (key, "low", "high"))
    return number(value) if value is None or low is None else f"{number(value)} [{number(low)}, {number(high)}]"
