"""Pages of hold rates (controllers, hands, engines), as data."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.compare.scenarios import (
    BOTH,
    CONTROLLER_LABELS,
    LABELS,
)
from training.evaluation.report.page import axes
from training.evaluation.results.claims import Claim
from training.evaluation.results.columns import KEYS
from training.evaluation.results.table import Rows, chosen, pd
from training.evaluation.results.words import number

TITLE = "Hold rates of simulated hands"
INTRO = (
    "This page compares hands, controllers and physics engines by how often they hold an object to the end of an episode. "
    "All of them play the same seeds, with the same objects and disturbances; an episode that cannot start counts as not held. "
    "The words are defined at the end of this page, the columns of the table in run.json."
)
WORDS = {
    "held": "The object was not dropped and did not move by more than the task allows, to the end of the episode. No fingertip slid on it by more than 3 mm or penetrated it by more than 0.5 mm, and links other than fingertips never pushed it with more than 10 % of the load.",
    "drift": "Largest distance of the object in an episode from where it was grasped; only for episodes in which it was held.",
    "squeeze": "Sum of the normal forces.",
    "interval": "95 % Wilson interval of a rate.",
}
TARGET_RATE = 0.99
_PAPER = "controller == 'paper'"
CLAIMS = {
    "env": (
        Claim.of(
            "the paper's pipeline holds random objects against a random wrench for 4 s",
            f"case == 'objects' and {_PAPER}",
            f"held_mean >= {TARGET_RATE}",
        ),
        Claim.of(
            "the paper's pipeline holds random objects in six directions",
            f"case == 'six_directions' and {_PAPER}",
            f"held_mean >= {TARGET_RATE}",
        ),
        Claim.of(
            "random objects that were held: mean of the largest drift",
            f"case == 'objects' and {_PAPER}",
            "drift_mean < 1 mm",
        ),
        Claim.of(
            "W_ext(t) x 0.25 on the 0.1 m cuboid is held",
            f"case == 'path_0.25' and {_PAPER}",
            "held_mean >= 1",
        ),
        Claim.of(
            "W_ext(t) x 0.25 on the 0.1 m cuboid: drift",
            f"case == 'path_0.25' and {_PAPER}",
            "drift_max < 0.1 mm",
        ),
    ),
    "transfer": tuple(
        Claim.of(
            f"MuJoCo holds what Bullet holds: rate minus rate, {LABELS[case]}",
            f"case == '{case}' and engine == 'mujoco'",
            "held_mean within 0.05",
            f"case == '{case}' and engine == 'bullet'",
            difference=True,
        )
        for case in ("objects", "estimated", "weak")
    ),
    "soft": tuple(
        Claim.of(
            f"{LABELS['soft']}: share held in {engine}",
            f"case == 'soft' and engine == '{engine}'",
            "held_mean >= 1",
        )
        for engine in BOTH
    ),
}


def held_cell(row: dict[str, Any]) -> str:
    """Return the held and the total number of episodes, and the squeeze.

    Example:
        >>> held_cell({"held_sum": 3.0, "n": 4, "normal_force_mean": 12.14})
        '3 of 4 at 12.1 N'
    """
    force = row.get("normal_force_mean", np.nan)
    held = f"{row['held_sum']:.0f} of {row['n']}"
    return f"{held} at {number(force)} N" if np.isfinite(force) else held


def names_of(row: dict[str, Any]) -> str:
    """Return the keys of a row besides its case, in words."""
    keys = ("hand", "object", "engine", "controller", "start")
    values = [row[key] for key in keys if key in row and not pd.isna(row[key])]
    return ", ".join(CONTROLLER_LABELS.get(str(value), str(value)) for value in values)


def arranged(means: Rows) -> tuple[Rows, str, list[str]]:
    """Return the rows to show, the key of a grid's columns, and the keys of its rows."""
    rows: Rows = (
        means[means["held_mean"].notna()] if "held_mean" in means.columns else means.iloc[:0]
    )
    varied = [
        key
        for key in ("controller", "start", "engine", "hand", "object")
        if key in rows.columns and rows[key].nunique() > 1
    ]
    across = next((key for key in varied if key != "object"), "engine")
    down = [key for key in ("hand", "object") if key in varied and key != across]
    return rows, across, [*down, "case"]


def grid(rows: Rows, means: Rows) -> Rows:
    """Make a grid of episodes held and squeeze, by scenario and controller, start or engine."""
    held, across, down = arranged(means)
    if held.empty:
        return held
    held = held.assign(text=[held_cell(row) for row in held.to_dict("records")])
    table = held.pivot_table(index=down, columns=across, values="text", aggfunc="first", sort=False)
    table = table.reindex(columns=held[across].unique()).fillna("–")
    table.columns = [CONTROLLER_LABELS.get(name, str(name)) for name in table.columns]
    table = table.reset_index().rename(columns={"case": "held"})
    return table.assign(held=[LABELS[case] for case in table["held"]])


def rates_figure(rows: Rows, means: Rows) -> Figure | None:
    """Draw hold rates in per cent as a heat map, arranged as `grid`."""
    held, across, down = arranged(means)
    if held.empty:
        return None
    table, low, high = (
        held.pivot(index=down, columns=across, values=name).reindex(columns=held[across].unique())
        for name in ("held_mean", "held_rate_low", "held_rate_high")
    )
    figure, panel = axes(1.3 + 0.42 * len(table))
    panel.grid(visible=False)
    rates = table.to_numpy(np.float64)
    panel.imshow(rates, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto", alpha=0.75)
    for (row, column), rate in np.ndenumerate(rates):
        if np.isfinite(rate):
            ends = (f"{100 * end.iloc[row, column]:.0f}" for end in (low, high))
            text = f"{100 * rate:.0f}\n{' to '.join(ends)}"
            panel.text(column, row, text, ha="center", va="center", fontsize=8, linespacing=0.95)
    names = [", ".join(name) if isinstance(name, tuple) else name for name in table.index]
    names = [name.removeprefix("hold_").replace("_", " ") for name in names]
    columns = list(table.columns)
    panel.set_xticks(range(len(columns)), columns, rotation=40, ha="right", fontsize=8)
    panel.set_yticks(range(len(names)), names, fontsize=8)
    return figure


FIGURES = (
    (
        "Hold rates",
        "Per cent of the episodes that were held, with its 95 % interval (Wilson).",
        rates_figure,
    ),
)


def rates(rows: Rows, means: Rows) -> Rows:
    """Make a table of rates with intervals, drift and squeeze; the lowest rate first."""
    further = {
        "drift, mean [mm]": "drift_mean",
        "largest [mm]": "drift_max",
        "iterations": "iterations_median",
        "force error [N]": "force_error_mean",
        "least torque margin [N m]": "torque_margin_min",
        "redrawn": "redrawn_sum",
    }
    further = {name: column for name, column in further.items() if column in means.columns}
    table = [
        {
            "scenario": LABELS.get(row["case"], row["case"]),
            "with": names_of(row),
            "held": held_cell(row),
            "interval, %": f"{100 * row['held_rate_low']:.1f} to {100 * row['held_rate_high']:.1f}",
            **{name: row[column] for name, column in further.items()},
        }
        for row in means.sort_values("held_mean", kind="stable").to_dict("records")
    ]
    return pd.DataFrame(table)


def failures(rows: Rows, means: Rows) -> Rows:
    """Count the causes of episodes that were not held, each with its first seed."""
    lost = chosen(rows, "held == False")
    if lost.empty:
        return lost
    keys = [key for key in (*KEYS, "failure") if key in lost.columns]
    lost = lost.assign(detail=lost.get("detail", pd.Series("", lost.index)))
    columns = {
        "count": ("seed", "size"),
        "first seed": ("seed", "first"),
        "detail": ("detail", "first"),
    }
    table = lost.groupby(keys, sort=False, dropna=False).agg(**columns).reset_index()
    table["detail"] = table["detail"].fillna("").str.slice(0, 160)
    return table.sort_values("count", ascending=False).dropna(axis=1, how="all")


TABLES = (
    (
        "Episodes held",
        "Held of all, and the mean of the measured normal force.",
        grid,
    ),
    (
        "Hold rates, the lowest first",
        "Episodes held, and the mean of the measured normal force.",
        rates,
    ),
    ("Failures", "The first seed reproduces such an episode.", failures),
)
