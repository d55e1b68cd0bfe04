"""Every file of `examples/` is short, says what it shows in the form that the gallery reads, and
runs to its end."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples"
ALL = sorted(FOLDER.glob("*.py"))
EXAMPLES = [path for path in ALL if path.name != "ros2_node.py"]
"""That one is a template for programs of users; its tests are elsewhere."""
MOST_CHARACTERS = {True: 4_800, False: 10_700}
"""Largest number of characters of an example and of another file."""
SECONDS = 300
"""Largest time of one example."""
LONG = ("12_", "13_", "14_", "15_")
"""Examples that train or slide for half a minute: the site (`make docs`) runs them too, so that
they are slow here."""
each = pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.slow) if path.name.startswith(LONG) else path
        for path in EXAMPLES
    ],
    ids=lambda path: path.stem,
)
whatever = pytest.mark.parametrize("path", ALL, ids=lambda path: path.stem)


def test_they_read_in_order():
    numbers = [int(path.name[:2]) for path in EXAMPLES if re.match(r"\d\d_", path.name)]
    assert numbers == list(range(1, len(numbers) + 1))


@whatever
def test_an_example_is_short_and_says_what_it_shows(path):
    source = path.read_text(encoding="utf-8")
    assert len(source) <= MOST_CHARACTERS[path in EXAMPLES]
    assert max(map(len, source.splitlines())) <= 120
    said = ast.get_docstring(ast.parse(source))
    assert said, "no docstring"
    title, line, *text = said.splitlines()
    assert re.fullmatch("=+", line), "its title is underlined with ="
    assert len(line) == len(title)
    assert text[:1] == [""], "then one paragraph"
    assert all(text[1:]), "then one paragraph"
    assert "To learn:" in " ".join(text)


@whatever
def test_an_example_uses_what_everybody_may(path):
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    own = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    names = {node.attr for node in nodes if isinstance(node, ast.Attribute)} - own
    names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    names |= {
        alias.name
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert not [name for name in names if re.search(r"(^|\.)_", name)]
    assert path not in EXAMPLES or any(isinstance(node, ast.Assert) for node in nodes)


@each
def test_an_example_runs(path, tmp_path):
    """In another folder, without a display; a warning is an error."""
    plain = {
        name: value for name, value in os.environ.items() if name not in ("LD_PRELOAD", "DISPLAY")
    }
    done = subprocess.run(
        [sys.executable, "-W", "error", path],
        cwd=tmp_path,
        env={**plain, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) >= 2
