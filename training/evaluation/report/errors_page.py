"""Page of controllers under errors of a real hand, as data."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.compare.errors import REPORT, Choice, choices
from training.evaluation.compare.scenarios import EQUAL, GROUPS, LABELS, RIVALS, ROBUST
from training.evaluation.report import holds_page
from training.evaluation.report.page import INK, LINE, axes
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import Rows, chosen, numbers, pd
from training.evaluation.results.words import number

TITLE = "Controllers under errors of a real hand"
INTRO = (
    "This page compares controllers by how often they hold random objects for 4 s against a random wrench, while sensors, motors and the assumed friction have errors. "
    "The settings of a controller are chosen on some seeds, and the controllers are then compared on other seeds. "
    "All controllers meet the same objects with the same contact points and disturbances, and an episode that cannot start counts as not held. "
    "The words are defined at the end of this page, the columns of the table in run.json."
)
WORDS = {
    "held": holds_page.WORDS["held"],
    "force": "Sum of the measured normal forces, mean over the episodes that began.",
    "margin": "Share of the friction that the optimised forces may use.",
    "preload": "Normal force of each finger that does not count for friction.",
    "chosen": "Of equally many candidates, the one with the smallest force, among those that hold as many episodes of the tuning as the best one but for 2 %. The choice is made for each hand, engine and group of errors.",
    "hardest": "Settings are chosen on the errors that are expected to be the hardest of their group: "
    + "; ".join(
        f"{group.label}: {', '.join(LABELS[case] for case in group.tuned_on)}"
        for group in GROUPS.values()
    )
    + ".",
    RIVALS[
        EQUAL
    ].label: f"Its squeeze is the mean commanded normal force of “{RIVALS[ROBUST].label}” under the same error, on the same episodes.",
    "slide": "Largest distance that a fingertip slid on the object, in all episodes that began.",
    "drift": "Largest distance of the object in an episode from where it was grasped; only for episodes in which it was held.",
    "interval": "95 % Wilson interval of a rate.",
}
_ROBUST = f"part == '{REPORT}' and controller == '{ROBUST}'"
_FOUR_FINGER = f"{_ROBUST} and hand == 'four_finger'"
LEAST_HELD = {
    0.99: ("none",),
    0.95: ("estimated", "delay", "noise", "friction"),
    0.9: ("drift", "gain", "four"),
    0.85: ("five",),
}
"""Least share of the episodes that `ROBUST` holds, and the errors for which it is claimed."""
MOST_FORCE = 21.2
"""A fixed bound [N], about twice the mean force of the default controller without errors."""
CLAIMS = (
    *(
        Claim.of(
            f"optimised forces, {LABELS[case]}: share of the episodes held, least of all hands and engines",
            f"{_ROBUST} and case == '{case}'",
            f"held_mean >= {rate}",
        )
        for rate, cases in LEAST_HELD.items()
        for case in cases
    ),
    Claim.of(
        f"optimised forces, {LABELS['five']}: median slide",
        f"{_ROBUST} and case == 'five'",
        "end_slip_median <= 1 mm",
    ),
    Claim.of(
        "optimised forces against a constant squeeze with the same force, every error: rate minus rate",
        _ROBUST,
        "held_mean >= 0",
        f"part == '{REPORT}' and controller == '{EQUAL}'",
        difference=True,
    ),
    Claim.of(
        "MuJoCo holds what Bullet holds, every error, four-finger hand: rate minus rate",
        f"{_FOUR_FINGER} and engine == 'mujoco'",
        "held_mean within 0.05",
        f"{_FOUR_FINGER} and engine == 'bullet'",
        difference=True,
    ),
    Claim.of(
        "sum of the optimised normal forces under single errors, four-finger hand",
        f"{_FOUR_FINGER} and case not in ('four', 'five')",
        f"normal_force_mean <= {MOST_FORCE} N",
    ),
)


def cell(row: dict[str, Any]) -> str:
    """Return held and all episodes, the force, and the interval of the rate in per cent.

    Example:
        >>> cell({"held_sum": 3.0, "n": 4, "normal_force_mean": 12.14, "held_rate_low": 0.301, "held_rate_high": 0.954})
        '3 of 4 at 12.1 N (30 to 95 %)'
    """
    low, high = (100 * row[f"held_rate_{end}"] for end in ("low", "high"))
    return f"{holds_page.held_cell(row)} ({low:.0f} to {high:.0f} %)"


def compared(hand: str, engine: str, means: Rows) -> Rows:
    """Return the report of a hand in an engine: its rows of the summary, in the order of `GROUPS`."""
    rows = chosen(means, f"part == '{REPORT}' and hand == '{hand}' and engine == '{engine}'")
    order = [case for group in GROUPS.values() for case in group.errors]
    return rows.sort_values("case", key=lambda cases: cases.map(order.index), kind="stable")


def grid(
    rows: Rows, means: Rows, *, hand: str, engine: str, text: Callable[[dict[str, Any]], str]
) -> Rows:
    """Make a table of errors and rivals, with a text for each row of the summary."""
    mine = compared(hand, engine, means)
    mine = mine.assign(text=[text(row) for row in mine.to_dict("records")])
    table = mine.pivot_table(
        index="case", columns="controller", values="text", aggfunc="first", sort=False
    )
    table = table.reindex(columns=[rival for rival in RIVALS if rival in table.columns])
    table = table.fillna("–").rename(columns={rival: RIVALS[rival].label for rival in RIVALS})
    table.insert(0, "error", [LABELS[str(case)] for case in table.index])
    return table.reset_index(drop=True)


def rates_figure(rows: Rows, means: Rows, *, hand: str, engine: str) -> Figure | None:
    """Draw the hold rates of the rivals and their intervals, error by error."""
    mine = compared(hand, engine, means)
    cases = list(dict.fromkeys(mine["case"]))
    figure, panel = axes(1.5 + 0.62 * len(cases))
    colours = ("#2f7fd8", "#e08a1e", "#e0463e", "#8a8a8b", "#5aa469")
    step = 0.8 / len(RIVALS)
    for number_, (rival, about) in enumerate(RIVALS.items()):
        its = mine[mine["controller"] == rival]
        places = np.array([cases.index(case) for case in its["case"]])
        places = places + step * (number_ - 0.5 * (len(RIVALS) - 1))
        rate, low, high = (
            100 * numbers(its, f"held_{end}") for end in ("mean", "rate_low", "rate_high")
        )
        colour = colours[number_ % len(colours)]
        panel.errorbar(
            rate,
            places,
            xerr=(rate - low, high - rate),
            fmt="o",
            markersize=4,
            linewidth=1.4,
            color=colour,
            label=about.label,
            clip_on=False,
        )
    for place in range(1, len(cases)):
        panel.axhline(place - 0.5, color=LINE, linewidth=0.6)
    panel.grid(visible=False, axis="y")
    panel.set_yticks(range(len(cases)), [_wrapped(LABELS[case]) for case in cases], fontsize=8)
    panel.set(xlabel="held [%]", xlim=(0, 100), ylim=(len(cases) - 0.5, -0.5))
    figure.legend(loc="outside upper center", ncols=1, fontsize=8, frameon=False, labelcolor=INK)
    return figure


def _wrapped(text: str) -> str:
    """Break a label into lines, but not before a per cent sign."""
    return textwrap.fill(text.replace(" %", "\N{NO-BREAK SPACE}%"), 27)


def settings_text(settings: dict[str, float]) -> str:
    """Return settings of a controller as text.

    Example:
        >>> settings_text({"friction_margin": 0.75, "preload": 1.0})
        'margin 0.75, preload 1 N'
    """
    units = {"friction_margin": "margin {:g}", "preload": "preload {:g} N", "squeeze": "{:g} N"}
    return ", ".join(units[name].format(value) for name, value in settings.items())


def chosen_settings(rows: Rows, means: Rows) -> Rows:
    """Make a table of the settings that were chosen."""
    picked = {key: choice for key, choice in choices(means).items() if choice.episodes}
    lines = [
        {
            "hand": hand,
            "engine": engine,
            "errors": GROUPS[group].label,
            "controller": RIVALS[rival].label,
            "chosen": settings_text(choice.settings),
            "held in the tuning": _tuned(choice),
        }
        for (hand, engine, group, rival), choice in picked.items()
    ]
    return pd.DataFrame(lines)


def _tuned(choice: Choice) -> str:
    force = "" if choice.force is None else f" at {number(choice.force)} N"
    return f"{choice.held} of {choice.episodes}{force}"


def moved_cell(row: dict[str, Any]) -> str:
    """Return slide, drift [mm] and failed starts.

    Example:
        >>> moved = {"end_slip_median": 0.1, "end_slip_p90": 0.5, "drift_median": 0.2, "drift_p90": 0.6, "drift_max": 1.7}
        >>> moved_cell({**moved, "no_start_sum": 2.0})
        '0.10 / 0.50; 0.20 / 0.60 / 1.70; 2'
    """
    slide, drift = (
        " / ".join(_millimetres(row.get(name)) for name in names)
        for names in (
            ("end_slip_median", "end_slip_p90"),
            ("drift_median", "drift_p90", "drift_max"),
        )
    )
    return f"{slide}; {drift}; {row['no_start_sum']:.0f}"


def _millimetres(value: float | None) -> str:
    return "–" if value is None or np.isnan(value) else f"{value:.2f}"


def failures(rows: Rows, means: Rows) -> Rows:
    """Count the causes of lost episodes of the report, each with its first seed."""
    return holds_page.failures(chosen(rows, f"part == '{REPORT}'"), means)


def held_tables(means: Rows) -> list[tuple[str, str, Any]]:
    """Return a table of the episodes held for each hand and engine."""
    note = "Held of all episodes of the report, mean of the measured normal force, and 95 % interval of the rate."
    return _each("Episodes held", note, partial(grid, text=cell), means)


def _places(means: Rows) -> Iterator[dict[str, str]]:
    """Yield the hands and engines of a run."""
    report: Rows = chosen(means, f"part == '{REPORT}'")
    yield from report[["hand", "engine"]].drop_duplicates().to_dict("records")


def _each(
    title: str, note: str, make: Callable[..., Any], means: Rows
) -> list[tuple[str, str, Any]]:
    return [
        (f"{title}: {place['hand']} in {place['engine']}", note, partial(make, **place))
        for place in _places(means)
    ]


def figures(means: Rows) -> list[tuple[str, str, Any]]:
    """Return a figure for each hand and engine."""
    return _each(
        "Hold rates", "Share of the episodes held, with its 95 % interval.", rates_figure, means
    )


def tables(means: Rows) -> list[tuple[str, str, Any]]:
    """Return tables for each hand and engine, then those of all."""
    note = "Slide: median / 90 %. Drift: median / 90 % / largest. Last: episodes without a start."
    moved = partial(grid, text=moved_cell)
    return [
        *held_tables(means),
        ("Chosen settings", "Chosen in the tuning, on other episodes.", chosen_settings),
        *_each("Slide [mm]; drift [mm]; no start", note, moved, means),
        (
            "Failures",
            "The first seed reproduces such an episode, with the settings in run.json.",
            failures,
        ),
    ]


FIGURES, TABLES = figures, tables
