"""The README is true: its Python runs, its commands and targets exist, its files are there."""

from __future__ import annotations

import doctest
import re
import shlex
from pathlib import Path

import pytest

from training.cli import main

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_python_blocks_run():
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    result = doctest.testfile(str(ROOT / "README.md"), module_relative=False, optionflags=flags)
    assert result.attempted > 15
    assert result.failed == 0


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"make ([a-z]+)", TEXT))
    assert {"evaluate", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_grasp_commands_exist(capsys):
    commands = set(
        re.findall(r"(?:^|`)(grasp (?:solve|fit|rl|evaluate|report|demo|bench|reproduce)[^`\n]*)", TEXT, re.MULTILINE)
    )
    assert len(commands) >= 4
    for command in commands:
        words = shlex.split(command)[1:]
        kinds = words[1:2] if words[1:2] in (["four_finger"], ["any_grasp"]) else []
        with pytest.raises(SystemExit) as stopped:
            main([words[0], *kinds, "--help"])
        assert stopped.value.code == 0
        page = capsys.readouterr().out
        for option in (word for word in words if word.startswith("--")):
            assert option in page, command


def test_files_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)", TEXT):
        assert (ROOT / target).exists(), target
    assert not re.search(r"\b(MINUTES|EVALUATE|TESTS|STARTS|HOLD)\b", TEXT)  # nothing left to fill in
