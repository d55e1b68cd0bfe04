"""`program-help`: what `grasp COMMAND --help` prints, asked of the program while the site is built."""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from training.cli import main

if TYPE_CHECKING:
    from sphinx.application import Sphinx

WIDTH = 88
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
LISTED = re.compile(r"^[│ ]+• ([a-z_]+) ", re.MULTILINE)


def help_of(*words: str) -> str:
    """The help of a sub-command, or of the program."""
    text = io.StringIO()
    with patch.dict(os.environ, {"COLUMNS": str(WIDTH), "NO_COLOR": "1"}), redirect_stdout(text):
        try:
            main([*words, "--help"])
        except SystemExit as stopped:
            if stopped.code:
                raise RuntimeError(f"grasp {' '.join(words)} --help ended with {stopped.code}") from None
    return COLOUR.sub("", text.getvalue()).strip()


class ProgramHelp(SphinxDirective):
    """The program's own page, then every sub-command under a heading of its own, with the sub-commands that it has."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        text = help_of()
        page = nodes.literal_block(text, text, language="text")
        return [page, *(self._section(name) for name in LISTED.findall(text))]

    def _section(self, *words: str) -> nodes.section:
        text = help_of(*words)
        title = " ".join(("grasp", *words))
        section = nodes.section("", nodes.title(title, title), ids=[title.replace(" ", "-").replace("_", "-")])
        self.state.document.note_explicit_target(section, section)
        section += nodes.literal_block(text, text, language="text")
        section += [self._section(*words, name) for name in LISTED.findall(text)]
        return section


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_directive("program-help", ProgramHelp)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
