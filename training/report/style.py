"""The house style of figures: colours for light and dark, one width that a phone can read, SVG in the page and beside it."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from training.cases.start_table import GIVEN_COLOURS, STARTS, given_in
from training.runs.words import small

INK, LINE = "#000000", "#d5d8dd"
THEME: dict[str, tuple[str, str]] = {
    **{key: row.colours for key, row in STARTS.items()},
    **{f"given_{k}": colours for k, colours in enumerate(GIVEN_COLOURS)},
    "finger_0": ("#b3261f", "#ff7469"),
    "finger_1": ("#1f5fa9", "#4f9df1"),
    "finger_2": ("#946300", "#e0b040"),
    "finger_3": ("#1e7a3f", "#4fc47b"),
    "other_0": ("#7a4fa3", "#b794e0"),
    "other_1": ("#5b5b5c", "#b0b0b1"),
    "other_2": ("#0e7c87", "#4fd0dd"),
}
"""Colours on a light and on a dark page, each used once: the SVG has them as CSS variables --c-<name>."""
COLOURS = {name: light for name, (light, _) in THEME.items()}
DASHED = frozenset(key for key in THEME if key.startswith("given_") or (key in STARTS and STARTS[key].dashed))
WIDTH = 4.6
"""[in] of a figure: 331 points, so that its text is 10 pixels high on a phone of 360 and 13 in a column of a page."""
_STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 10,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "axes.linewidth": 0.8,
    "lines.linewidth": 1.4,
    "figure.dpi": 130,
    "svg.fonttype": "none",
    "svg.hashsalt": "grasp",
    "text.parse_math": False,
}


@dataclass(frozen=True)
class Drawing:
    """A figure that has its legend outside.

    Attributes:
        figure: to be closed when it has been saved.
        legend: (label, name in `THEME` or "ink", dashed) of every line.
    """

    figure: Figure
    legend: Sequence[tuple[str, str, bool]] = field(default=())


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, *, share: bool = True, share_all: bool = False
) -> tuple[Figure, Any]:
    """A figure of the house style, size in inches, and its axes; rows share their x axis unless told otherwise, or all share both."""
    with rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        axes = figure.subplots(rows, columns, sharex=share_all or (rows > 1 and share), sharey=share_all)
    for axis in np.ravel(axes):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color=LINE, linewidth=0.6)
        axis.set_axisbelow(True)
    return figure, axes


def close(figure: Figure) -> None:
    """Frees a figure."""
    figure.clear()


def colour(name: str) -> str:
    """The light colour of a name in `THEME`; an unknown name has a grey."""
    return INK if name == "ink" else COLOURS.get(name, COLOURS["other_1"])


def tones(starts: Iterable[str]) -> dict[str, str]:
    """The name in `THEME` of every start of a run, in its order; those that it was given have the reserved ones in turn.

    Example:
        >>> tones(["lagrange", "mine", "yours"])
        {'lagrange': 'lagrange', 'mine': 'given_0', 'yours': 'given_1'}
    """
    starts = list(starts)
    given = {key: f"given_{k % len(GIVEN_COLOURS)}" for k, key in enumerate(given_in(starts))}
    return {key: given.get(key, key) for key in starts}


def line_style(name: str) -> dict[str, Any]:
    """How a start's line is drawn."""
    return {
        "color": colour(name),
        "linestyle": (0, (3, 1.6)) if name in DASHED else "-",
        "linewidth": 2.0 if name.startswith(("learned", "network", "given")) else 1.3,
        "zorder": 3 if name.startswith(("learned", "network", "given")) else 2,
    }


def entry(label: str, name: str) -> tuple[str, str, bool]:
    """A line of the legend; a name without a colour of its own has that of `colour`."""
    return label, name if name in THEME or name == "ink" else "other_1", name in DASHED


def decades(axis: Any) -> None:
    """Labels a logarithmic axis (axes.xaxis or axes.yaxis) at its decades, a short one at 1, 2, 5 too, without mathematics."""
    low, high = sorted(axis.get_view_interval())
    if low > 0 and high < 200 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(lambda value, place: small(value))
    axis.set_minor_locator(NullLocator())


def svg(drawing: Drawing, key: str, alt: str) -> str:
    """The figure as SVG for the page: text as text, colours as CSS variables, names that no other figure uses."""
    out = io.StringIO()
    with rc_context(_STYLE):
        drawing.figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    box = re.search(r'viewBox="[^"]*"', text)
    assert box is not None
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {box[0]} role="img" aria-label="{html.escape(alt)}">'
    text = head + text[text.index(">") + 1 :]
    used = set(re.findall(r'"#([^"]+)"|url\(#([^)]+)\)', text))
    names = {first or second for first, second in used}
    text = re.sub(r' id="([^"]+)"', lambda m: f' id="{key}-{m[1]}"' if m[1] in names else "", text)
    text = re.sub(r'"#([^"]+)"', rf'"#{key}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{key}-\1)", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    variables = {INK: "--ink", LINE: "--line", **{light: f"--c-{name}" for name, light in COLOURS.items()}}
    text = re.sub(r"#[0-9a-f]{6}\b(?=[;\"])", lambda m: f"var({variables[m[0]]})" if m[0] in variables else m[0], text)
    text = re.sub(r"(\d+\.\d{2})\d+", r"\1", text)
    return re.sub(r">\s+<", "><", text)


def standalone(page: str, legend: Sequence[tuple[str, str, bool]]) -> str:
    """The SVG of a page as a file of its own: with its colours for light and dark, a background, and its legend below."""
    head, _, body = page.partition(">")
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', head)
    assert box is not None
    width, height = float(box[1]), float(box[2])
    lines = []
    for k, (label, name, dashed) in enumerate(legend):
        x, y = 8 + 0.5 * width * (k % 2) * (len(legend) > 1), height + 10 + 13 * (k // 2)
        dash = ' stroke-dasharray="5 3"' if dashed else ""
        tint = "--ink" if name == "ink" else f"--c-{name}"
        lines.append(f'<path d="M{x:.0f} {y:.0f}h18" style="stroke: var({tint})" stroke-width="2.5"{dash}/>')
        lines.append(f'<text x="{x + 24:.0f}" y="{y + 3:.0f}" style="font-size: 8px">{html.escape(label)}</text>')
    tall = height + (13 * ((len(legend) + 1) // 2) + 8 if legend else 0)
    head = head.replace(box[0], f'viewBox="0 0 {width:.0f} {tall:.0f}" width="{1.8 * width:.0f}"')
    style = (
        f":root {{ --ink: #1b1b1b; --line: #d5d8dd; --paper: #fff; {variables(False)} }} "
        f"@media (prefers-color-scheme: dark) {{ :root {{ --ink: #e8e8e8; --line: #3a4049; --paper: #15171a; {variables(True)} }} }} "
        "text { fill: var(--ink); font-family: system-ui, sans-serif; }"
    )
    back = '<rect width="100%" height="100%" style="fill: var(--paper)"/>'
    return f"{head}><style>{style}</style>{back}{''.join(lines)}{body}"


def variables(dark: bool) -> str:
    """The colours as CSS declarations."""
    return " ".join(f"--c-{name}: {pair[dark]};" for name, pair in THEME.items())
