"""Pages from tables: report.html of any run folder, and the layout of other pages."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib import rc_context
from matplotlib.figure import Figure

from training.evaluation.results.claims import VERDICTS, Claim, Verdict, judge
from training.evaluation.results.run import ROWS, Run, understood
from training.evaluation.results.table import Rows, described, pd, summary, write_summary
from training.evaluation.results.words import number, small

KINDS = {
    "starts": "starts",
    "env": "holds",
    "hands": "holds",
    "objects": "holds",
    "transfer": "holds",
    "soft": "holds",
    "errors": "errors",
    "rl": "rl",
    "reproduce": "reproduce",
}
"""Page module of a kind of run; other kinds show their summary."""
WIDTH = 4.6
"""Width of a figure [in]; its text is 10 pixels high on a phone 360 pixels wide."""
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


def write(run: Run) -> tuple[Path, list[Verdict]]:
    """Write report.html and summary.csv of a finished run; return the page's path and the verdicts.

    Raises:
        InvalidInputError: its files are missing or were changed.
    """
    with understood(run.folder):
        rows, about = run.load()
        page_module = module_of(about)
        means = summary(rows)
        write_summary(run.path("summary.csv"), means)
        claims = judge(claims_of(about), means)
        figures = []
        for title, caption, draw in _of(means, getattr(page_module, "FIGURES", ())):
            if (figure := draw(rows, means)) is not None:
                image = base64.b64encode(svg(figure).encode()).decode("ascii")
                figures.append((title, caption, image, f"{title}. {caption}"))
        tables = [
            (title, note, make(rows, means))
            for title, note, make in _of(means, getattr(page_module, "TABLES", [_SUMMARY_TABLE]))
        ]
        names = [*rows.columns]
        keys = [key for key in ("case", "start", "method", "hand", "controller") if key in names]
        value = next((name for name in ("iterations", "held") if name in names), names[-1])
        page = render(
            title=f"{getattr(page_module, 'TITLE', 'Results')}: {run.folder.name}",
            intro=getattr(page_module, "INTRO", _INTRO),
            quick=bool(about.get("quick")),
            figures=figures,
            tables=[table for table in tables if len(table[2])],
            claims=claims,
            words=getattr(page_module, "WORDS", described(names)).items(),
            facts=facts_of(about),
            load=(
                "import pandas",
                f'rows = pandas.read_csv("{ROWS}")  # run.json documents the columns',
                f"rows.groupby({keys}).{value}.describe()",
            ),
        )
        return run.write_text("report.html", page), claims


def _of(means: Rows, listed: Any) -> Iterable[Any]:
    """Return the figures or tables of a page, which may be a function of the summary."""
    found: Any = listed(means) if callable(listed) else listed
    return found


def module_of(about: dict[str, Any]) -> ModuleType | None:
    """Return the page module for this run's kind."""
    name = KINDS.get(about.get("kind", ""))
    return import_module(f"training.evaluation.report.{name}_page") if name else None


def claims_of(about: dict[str, Any]) -> list[Claim]:
    """Return the claims of this kind of run, about each start of a user, and saved with the run."""
    page_module: Any = module_of(about)
    claims = getattr(page_module, "CLAIMS", ())
    if isinstance(claims, dict):
        claims = claims.get(about["kind"], ())
    users = [claim for name in about.get("given", {}) for claim in page_module.given_claims(name)]
    saved = [Claim(**claim) for claim in about.get("claims", ())]
    return [*claims, *users, *saved]


def facts_of(about: dict[str, Any]) -> list[tuple[str, str]]:
    """Return machine, versions, command and settings for display."""
    unknown = dict.fromkeys(("processor", "cores", "system", "python"), "–")
    machine = unknown | about.get("machine", {})
    versions = {"Python": machine["python"], **about.get("versions", {})}
    facts = {
        "machine": "{processor}, {cores} cores, {system}".format(**machine),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
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
        page: title; intro; quick, which marks the page; tables, each (title, note, table); facts,
            each (name, value); optional figures, each (title, caption, base64 of the SVG,
            alternative text), claims as `Verdict`, words, each (word, meaning), and load, lines of
            Python that load the table.
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
    """Make a styled figure and its axes (an array for several rows); sizes in inches."""
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        panels = figure.subplots(rows, sharex=True)
    for panel in figure.axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(color=LINE, linewidth=0.6)
        panel.set_axisbelow(True)
    return figure, panels


def legend_above(figure: Figure, columns: int = 2) -> None:
    """Put the legend of a figure above its axes, where it covers no curve, and make room for it."""
    lines = {
        name: handle
        for panel in figure.axes
        for handle, name in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.19 * -(-len(lines) // columns))
    figure.legend(
        lines.values(),
        lines.keys(),
        fontsize=8,
        frameon=False,
        loc="outside upper center",
        ncols=columns,
    )


def decades(axis: Any, first: int, last: int, every: int = 1) -> None:
    """Label 10^first to 10^last on a logarithmic axis in plain text, as `svg` parses no other."""
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
    text = re.sub(f"{INK}|#000000", "currentColor", text[text.index("<svg") :])
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"(\d+\.\d{2})\d+", r"\1", text)
    ink = "svg{color:#101010}text{fill:currentColor;font-family:system-ui,sans-serif!important}@media(prefers-color-scheme:dark){svg{color:#e8e8e8}}"
    return text.replace(">", f"><style>{ink}</style>", 1)


_INTRO = (
    f"This page shows the results of one command; every number comes from the table {ROWS} beside it. Rows with equal keys are "
    "repetitions of one experiment, and the table below summarises them. The columns are defined at the end of this page."
)
_SUMMARY_TABLE: tuple[str, str, Make] = (
    "Summary",
    "One row for each combination of keys; summary.csv has all of them.",
    lambda rows, means: means,
)
