"""Pages: sections to markdown, and to HTML that holds everything it shows."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from training.report.model import Fold, Picture, Section, Table, data_uri
from training.report.style import close, variables
from training.runs import Run


def write_page(
    run: Run, title: str, quick: bool, sections: Iterable[Section | None], name: str = "report", html: bool = True
) -> None:
    """Writes <name>.md and <name>.html; sections without anything in them are left out.

    Args:
        run: receives them.
        title: of the page.
        quick: says so at the top.
        sections: in their order.
        name: of the files.
        html: whether the second is written.
    """
    kept = [section for section in sections if section is not None and (section.blocks or section.items)]
    context = {"title": title, "quick": quick, "sections": kept, "light": variables(False), "dark": variables(True)}
    for kind in ("md", "html") if html else ("md",):
        run.write_text(f"{name}.{kind}", _render(f"report.{kind}.j2", context))


def png(run: Run, file: str, figure: Figure, title: str, caption: str, alt: str = "") -> Picture:
    """Saves a figure as a .png of the run, frees it, and is its picture for a page."""
    path = run.write(file, lambda target: figure.savefig(target, format="png", dpi=130))
    close(figure)
    still = {"still": data_uri(path.read_bytes(), "png")}
    return Picture(path.stem, title, caption, alt or caption or title, file=file, sources=still)


def _render(template: str, context: dict[str, Any]) -> str:
    """A template of this room, filled; one that names what `context` lacks raises."""
    environment = Environment(
        loader=PackageLoader("training.report", "templates"),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["table"] = lambda block: isinstance(block, Table)
    environment.tests["picture"] = lambda block: isinstance(block, Picture)
    environment.tests["fold"] = lambda block: isinstance(block, Fold)
    return environment.get_template(template).render(context)
