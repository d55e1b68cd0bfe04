"""Pages from tables: report.html of any run folder, and the layout of the comparison of two runs."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib import rc_context
from matplotlib.figure import Figure

from training.evaluation.results.claims import VERDICTS, Claim, Judged, judge
from training.evaluation.results.run import Run, understood
from training.evaluation.results.table import Rows, described, pd, summary, write_summary
from training.evaluation.results.words import number, small

KINDS = {
    "starts": "starts",
    "env": "holds",
    "hands": "holds",
    "objects": "holds",
    "transfer": "holds",
    "rl": "rl",
    "reproduce": "reproduce",
}
"""Module of this package that describes the page of a kind of run; other kinds show their summary.
"""
WIDTH = 4.6
"""Width of a figure [in]: 331 points, so that its text is 10 pixels high on a phone 360 pixels
wide."""
INK, LINE = "#101010", "#d5d8dd"
STYLE: Any = {
    "font.size": 10,
    "axes.labelsize": 10,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "axes.linewidth": 0.8,
    "lines.linewidth": 1.4,
    "svg.fonttype": "none",
    "svg.hashsalt": "grasp",
    "text.parse_math": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}
MOST_ROWS = 40
"""Largest number of rows that a table of a page shows."""

Draw = Callable[[Rows, Rows], Figure | None]
"""Function (rows, summary) -> figure; None if the run has nothing to draw."""
Make = Callable[[Rows, Rows], Rows]
"""Function (rows, summary) -> table of text and numbers; empty if the run has nothing to show."""


def write(run: Run) -> tuple[Path, list[Judged]]:
    """Write report.html and summary.csv of a finished run; return the page's path and the judged
    claims. Nothing is solved.

    Raises:
        InvalidInputError: its files are missing or were changed.
    """
    with understood(run.folder, "repeat the command that made it"):
        rows, about = run.load()
        shown = module_of(about)
        means = summary(rows)
        write_summary(run.path("summary.csv"), means)
        derived = getattr(shown, "derive", lambda means: means)(means)
        claims = judge(claims_of(about), derived)
        figures = [
            (
                title,
                caption,
                base64.b64encode(svg(figure).encode()).decode("ascii"),
                f"{title}. {caption}",
            )
            for title, caption, draw in getattr(shown, "FIGURES", ())
            if (figure := draw(rows, derived)) is not None
        ]
        tables = [
            (title, note, make(rows, derived))
            for title, note, make in getattr(shown, "TABLES", [_summary_table])
        ]
        page = render(
            title=f"{getattr(shown, 'TITLE', 'Results')}: {run.folder.name}",
            intro=getattr(shown, "INTRO", _INTRO),
            quick=bool(about.get("quick")),
            figures=figures,
            tables=[(title, note, made) for title, note, made in tables if len(made)],
            claims=claims,
            words=getattr(
                shown, "WORDS", [(name, text) for name, text in described(rows.columns).items()]
            ),
            facts=facts_of(about),
            load=(
                "import pandas",
                'rows = pandas.read_csv("rows.csv")  # run.json documents the columns',
                f"rows.groupby({[name for name in ('case', 'start', 'method', 'hand', 'controller') if name in rows.columns]})"
                f".{next((name for name in ('iterations', 'held') if name in rows.columns), rows.columns[-1])}.describe()",
            ),
        )
        return run.write_text("report.html", page), claims


def module_of(about: dict[str, Any]) -> ModuleType | None:
    """Return the module that describes the page of this kind of run."""
    name = KINDS.get(about.get("kind", ""))
    return import_module(f"training.evaluation.report.{name}_page") if name else None


def claims_of(about: dict[str, Any]) -> list[Claim]:
    """Return the claims of this kind of run, those about each start of a user, and those saved with
    the run.
    """
    shown = module_of(about)
    own = [make(name) for name in about.get("given", {}) for make in getattr(shown, "GIVEN", ())]
    claims = getattr(shown, "CLAIMS", ())
    saved = [Claim(**claim) for claim in about.get("claims", ())]
    return [*(claims.get(about["kind"], ()) if isinstance(claims, dict) else claims), *own, *saved]


def facts_of(about: dict[str, Any]) -> list[tuple[str, str]]:
    """Return machine, versions, command and settings for display."""
    machine = about.get("machine", {})
    facts = {
        "machine": f"{machine.get('processor', '–')}, {machine.get('cores', '–')} cores, {machine.get('system', '–')}",
        "versions": ", ".join(
            [
                f"Python {machine.get('python', '–')}",
                *(f"{k} {v}" for k, v in about.get("versions", {}).items()),
            ]
        ),
        **{name: str(about[name]) for name in ("commit", "time", "command") if name in about},
        **{
            name: ", ".join(
                f"{key} {number(value) if isinstance(value, float) else value}"
                for key, value in about[name].items()
            )
            for name in ("settings", "objective", "given", "steps_per_second", "map")
            if about.get(name)
        },
    }
    return list(facts.items())


def render(**page: Any) -> str:
    """Return a page as HTML that needs no other file.

    Args:
        page: title; intro (what is compared, how, and where the words are defined); quick, which
            marks the page; tables, each (title, note, table); facts, each (name, value); if it has
            them, figures, each (title, caption, base64 of the SVG, alternative text), judged
            claims, words, each (word, meaning), and the lines of Python that load the table.
    """
    whole = {"figures": (), "claims": (), "words": (), "load": (), **page}
    environment = Environment(
        loader=PackageLoader("training.evaluation.report", "."),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = cell
    return environment.get_template("page.html.j2").render(
        page=whole, verdicts=VERDICTS, most=MOST_ROWS
    )


def cell(value: Any) -> str:
    """Return a value of a table as text.

    Example:
        >>> cell(0.123456), cell(True), cell(None), cell("ball")
        ('0.123', 'yes', '–', 'ball')
    """
    if isinstance(value, str):
        return value
    if pd.isna(value):
        return "–"
    return ("yes" if value else "no") if pd.api.types.is_bool(value) else number(float(value))


def axes(height: float, width: float = WIDTH, rows: int = 1) -> tuple[Figure, Any]:
    """Make a styled figure and its axes, an array of them if there are several rows; sizes in
    inches.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        made = figure.subplots(rows, sharex=True)
    for panel in figure.axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(color=LINE, linewidth=0.6)
        panel.set_axisbelow(True)
    return figure, made


def decades(axis: Any, first: int, last: int, every: int = 1) -> None:
    """Label the decades of a logarithmic axis, from 10^first to 10^last, in plain text: `svg` does
    not parse the usual labels.
    """
    ticks = [10.0**k for k in range(first, last + 1, every)]
    axis.set_ticks(ticks, [small(tick) for tick in ticks])
    axis.minorticks_off()


def svg(figure: Figure) -> str:
    """Return the figure as SVG: text stays text, and its ink is light on a dark page."""
    out = io.StringIO()
    with rc_context(STYLE):
        figure.savefig(
            out, format="svg", transparent=True, metadata={"Date": None, "Creator": None}
        )
    text = out.getvalue()
    text = (
        text[text.index("<svg") :].replace(INK, "currentColor").replace("#000000", "currentColor")
    )
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"(\d+\.\d{2})\d+", r"\1", text)
    ink = "svg{color:#101010}text{fill:currentColor;font-family:system-ui,sans-serif!important}@media(prefers-color-scheme:dark){svg{color:#e8e8e8}}"
    return text.replace(">", f"><style>{ink}</style>", 1)


_INTRO = (
    "This page shows the results of one command; every number comes from the table rows.csv beside it. Rows with equal keys are "
    "repetitions of one experiment, and the table below summarises them. The columns are defined at the end of this page."
)
_summary_table: tuple[str, str, Make] = (
    "Summary",
    "One row for each combination of keys; summary.csv has all of them.",
    lambda rows, means: means,
)
