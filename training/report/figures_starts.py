"""Figures that compare starts, from saved trials: convergence fans, ECDF, gap after a budget, performance profile."""

from __future__ import annotations

import numpy as np

from training.cases.set_table import TOLERANCE
from training.cases.start_table import LABELS
from training.report.starts import MAIN, short
from training.report.style import INK, WIDTH, Drawing, decades, entry, line_style, new_figure
from training.trials.arrays import BUDGETS, Trials

FLOOR = 1e-7
"""Gaps below are drawn there."""
_NO_START, _SKIPPED = 3, 4
_FAN = ("linear_combination", "previous_tangent", "network", "learned_any", "learned_previous", "learned_fitted")
_FAN_MORE = ("basis_tangent", "nearest_tangent")
"""Where the others are few."""


def fan(trials: Trials, starts: tuple[str, ...] = _FAN) -> Drawing | None:
    """Median and p10 to p90 of the gap after k accepted steps of the reduced flow, per start; None without traces."""
    found = _traces(trials, starts)
    if len(found) < 3:
        found |= _traces(trials, _FAN_MORE)
    if not found:
        return None
    figure, axes = new_figure(WIDTH, 3.2)
    last = 8
    for key, rows in found.items():
        low, middle, high = np.percentile(rows, [10, 50, 90], axis=0)
        reached = np.flatnonzero(high <= 0.1 * TOLERANCE)
        last = max(last, int(reached[0]) if len(reached) else rows.shape[1] - 1)
        steps = _spread(rows.shape[1])
        style = line_style(key)
        if len(rows) > 1:
            axes.fill_between(1 + steps, low[steps], high[steps], color=style["color"], alpha=0.13, linewidth=0)
        axes.plot(1 + steps, middle[steps], **style)
    axes.axhline(TOLERANCE, color=INK, linewidth=0.8, linestyle=":")
    axes.set(
        xscale="log", yscale="log", xlabel="1 + accepted steps", ylabel="relative gap of Phi", xlim=(1, 1.15 * last + 1),
        ylim=(0.5 * FLOOR, None),
    )  # fmt: skip
    decades(axes.xaxis)
    decades(axes.yaxis)
    return Drawing(figure, [entry(short(key), key) for key in found])


def _traces(trials: Trials, starts: tuple[str, ...]) -> dict[str, np.ndarray]:
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


def steps_of(trials: Trials, start: str, method: str = "reduced_flow") -> np.ndarray | None:
    """Iterations to 1e-4 of the cases that a start applies to, infinite where there is no start or 1e-4 is not reached."""
    status = trials.get(f"{method}/{start}/status")
    if status is None or not (status != _SKIPPED).any():
        return None
    counts = trials[f"{method}/{start}/iterations"].astype(float)
    return np.where(counts < 0, np.inf, counts)[status != _SKIPPED]


def ecdf(trials: Trials) -> Drawing | None:
    """Share of cases solved to 1e-4 within k accepted steps, every start; None without any."""
    figure, axes = new_figure(WIDTH, 3.2)
    found = {
        key: counts for key in LABELS if (counts := steps_of(trials, key)) is not None and np.isfinite(counts).any()
    }
    end = 1 + max((counts[np.isfinite(counts)].max() for counts in found.values()), default=1.0)
    for key, counts in found.items():
        levels, many = np.unique(counts[np.isfinite(counts)], return_counts=True)
        share = np.cumsum(many) / len(counts)
        if len(levels) > 150:
            keep = np.unique(np.searchsorted(share, np.linspace(0, share[-1], 150)).clip(max=len(levels) - 1))
            levels, share = levels[keep], share[keep]
        first = share[0] * (levels[0] == 0)
        axes.step(np.r_[1, levels + 1, 1.1 * end], np.r_[first, share, share[-1]], where="post", **line_style(key))
    axes.set(xscale="log", xlabel="1 + accepted steps to a gap of 1e-4", ylabel="share of cases", ylim=(0, 1.02))
    axes.set_xlim(0.95, 1.1 * end)
    decades(axes.xaxis)
    return Drawing(figure, [entry(short(key), key) for key in found]) if found else None


def budget(trials: Trials, starts: tuple[str, ...] = MAIN) -> Drawing | None:
    """Median (line) and p95 (dots) of the gap that is left after a budget of steps; None without any."""
    figure, axes = new_figure(WIDTH, 3.2)
    legend = []
    for key in starts:
        rows = trials.get(f"reduced_flow/{key}/gap_after")
        if rows is None or not np.isfinite(rows).any():
            continue
        rows = np.maximum(rows[np.isfinite(rows).all(axis=1)], FLOOR)
        style = line_style(key)
        axes.plot(range(len(BUDGETS)), np.median(rows, axis=0), marker="o", markersize=3.5, **style)
        axes.plot(
            range(len(BUDGETS)), np.percentile(rows, 95, axis=0), linestyle=":", marker="^", markersize=3,
            linewidth=0.8, color=style["color"],
        )  # fmt: skip
        legend.append(entry(short(key), key))
    axes.axhline(TOLERANCE, color=INK, linewidth=0.8, linestyle=":")
    axes.set(yscale="log", xlabel="steps allowed", ylabel="relative gap of Phi", ylim=(0.5 * FLOOR, None))
    axes.set_xticks(range(len(BUDGETS)), [str(count) for count in BUDGETS])
    decades(axes.yaxis)
    return Drawing(figure, legend) if legend else None


def profile(sets: list[Trials]) -> Drawing | None:
    """Performance profile over all cases: share solved within a factor of the fewest steps that any start needs.

    The factor is of 1 + steps. Where a start does not exist or does not apply it counts as not solved.
    """
    keys = [key for key in LABELS if any(steps_of(trials, key) is not None for trials in sets)]
    if not keys:
        return None
    table = np.concatenate([_all_steps(trials, keys) for trials in sets])
    table = table[np.isfinite(table).any(axis=1)]
    if not len(table):
        return None
    ratios = (1 + table) / (1 + table.min(axis=1, keepdims=True))
    figure, axes = new_figure(WIDTH, 3.2)
    legend = []
    grid = np.geomspace(1, 1000, 120)
    for k, key in enumerate(keys):
        share = (ratios[:, k, None] <= grid * (1 + 1e-9)).mean(axis=0)
        axes.step(grid, share, where="post", **line_style(key))
        legend.append(entry(short(key), key))
    axes.set(
        xscale="log", xlabel="factor of the fewest 1 + steps", ylabel="share of cases", ylim=(0, 1.02), xlim=(1, 1000)
    )
    decades(axes.xaxis)
    return Drawing(figure, legend) if legend else None


def _all_steps(trials: Trials, keys: list[str]) -> np.ndarray:
    """(n, len(keys)) iterations of all cases, infinite where there are none."""
    count = len(trials["optimum/objective"])
    out = np.full((count, len(keys)), np.inf)
    for k, key in enumerate(keys):
        counts = trials.get(f"reduced_flow/{key}/iterations")
        if counts is not None:
            out[:, k] = np.where(counts < 0, np.inf, counts)
    return out
