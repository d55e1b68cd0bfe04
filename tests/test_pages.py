"""The README and the pages of docs/ are true: their Python runs, their commands, options and
targets exist, their files are there."""

from __future__ import annotations

import contextlib
import doctest
import io
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from training.program.cli import main

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RESULTS = re.compile(r"<!-- results: .*?<!-- /results -->", re.DOTALL)
"""Tables of saved runs: their commands belong to the version that was measured."""
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
OPTIONFLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
OTHERS = ("cd", "git", "python", "python3", "ray", "source")
"""Programs of console blocks whose arguments are not checked."""

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a language on a page."""
    return [
        code for kind, code in BLOCK.findall(page.read_text(encoding="utf-8")) if kind == language
    ]


def commands(page: Path, program: str) -> Iterator[list[str]]:
    """Yield the arguments of a program, in console blocks and in the text."""
    text = page.read_text(encoding="utf-8")
    lines = [line for code in blocks(page, "console") for line in code.splitlines()]
    lines += re.findall(rf"`({program} [^`\n]+)`", re.sub(BLOCK, "", re.sub(RESULTS, "", text)))
    for line in lines:
        words = shlex.split(line, comments=True)
        if words[:1] == [program]:
            yield words[1:]


@every_page
def test_python_blocks_run(page):
    code = blocks(page, "python")
    assert all(part.startswith(">>>") and part.endswith("\n\n") for part in code), (
        "a block that no test would run"
    )
    result = doctest.testfile(str(page), module_relative=False, optionflags=OPTIONFLAGS)
    assert (result.attempted > 0) == bool(code)
    assert result.failed == 0


def test_there_is_something_to_run():
    assert sum(len(blocks(page, "python")) for page in PAGES) > 25
    assert len([words for page in PAGES for words in commands(page, "grasp")]) > 10


@every_page
def test_console_blocks_hold_known_programs(page):
    for code in blocks(page, "console"):
        for line in code.splitlines():
            assert not line or line.split()[0] in ("grasp", "make", "pip", *OTHERS), line


@every_page
def test_make_targets_exist(page):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for words in commands(page, "make"):
        for target in (word for word in words if "=" not in word):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


@cache
def help_of(*words: str) -> str:
    """Return the help text of a sub-command."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), pytest.raises(SystemExit) as stopped:
        main([*words, "--help"])
    assert stopped.value.code == 0, words
    return text.getvalue()


@every_page
def test_grasp_commands_and_their_options_exist(page):
    for words in commands(page, "grasp"):
        if words[0].startswith("-"):
            continue
        text = help_of(words[0])
        if words[1:] and f"• {words[1]} " in text:
            text = help_of(words[0], words[1])
        for option in (word for word in words if word.startswith("--")):
            assert re.search(rf"{option}\b", text), (words, option)


@every_page
def test_files_exist(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:\s]+)(?:#[\w-]+)?\)", re.sub(BLOCK, "", text)):
        # when the site is built, which is strict about such links
        made = target.startswith("gallery/")
        assert made or (page.parent / target).exists() or (page.parent / f"{target}.md").exists(), (
            target
        )
    assert not re.search(r"\b(MINUTES|TODO)\b", text)  # nothing left to fill in
