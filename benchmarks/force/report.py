"""Tables and profiles of the rows of a run."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from training.evaluation.report.page import decades
from training.evaluation.results.statistics import ratio_interval
from training.evaluation.results.table import Rows, numbers, pd
from training.evaluation.results.words import number

CELL = ["objective", "case", "mode"]
"""Columns that define a cell, within which entrants are compared."""
COUNTS = ["solved", "solved_coarse", "proved", "wrong"]
SHIFT = 1.0
"""Shift of the geometric mean [us]."""
PENALTY = 1e5
"""Least time of a failure in the shifted geometric mean [us]."""
POINTS = 200
"""Number of points of a curve."""


def standings(rows: Rows) -> Rows:
    """Return one row for each entrant in each cell and language, the least mean first.

    Returns:
        n, solved_coarse, solved, proved, wrong: numbers of problems; p50, p99, max [us] over the
        solved ones; mean [us]: the geometric mean shifted by `SHIFT` with `PENALTY` for failures;
        p50_ratio and p99_ratio to the best entrant of the cell and language with bootstrap
        intervals (_low, _high); first: the metrics (success, p50, p99) in which no other entrant is
        better, ties included.
    """
    ran = _ran(rows)
    out = []
    groups = [*CELL, "language"]
    for key, cell in ran.groupby(groups, sort=False):
        times = {str(name): _by_problem(runs) for name, runs in cell.groupby("method", sort=False)}
        entrants = _standings(cell)
        most = max(row["solved"] for row in entrants)
        whole = [row for row in entrants if row["solved"] == most]
        for name, percent in (("p50", 50.0), ("p99", 99.0)):
            best = min(whole, key=lambda row, name=name: row[name])["method"] if most else ""
            for row in entrants:
                ratio, low, high = (
                    _ratio(times[row["method"]], times[best], percent)
                    if most and row["solved"]
                    else (np.nan,) * 3
                )
                row |= {f"{name}_ratio": ratio, f"{name}_low": low, f"{name}_high": high}
        for row in entrants:
            first = []
            if row["solved"] == most:
                first = ["success", *(p for p in ("p50", "p99") if row[f"{p}_low"] <= 1.0)]
            out.append(dict(zip(groups, key, strict=True)) | row | {"first": ", ".join(first)})
    order = {column: {v: k for k, v in enumerate(ran[column].unique())} for column in groups}
    return (
        pd.DataFrame(out)
        .sort_values("mean", kind="stable")
        .sort_values(groups, kind="stable", key=lambda column: column.map(order[str(column.name)]))
    )


def lines(rows: Rows, unit: float) -> Iterator[str]:
    """Yield the standings as text, a table for each cell."""
    shown = [
        "division",
        "n",
        *COUNTS,
        "p50",
        "p99",
        "max",
        "mean",
        "units",
        "p50_ratio",
        "many",
        "first",
    ]
    standing_rows = standings(rows).assign(units=lambda table: table["p50"] / unit)
    for key, cell in standing_rows.groupby(CELL, sort=False):
        yield ", ".join(key)
        yield cell.set_index(["language", "method"])[shown].to_string(float_format=number) + "\n"
    control = rows[rows["method"] == "empty"]["microseconds"].median()
    yield f"an empty call: {number(control)} us; a unit: {number(unit)} us, SciPy's SLSQP once from cold"
    yield from _absent(rows)


def answers(rows: Rows) -> Iterator[str]:
    """Yield each entrant's numbers of correct results, its errors, and the tracks it is not in."""
    ran = _ran(rows)
    groups = ran.groupby(["method", "objective", "case", "mode"], sort=False)
    if len(ran):
        yield (
            groups[COUNTS]
            .sum()
            .assign(n=groups.size())
            .sort_index(level="method", sort_remaining=False)
            .to_string()
        )
    failed = ran[ran["status"] == "failed"]
    for method, runs in failed.groupby("method", sort=False):
        errors = runs["detail"].dropna().tolist() if "detail" in runs else []
        sessions = "; ".join(
            f"{case}, session {event}"
            for case, event in runs[["case", "event"]].drop_duplicates().to_numpy()[:6]
        )
        yield f"{method} failed {len(runs)} times ({sessions}){f': {errors[0]}' if errors else ''}"
    yield from _absent(rows)


def beside(rows: Rows, earlier: Rows) -> Rows:
    """Return the medians of two runs by entrant and cell.

    Columns are `before`, `now`, their ratio and its interval, and `tie` if it contains 1.
    """
    out = []
    groups = [*CELL, "language", "method"]
    before = dict(iter(_ran(earlier).groupby(groups)))
    for key, runs in _ran(rows).groupby(groups, sort=False):
        if key in before:
            now = _by_problem(runs)
            then = _by_problem(before[key])
            ratio, low, high = _ratio(now, then, 50.0)
            out.append(
                dict(zip(groups, key, strict=True))
                | {
                    "before": np.nanmedian(list(then.values())),
                    "now": np.nanmedian(list(now.values())),
                    "ratio": ratio,
                    "low": low,
                    "high": high,
                    "tie": low <= 1.0 <= high,
                }
            )
    return pd.DataFrame(out)


def by_track(rows: Rows, objective: str, ours: set[str]) -> Rows:
    """Return p50 / p99 [us] of ours and of the fastest other closed entrant by track and mode."""
    ran = _ran(rows[rows["division"].ne("learned").fillna(True)])
    out = []
    for (case, mode), cell in ran[ran["objective"] == objective].groupby(
        ["case", "mode"], sort=False
    ):
        line = {"track": case, "mode": mode}
        for language in ("C", "Python"):
            entrants = _standings(cell[cell["language"] == language])
            for label, mine in (("ours", True), ("fastest other", False)):
                line[f"{label}, {language}"] = _fastest(
                    [row for row in entrants if (row["method"] in ours) == mine]
                )
        out.append(line)
    return pd.DataFrame(out)


def by_entrant(rows: Rows, descriptions: dict[str, Any]) -> Rows:
    """Return the numbers of solved problems and the notes of each entrant by objective."""
    out = []
    for (objective, method), runs in _ran(rows).groupby(["objective", "method"], sort=False):
        row = _standing(method, runs)
        about = descriptions.get(str(method), {})
        seconds = about.get("training_seconds")
        division = row["division"] + (f", trained {number(seconds)} s" if seconds else "")
        out.append(
            {
                "objective": objective,
                "entrant": method,
                "division": division,
                "solved": f"{row['solved']} of {row['n']}",
                "to 1e-4": row["solved_coarse"],
                "proved": row["proved"],
                "wrong": row["wrong"],
                "tracks": runs["case"].nunique(),
                "settings": about.get("note", ""),
            }
        )
    return pd.DataFrame(out)


def by_contacts(rows: Rows) -> Rows:
    """Return p50 / p99 [us] by number of contacts of the solvers of `sum` on the track `random`."""
    ran = _ran(rows)
    ran = ran[(ran["case"] == "random") & (ran["objective"] == "sum")]
    ran = ran[ran.groupby("method")["solved"].transform("mean") > 0.9]
    ran = ran[ran["solved"].astype(bool)]
    cells = ran.groupby(["language", "method", "event"], sort=False)
    table: Rows = pd.Series(
        {key: pair_of(numbers(runs, "microseconds")) for key, runs in cells}
    ).unstack()
    order = ran.groupby("method")["microseconds"].median()
    counts = [event for event in ("3", "4", "5", "6", "8", "12", "16") if event in table.columns]
    return (
        table[counts]
        .rename(columns=lambda n: f"N = {n}")
        .reset_index(names=["called from", "entrant"])
        .sort_values("entrant", key=lambda names: names.map(order), kind="stable")
        .sort_values("called from", kind="stable")
    )


def profiles(rows: Rows) -> Figure:
    """Draw the profiles of Dolan and More (2002) in time and in iterations; see `profile`."""
    ran = _ran(rows)
    objectives = list(ran["objective"].unique())
    figure = Figure(figsize=(9.0, 3.6 * max(len(objectives), 1)), layout="constrained")
    axes = figure.subplots(max(len(objectives), 1), 2, squeeze=False, sharey=True)
    colours = {name: colormaps["tab20"](k % 20) for k, name in enumerate(ran["method"].unique())}
    for row, objective in zip(axes, objectives, strict=False):
        runs = ran[ran["objective"] == objective]
        for ax, column, most in zip(row, ("microseconds", "iterations"), (4, 2), strict=True):
            within = np.geomspace(1.0, 10.0**most, POINTS)
            for language, called in runs.groupby("language", sort=False):
                style, suffix = ("--", " (C)") if language == "C" else ("-", "")
                compared = called if column == "microseconds" else runs
                for name, (factor, share) in profile(compared, column).items():
                    if name in called["method"].unique():
                        index = np.searchsorted(factor, within * (1.0 + 1e-12), side="right")
                        reached = np.append(0.0, share)[index]
                        label = f"{name}{suffix}"
                        ax.plot(within, reached, style, label=label, color=colours[name])
            ax.set(
                xscale="log",
                xlim=(1.0, within[-1]),
                ylim=(0.0, 1.02),
                title=f"{objective}: {column}",
            )
            decades(ax.xaxis, 0, most)
            callers = " in C or from Python" if column == "microseconds" else ""
            ax.set_xlabel(f"factor of the best{callers}")
        row[0].set_ylabel("share of the problems solved")
        row[1].legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def profile(rows: Rows, column: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return by entrant factors of the best and the share of all problems solved within them."""
    ran = _ran(rows)
    if column not in ran:
        return {}
    keys = [*CELL, "event", "problem"]
    cost = np.where(ran["solved"].astype(bool), numbers(ran, column), np.nan)
    table = ran.assign(cost=cost).pivot_table(
        index=keys, columns="method", values="cost", dropna=False, observed=True
    )
    if column == "iterations":
        table = table.clip(lower=1.0)
    factors = table.div(table.min(axis=1), axis=0)
    total = len(ran[keys].drop_duplicates())
    curves = {}
    for name in factors.columns:
        solved = np.sort(factors[name].dropna().to_numpy())
        if len(solved):
            curves[str(name)] = solved, np.arange(1, len(solved) + 1) / total
    return curves


def _ran(rows: Rows) -> Rows:
    """Return the rows of entrants that took part."""
    return rows[rows["microseconds"].notna() & (rows["method"] != "empty")]


def _absent(rows: Rows) -> Iterator[str]:
    if "reason" in rows:
        absent = rows[rows["reason"].notna()].groupby(["method", "reason"], sort=False)
        for (name, reason), cells in absent:
            yield f"{name} did not enter {', '.join(cells['case'].unique())}: {reason}"


def _fastest(entrants: list[dict[str, Any]]) -> str:
    """Return p50 / p99 and name of the fastest of those that solve most problems."""
    most = max((row["solved"] for row in entrants), default=0)
    if not most:
        return "–"
    row = min((row for row in entrants if row["solved"] == most), key=lambda row: row["p50"])
    failed = "" if row["solved"] == row["n"] else f", {row['solved']} of {row['n']}"
    return f"{number(row['p50'])} / {number(row['p99'])} ({row['method']}{failed})"


def pair_of(times: np.ndarray) -> str:
    """Return median / 99th percentile of times [us]."""
    return " / ".join(number(float(time)) for time in np.percentile(times, [50.0, 99.0]))


def _standings(cell: Rows) -> list[dict[str, Any]]:
    return [_standing(name, runs) for name, runs in cell.groupby("method", sort=False)]


def _standing(name: Any, runs: Rows) -> dict[str, Any]:
    success = runs["solved"].astype(bool).to_numpy()
    times = numbers(runs, "microseconds")
    solved = times[success]
    penalised = np.where(success, times, np.maximum(times, PENALTY))
    mean = np.exp(np.log(penalised + SHIFT).mean()) - SHIFT
    p50, p99, most = np.percentile(solved, [50.0, 99.0, 100.0]) if len(solved) else (np.nan,) * 3
    many = numbers(runs, "many_microseconds") if "many_microseconds" in runs else np.array([np.nan])
    return {
        "many": float(np.nanmedian(many)) if np.isfinite(many).any() else np.nan,
        "method": str(name),
        "division": runs["division"].iloc[0],
        "n": len(runs),
        **{column: int(runs[column].sum()) for column in COUNTS},
        "p50": p50,
        "p99": p99,
        "max": most,
        "mean": mean,
    }


def _by_problem(runs: Rows) -> dict[Any, float]:
    """Return the times of the solved problems."""
    solved = runs[runs["solved"].astype(bool)]
    keys = zip(solved["event"], solved["problem"], strict=True)
    return dict(zip(keys, numbers(solved, "microseconds"), strict=True))


def _ratio(
    mine: dict[Any, float], other: dict[Any, float], percent: float
) -> tuple[float, float, float]:
    """Return the ratio of percentiles where both solve, with its paired bootstrap interval."""
    both = [key for key in mine if key in other]
    if not both:
        return np.nan, np.nan, np.nan
    pair = np.array([[mine[key] for key in both], [other[key] for key in both]])
    return ratio_interval(*pair, of=partial(np.percentile, q=percent))
