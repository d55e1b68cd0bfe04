"""The first screen of a report: what was found, in sentences and one chart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from training.cases.set_table import TOLERANCE
from training.cases.start_table import given_in, row_of
from training.report.glossary import COMPARISON, glossary
from training.report.page import Picture, Section, at
from training.report.starts import pair, set_label, short, starts_of
from training.report.style import INK, WIDTH, Drawing, colour, decades, new_figure, tones
from training.runs.words import number, small
from training.trials.arrays import METHODS

SHOWN = ("linear_combination", "basis_newton", "previous_tangent", "network", "learned_fixed")
"""The paper's start, the control with as many plain Newton steps, and what is compared with them; given starts follow."""
NAMES = {"reduced_flow": "flow", "newton": "Newton"}
MARKS = {"reduced_flow": ("o", 5.5, 2.6, -0.2), "newton": ("D", 4.5, 1.1, 0.2)}
"""Of a method: marker, its size, the width of the whisker [pt], and where it stands beside the start's line."""
ROOM = 0.36
"""Part of the chart's width for the numbers beside the whiskers."""


def found_section(
    found: Sequence[str], pictures: Sequence[Picture], terms: tuple[str, ...], notes: Sequence[str] = ()
) -> Section | None:
    """What was found; None where a run found nothing."""
    if not found:
        return None
    return Section("found", "What was found", notes, [*pictures, glossary(terms)], lead=found)


def comparison_section(metrics: dict[str, Any], pictures: Sequence[Picture]) -> Section | None:
    """Of the starts."""
    return found_section(metrics.get("found") or [], pictures, COMPARISON)


def charts(metrics: dict[str, Any]) -> Iterator[tuple[str, str, str, str, Drawing | None]]:
    """(name, title, caption, alt, drawing) of the two halves: iterations, and microseconds of the whole call."""
    keys = [key for key in (*SHOWN, *given_in(starts_of(metrics))) if key in starts_of(metrics)]
    lacking = {key for key in keys if at(metrics, "starts", METHODS[0], "ball", key, "no_start")}
    compiled = {key for key in keys if row_of(key).compiled or at(metrics, "run", "given", key, "compiled")}
    handed = {*keys} - compiled - {*(at(metrics, "run", "models") or {})}
    counted = {key: {m: at(metrics, "starts", m, "ball", key, "iterations") for m in METHODS} for key in keys}
    timed = {key: {m: at(metrics, "timing", "total", m, key, "best") for m in METHODS} for key in keys}
    what = "Dot: median, whisker: p99; the numbers are these."
    absent = " †: no start on a part of the cases, of which no number here speaks." if lacking else ""
    star = " *: a start made in Python and handed over, which takes tens of microseconds by itself." if handed else ""
    marks = {key: "†" * (key in lacking) for key in keys}
    chart = _chart(counted, metrics, "iterations", marks)
    cases = f"{set_label(metrics, 'ball')}, to a gap of {small(TOLERANCE)}"
    yield "found-iterations", "Iterations", f"{what} Cases: {cases}.{absent}", _alt(counted), chart
    marks = {key: "*" * (key in handed) + mark for key, mark in marks.items()}
    chart = _chart(timed, metrics, "microseconds of the whole call", marks)
    repeats = at(metrics, "timing", "repeats")
    repeats = f"best of {number(repeats)}" if repeats != 1 else "called once"
    repeats += f" on {number(at(metrics, 'timing', 'wrenches'))} wrenches of the held-out ball"
    text = f"The whole call from Python, to a certified gap of {small(TOLERANCE)}, {repeats}.{star}"
    yield "found-microseconds", "Microseconds", text, _alt(timed), chart


def _alt(rows: dict[str, dict[str, Any]]) -> str:
    """The chart in words: it is small enough."""
    told = [
        f"{short(key)}, {NAMES[method]}: {_text(spread, counts=False)}"
        for key, row in rows.items() for method, spread in row.items() if at(spread, "median") is not None
    ]  # fmt: skip
    return f"Median / p99. {'; '.join(told)}."


def _text(spread: dict[str, Any], counts: bool) -> str:
    return pair(spread) if counts else f"{number(spread['median'])} / {number(spread['p99'])}"


def _chart(
    rows: dict[str, dict[str, Any]], metrics: dict[str, Any], label: str, marks: dict[str, str]
) -> Drawing | None:
    """A line per start, the flow above and Newton below, their numbers at the ends of the whiskers."""
    ends = [spread["p99"] for row in rows.values() for spread in row.values() if at(spread, "median") is not None]
    ends += [spread["median"] for row in rows.values() for spread in row.values() if at(spread, "median") is not None]
    if not ends:
        return None
    tone, counts = tones(starts_of(metrics)), label == "iterations"
    figure, axes = new_figure(WIDTH, 0.62 + 0.5 * len(rows))
    if counts:
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.5)
        axes.set_xlim(-0.35, (max(ends) + 2.0) ** (1.0 / (1.0 - ROOM)))
    else:
        low, high = 0.8 * min(ends), 1.2 * max(ends)
        axes.set_xscale("log")
        axes.set_xlim(low, low * (high / low) ** (1.0 / (1.0 - ROOM)))
    for place, (key, row) in enumerate(rows.items()):
        tint, found = colour(tone[key]), {m: spread for m, spread in row.items() if at(spread, "median") is not None}
        if not found:
            axes.annotate(
                "no start", (0.02, place), xycoords=("axes fraction", "data"), va="center", fontsize=8.5, color=INK
            )
        for method, spread in found.items():
            marker, size, width, off = MARKS[method]
            axes.plot(
                [spread["median"], spread["p99"]], [place + off] * 2, color=tint, linewidth=width, solid_capstyle="butt"
            )
            axes.plot([spread["p99"]], [place + off], marker="|", markersize=7, color=tint)
            axes.plot([spread["median"]], [place + off], marker=marker, markersize=size, color=tint)
            axes.annotate(
                f"{NAMES[method]} {_text(spread, counts)}", (max(spread["p99"], spread["median"]), place + off), (6, 0),
                textcoords="offset points", va="center", fontsize=8.5, color=INK,
            )  # fmt: skip
    axes.set(xlabel=label, ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(range(len(rows)), [short(key) + marks[key] for key in rows])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    decades(axes.xaxis)
    if counts:
        axes.set_xticks([0.0, *(10.0**k for k in range(int(np.log10(max(ends) + 2.0)) + 1))])
    return Drawing(figure)
