"""Directive `all-settings`: tables of every setting of the environment, made of the records while
the site is built.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

from grasp_env.config import EnvConfig
from grasp_env.config.env import KEYWORDS
from grasp_env.settings import Settings, described

if TYPE_CHECKING:
    from sphinx.application import Sphinx

HEAD = "| Setting | Meaning | Default | Values |\n|---|---|---|---|"


def plainly(value: Any) -> str:
    """Return a default value as text."""
    if isinstance(value, Settings):
        return value.name or f"{type(value).__name__}()"
    if isinstance(value, tuple):
        return f"({', '.join(map(plainly, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def tables() -> Iterator[tuple[str, str]]:
    """Yield a title and a Markdown table for the top-level settings and for each record."""
    plain = {path: name for name, path in KEYWORDS.items()}
    groups: dict[tuple[str, type], list[str]] = {}
    for path, record, about in described(EnvConfig):
        group, _, last = path.rpartition(".")
        default = about.none or "none" if about.default is None else plainly(about.default)
        words = (about.doc, default, about.kind.text)
        cells = [text.replace("|", "\\|").replace("\n", " ") for text in words]
        unit = about.unit and f" [{about.unit}]"
        keyword = f", keyword `{plain[path]}`" if path in plain else ""
        groups.setdefault((group, record), []).append(
            f"| {' | '.join([f'`{last}`{unit}{keyword}', *cells])} |"
        )
    for (group, record), lines in groups.items():
        named = f", {record.name}" if record.name else ""
        title = f"{group}{named}: {record.__name__}" if group else "EnvConfig"
        yield title, "\n".join([(record.__doc__ or "").partition("\n")[0], "", HEAD, *lines])


class AllSettings(SphinxDirective):
    """Tables, each under a heading."""

    def run(self) -> list[nodes.Node]:
        """Return the sections."""
        return [self._section(title, text) for title, text in tables()]

    def _section(self, title: str, text: str) -> nodes.section:
        section = nodes.section(
            "", nodes.title("", title), ids=[nodes.make_id(f"settings-{title}")]
        )
        self.state.document.note_explicit_target(section, section)
        self.state.nested_parse(
            StringList(text.split("\n"), source="settings"), self.content_offset, section
        )
        return section


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension with Sphinx."""
    app.add_directive("all-settings", AllSettings)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
