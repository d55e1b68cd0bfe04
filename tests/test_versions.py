"""The solver passes its tests with the oldest and the newest numpy and scipy: `make slow
ARGS=tests/test_versions.py`, some minutes.

An interpreter that is not on the PATH is skipped: `PATH=/path/to/cpython-3.10/bin:$PATH make slow
...`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from processes import cpython
from test_extras import PROJECT, ROOT

CASES: dict[str, tuple[list[int], list[str]]] = {
    "oldest": (
        [10],
        [one.replace(">=", "==", 1) for one in PROJECT["dependencies"]],
    ),  # Ubuntu 22.04, ROS 2 Humble
    "last of numpy 1": ([10], ["numpy==1.26.4", "scipy==1.11.4"]),  # Ubuntu 24.04, ROS 2 Jazzy
    "newest": ([13, 12, 11, 10], []),
}
"""Minor versions of CPython, of which the first that is here is taken, and packages."""
TESTED = """tests/grasp tests/force tests/quality tests/oracles tests/golden tests/core/test_solution.py tests/core/test_layer.py
tests/malformed/test_checks.py tests/test_ranges.py tests/policies/test_checkpoint.py tests/policies/test_learned.py --ignore tests/force/test_wrong_input.py
--pyargs grasp_env.grasp grasp_env.force grasp_env.quality grasp_env.inputs.arguments grasp_env.inputs.files policies.learned"""
"""Tests and doctests that need no extra."""


@pytest.fixture(scope="module")
def wheel_for(tmp_path_factory):
    """Return a function that builds the wheel for an interpreter once, with the numpy that pip
    takes for builds."""

    @cache
    def build(python: str) -> Path:
        folder = tmp_path_factory.mktemp("wheel")
        command = [
            sys.executable,
            "-m",
            "pip",
            "--python",
            python,
            "wheel",
            "-q",
            "--no-deps",
            "-w",
            folder,
            ROOT,
        ]
        subprocess.run(command, check=True, timeout=1200)
        (found,) = folder.glob("*.whl")
        return found

    return build


@pytest.mark.slow
@pytest.mark.parametrize(("minors", "packages"), CASES.values(), ids=CASES)
def test_the_solver_passes_its_tests(minors, packages, wheel_for, tmp_path):
    """They are copies, beside which there is no package: they import the installed one."""
    base = cpython(*minors)
    python = tmp_path / "venv/bin/python"
    subprocess.run([base, "-m", "venv", tmp_path / "venv"], check=True, timeout=120)
    install = [
        python,
        "-m",
        "pip",
        "install",
        "-q",
        "--only-binary=:all:",
        wheel_for(base),
        *packages,
    ]
    subprocess.run([*install, "pytest", "hypothesis", "clarabel"], check=True, timeout=600)
    shutil.copytree(
        ROOT / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("*.so", "__pycache__")
    )
    for name in ("conftest.py", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    command = [python, "-m", "pytest", "-q", *TESTED.split()]
    env = {name: os.environ[name] for name in ("PATH", "HOME")}
    done = subprocess.run(
        command, cwd=tmp_path, env=env, timeout=1200, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-5000:]
