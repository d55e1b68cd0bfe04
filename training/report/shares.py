"""Figures that no line can hide in: starts by budgets of steps as heat maps with their numbers."""

from __future__ import annotations

import math

import numpy as np

from training.cases.set_table import TOLERANCE
from training.cases.start_table import main_of
from training.report.figures import FLOOR
from training.report.starts import short
from training.report.style import INK, WIDTH, Drawing, colour, new_figure
from training.runs.words import small
from training.trials.arrays import BUDGETS, NOT_APPLICABLE, Trials, starts_in

STEPS = (0, 1, 3, 10, 30, 100, 300, 1000)
"""Within which cases are counted as solved."""
FACTORS = (1, 1.5, 2, 4, 8, 16, 64, 256)
"""Of the fewest steps."""


def steps_of(trials: Trials, start: str, method: str = "reduced_flow") -> np.ndarray | None:
    """Iterations to 1e-4 of the cases that a start applies to, infinite where there is no start or 1e-4 is not reached."""
    status = trials.get(f"{method}/{start}/status")
    if status is None or not (status != NOT_APPLICABLE).any():
        return None
    counts = trials[f"{method}/{start}/iterations"].astype(float)
    return np.where(counts < 0, np.inf, counts)[status != NOT_APPLICABLE]


def ecdf(trials: Trials) -> Drawing | None:
    """Share of cases solved to 1e-4 within k accepted steps, a line of numbers per start; None without any."""
    found = {key: counts for key in starts_in(trials) if (counts := steps_of(trials, key)) is not None}
    rows = {key: [float((counts <= most).mean()) for most in STEPS] for key, counts in found.items()}
    return _shares(rows, list(map(str, STEPS)), f"accepted steps to a gap of {small(TOLERANCE)}")


def budget(trials: Trials) -> Drawing | None:
    """Median of the gap that is left after a budget of steps, a line of numbers per start; None without any."""
    rows, texts = {}, {}
    for key in main_of(starts_in(trials)):
        gaps = trials.get(f"reduced_flow/{key}/gap_after")
        if gaps is not None and np.isfinite(gaps).any():
            medians = np.maximum(np.median(gaps[np.isfinite(gaps).all(axis=1)], axis=0), FLOOR)
            rows[key] = (np.log10(medians) / np.log10(FLOOR)).clip(0.0, 1.0).tolist()
            texts[key] = [
                f"< {small(FLOOR)}" if gap <= FLOOR else small(float(f"{gap:.0e}")) for gap in medians.tolist()
            ]
    return _cells(rows, texts, list(map(str, BUDGETS)), "steps allowed")


def profile(sets: list[Trials]) -> Drawing | None:
    """Performance profile over all cases: share solved within a factor of the fewest steps that any start needs.

    The factor is of 1 + steps. Where a start does not exist or does not apply it counts as not solved.
    """
    every = dict.fromkeys(key for trials in sets for key in starts_in(trials))
    keys = [key for key in every if any(steps_of(trials, key) is not None for trials in sets)]
    if not keys:
        return None
    table = np.concatenate([_all_steps(trials, keys) for trials in sets])
    table = table[np.isfinite(table).any(axis=1)]
    if not len(table):
        return None
    ratios = (1 + table) / (1 + table.min(axis=1, keepdims=True))
    rows = {key: [float((ratios[:, k] <= most * (1 + 1e-9)).mean()) for most in FACTORS] for k, key in enumerate(keys)}
    return _shares(rows, list(map(str, FACTORS)), "factor of the fewest 1 + steps")


def _shares(rows: dict[str, list[float]], columns: list[str], label: str) -> Drawing | None:
    return _cells(
        rows,
        {key: [f"{math.floor(100 * share + 1e-9)}" for share in row] for key, row in rows.items()},
        columns,
        f"{label}: cases [%]",
    )


def _cells(rows: dict[str, list[float]], texts: dict[str, list[str]], columns: list[str], label: str) -> Drawing | None:
    """A heat map with its numbers: no line can hide another.

    Args:
        rows: by start, 0 to 1 for every column: how strong its colour is.
        texts: what stands there.
        columns: their headings.
        label: below them.
    """
    if not rows:
        return None
    figure, axes = new_figure(WIDTH, 0.6 + 0.2 * len(rows))
    tint = colour("linear_combination")
    for place, key in enumerate(rows):
        for column, (level, text) in enumerate(zip(rows[key], texts[key], strict=True)):
            axes.fill_between(
                [column - 0.48, column + 0.48], place - 0.46, place + 0.46, color=tint, alpha=0.55 * level, linewidth=0
            )
            axes.text(column, place, text, ha="center", va="center", fontsize=8.5, color=INK)
    axes.set(xlabel=label, xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5))
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), list(map(short, rows)))
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return Drawing(figure)


def _all_steps(trials: Trials, keys: list[str]) -> np.ndarray:
    """(n, len(keys)) iterations of all cases, infinite where there are none."""
    count = len(trials["optimum/objective"])
    out = np.full((count, len(keys)), np.inf)
    for k, key in enumerate(keys):
        counts = trials.get(f"reduced_flow/{key}/iterations")
        if counts is not None:
            out[:, k] = np.where(counts < 0, np.inf, counts)
    return out
