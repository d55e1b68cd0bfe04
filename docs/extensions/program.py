"""Directive `program-help`: the output of `grasp COMMAND --help`, taken while the site is built."""

from __future__ import annotations

import io
import os
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from training.program.cli import COMMANDS, main

if TYPE_CHECKING:
    from sphinx.application import Sphinx

WIDTH = 88


def help_of(*words: str) -> str:
    """Return the help of a sub-command, or of the program."""
    text = io.StringIO()
    with patch.dict(os.environ, {"COLUMNS": str(WIDTH)}), redirect_stdout(text):
        try:
            main([*words, "--help"])
        except SystemExit as stopped:
            if stopped.code:
                raise RuntimeError(
                    f"grasp {' '.join(words)} --help ended with {stopped.code}"
                ) from None
    return text.getvalue().strip()


class ProgramHelp(SphinxDirective):
    """Help of the program, then of every sub-command under a heading."""

    def run(self) -> list[nodes.Node]:
        """Return the sections."""
        text = help_of()
        return [nodes.literal_block(text, text, language="text"), *map(self._section, COMMANDS)]

    def _section(self, name: str) -> nodes.section:
        section = nodes.section("", nodes.title("", f"grasp {name}"), ids=[f"grasp-{name}"])
        self.state.document.note_explicit_target(section, section)
        text = help_of(name)
        section += nodes.literal_block(text, text, language="text")
        return section


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension with Sphinx."""
    app.add_directive("program-help", ProgramHelp)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
