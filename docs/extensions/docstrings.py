"""Reading of docstrings: `code` becomes a link if a page has that name."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from docutils import nodes
from pygments.lexers.shell import BashLexer
from sphinx.domains.python import PyXRefRole
from sphinx.pycode import ModuleAnalyzer

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

ROOMS = ("grasp_env", "policies", "training")


class Word(PyXRefRole):
    """Default role.

    A word without a page stays text, without a warning, because most backticks are code.
    """

    def process_link(
        self,
        env: BuildEnvironment,
        refnode: nodes.Element,
        has_explicit_title: bool,
        title: str,
        target: str,
    ) -> tuple[str, str]:
        """Treat the word as a reference to any Python object; a class may be in any module."""
        refnode["reftype"] = "obj"
        title = " ".join(title.split())  # a line may end inside of the backticks
        target = " ".join(target.split())
        if target[:1].isupper() and target.isidentifier():
            target = f".{target}"
        return super().process_link(env, refnode, has_explicit_title, title, target)


def constant_docs(name: str, value: Any) -> list[str]:
    """Return the text below a module's constant, in any of our modules; empty if there is none.

    `__doc__` of a constant is the docstring of its type.
    """
    for name_of_module, module in list(sys.modules.items()):
        if name_of_module.partition(".")[0] in ROOMS and vars(module).get(name) is value:
            docs = ModuleAnalyzer.for_module(name_of_module).find_attr_docs().get(("", name))
            if docs:
                return list(docs)
    return []


def from_markdown(lines: list[str]) -> list[str]:
    """Convert headings and tables of Gymnasium's docstrings from Markdown to reStructuredText."""
    converted: list[str] = []
    for k, line in enumerate(lines):
        if line.startswith("## "):
            converted += ["", f".. rubric:: {line[3:]}", ""]
        elif line.startswith("| "):
            if not lines[k - 1].startswith("|"):
                converted += ["", ".. list-table::", "   :header-rows: 1", ""]
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            converted += [f"   {'*' if cell is cells[0] else ' '} - {cell}" for cell in cells]
        elif not line.startswith("|--"):
            converted.append(line)
    return converted


def prepare(
    _app: Sphinx, what: str, name: str, value: Any, _options: Any, lines: list[str]
) -> None:
    """Change a docstring before Google's sections are read."""
    if what == "data":
        lines[:] = constant_docs(name.rpartition(".")[2], value)
    if what in ("data", "attribute", "property"):
        # a comment: text before a colon in the first line would be taken as the type
        lines[:0] = ["..", ""]
    if any(line.startswith("## ") for line in lines):
        lines[:] = from_markdown(lines)
    for k, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            lines[k] = line.replace("|", r"\|")  # |x| is an absolute value


def skip(
    _app: Sphinx, _what: str, _name: str, value: Any, _skipped: bool, _options: Any
) -> bool | None:
    """Skip the fields of a NamedTuple, which are documented under `Attributes`."""
    said = getattr(value, "__doc__", None) or ""
    return True if said.startswith("Alias for field number") else None


def add_examples(
    app: Sphinx, what: str, name: str, _value: Any, _options: Any, lines: list[str]
) -> None:
    """Add the gallery's programs that use a class or function, as pictures below it."""
    programs = app.srcdir / "gallery" / "backreferences" / f"{name}.examples"
    if (
        what in ("class", "function")
        and programs.is_file()
        and programs.read_text(encoding="utf-8").strip()
    ):
        lines += [
            "",
            f".. minigallery:: {name}",
            "   :add-heading: In the gallery",
            "   :heading-level: ^",
            "",
        ]


def strip_blocks(_app: Sphinx, doctree: nodes.document) -> None:
    """Remove the empty line at the end of code, which doctest needs before a fence."""
    for block in doctree.findall(nodes.literal_block):
        if block.astext() != block.astext().rstrip("\n"):
            block.rawsource = block.astext().rstrip("\n")
            block[:] = [nodes.Text(block.rawsource)]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension with Sphinx."""
    app.add_role_to_domain("py", "word", Word())
    app.add_lexer("console", BashLexer)  # commands without a prompt, and no output
    app.connect("autodoc-process-docstring", prepare, priority=100)
    app.connect("autodoc-process-docstring", add_examples, priority=900)
    app.connect("autodoc-skip-member", skip)
    app.connect("doctree-read", strip_blocks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
