"""The Makefile installs the extras that are asked for and tells their sizes, as the pages do."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from test_extras import NOT_IN_ALL

from grasp_env.inputs.extras import EXTRAS

ROOT = Path(__file__).parents[1]
SIZES = {
    name: int(disk)
    for name, disk in re.findall(
        r"(\w+)=(\d+)/\d+", (ROOT / "Makefile").read_text(encoding="utf-8")
    )
}
"""Size of each extra on disk [MB]."""
EVERYTHING = "all bench dev docs mend"


def asked(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Return what make would run in a folder like the root, whatever make runs these tests."""
    env = {
        name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))
    }
    command = ["make", "--dry-run", "--file", str(ROOT / "Makefile"), *words]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=60)


def size(*extras: str) -> str:
    """Return the size of a set-up, as `gigabytes` of the Makefile does."""
    counted = {"bare", *extras} - ({*EXTRAS} - NOT_IN_ALL if "all" in extras else set())
    return f"{sum(SIZES[name] for name in counted) / 1e3:.1f} GB"


@pytest.fixture
def folder(tmp_path):
    if not shutil.which("make"):
        pytest.skip("there is no make")
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    (tmp_path / ".venv").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("installed", "words", "expected"),
    [
        (None, ["install"], EVERYTHING),
        (None, ["test"], EVERYTHING),
        (None, ["slow"], f"{EVERYTHING} ray"),
        (None, ["core", "EXTRAS=sim,mujoco"], "mujoco sim"),
        (None, ["install", "EXTRAS="], ""),
        ("", ["install", "EXTRAS="], None),
        ("", ["core"], None),
        ("sim", ["core"], None),
        ("sim", ["install", "EXTRAS=sim"], None),
        ("sim", ["install", "EXTRAS=video"], "sim video"),
        ("sim", ["test"], f"{EVERYTHING} sim"),
        (EVERYTHING, ["test"], None),
        (EVERYTHING, ["check", "docs"], None),
        (EVERYTHING, ["slow"], f"{EVERYTHING} ray"),
    ],
)
def test_what_is_installed_is_completed(folder, installed, words, expected):
    if installed is not None:
        (folder / ".venv/.installed").write_text(f"{installed}\n")
    plan = asked(folder, *words).stdout
    assert ("--only-deps" in plan) == (expected is not None)
    if expected is not None:
        assert f'--only-deps ".[$(echo {expected} | tr ' in plan
        assert f"echo {expected} >.venv/.installed" in plan
        assert ("torch==" in plan) == ("all" in expected)
        assert f"takes {size(*expected.split())} on disk" in plan


def test_extras_that_do_not_exist_are_named(folder):
    done = asked(folder, "install", "EXTRAS=sim,viedo")
    assert done.returncode == 2
    assert (
        "There is no extra viedo: EXTRAS is a list, with commas, of cli sim mujoco" in done.stderr
    )


def test_the_sizes_are_those_of_the_pages():
    assert {*SIZES} == {"bare", *EXTRAS, "all", "bench", "docs", "dev"}
    readme, page = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/start_here.md")
    )
    for text in (readme, page):
        assert size(*EVERYTHING.split()) in text
        assert size("sim") in text
    told = re.findall(r'^\| `pip install "\.\[(\w+)\]"` \|.* (\d+) \|$', page, re.MULTILINE)
    assert {name: int(each) for name, each in told} == {
        name: SIZES[name] for name in (*EXTRAS, "all") if name != "cvxpy"
    }
