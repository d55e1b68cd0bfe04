"""Wheels in dist/ install and solve in an empty environment without a compiler, with the same
results at every level."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from processes import cpython

from grasp_env.core import _builds

ROOT = Path(__file__).parents[1]
WHEELS = sorted((ROOT / "dist").glob(f"grasp_force-*{platform.machine()}.whl"))
CORE = "grasp_env/core"
SOLVE = """
import json
from grasp_env import core
from grasp_env.force import optimize_force
from grasp_env.force.options import METHODS
from grasp_env.grasp import presets
from policies import LearnedInitialForce
grasp, wrench = presets.paper_cuboid(), [1, 0.5, -0.6, -0.1, 0.2, 0]
answers = [optimize_force(grasp, wrench, method=method) for method in METHODS]
answers.append(optimize_force(grasp, wrench, initial=LearnedInitialForce.pretrained()))
print(json.dumps([core.build_info()["arch"], [answer.status.value == "optimal" for answer in answers]]))
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not WHEELS, reason="no wheel for this machine in dist: make wheel"),
    pytest.mark.parametrize("wheel", WHEELS, ids=lambda wheel: wheel.name),
]


def _python_of(wheel: Path) -> str:
    """Return an interpreter for a wheel."""
    later = "-abi3-" in wheel.name
    (minor,) = map(int, re.findall(r"-cp3(\d+)-", wheel.name)[:1])
    return cpython(*range(minor, 16 if later else minor + 1))


def _levels(folder: Path) -> list[str]:
    """Return the builds that this processor runs; [""] if there is only one."""
    held = sorted(path.name for path in (folder / CORE).glob("x86-64-v*"))
    return [name for name in held if int(name[-1]) <= _builds.processor_level(folder / CORE)] or [
        ""
    ]


@pytest.fixture
def unpacked(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "unpacked")
    return tmp_path / "unpacked"


def test_solves_in_an_empty_environment_without_a_compiler(wheel, unpacked, tmp_path):
    python = tmp_path / "empty/bin/python"
    subprocess.run(
        [_python_of(wheel), "-m", "venv", str(tmp_path / "empty")], check=True, timeout=120
    )
    install = [str(python), "-m", "pip", "install", "-q", "--only-binary", ":all:", str(wheel)]
    subprocess.run(install, check=True, timeout=300, env={"PATH": "", "HOME": os.environ["HOME"]})
    options: dict[str, Any] = {
        "cwd": tmp_path,
        "timeout": 120,
        "capture_output": True,
        "text": True,
    }

    def solved(env: dict[str, str]) -> list[Any]:
        done = subprocess.run([str(python), "-c", SOLVE], env=env, **options)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    levels = _levels(unpacked)
    for level in levels:
        assert solved({_builds.VARIABLE: level}) == [level, [True] * 5]
    assert solved({})[0] == levels[-1]


def test_needs_nothing_of_this_machine_but_its_glibc(wheel, unpacked):
    files = sorted(unpacked.rglob("*.so"))
    assert len(files) == (4 if platform.machine() == "x86_64" else 1)
    major, minor = map(int, re.findall(r"manylinux_(\d+)_(\d+)_", wheel.name)[0])
    for file in files:
        data = file.read_bytes()
        assert b"libstdc++.so" not in data, file
        assert b"libgcc_s" not in data, file
        needed = {(int(a), int(b)) for a, b in re.findall(rb"GLIBC_(\d+)\.(\d+)", data)}
        assert not needed or max(needed) <= (major, minor), file


def test_named_problems_have_their_outcomes_at_every_level(wheel, unpacked):
    if _python_of(wheel) != sys.executable:
        pytest.skip("of another Python than this one")
    for level in _levels(unpacked):
        tests = ["tests/force/test_named.py", "tests/golden", "-k", "not environment"]
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
        environment = {**os.environ, "GRASP_CORE_BUILD": str(unpacked / CORE / level)}
        done = subprocess.run(
            command, cwd=ROOT, env=environment, timeout=600, capture_output=True, text=True
        )
        assert done.returncode == 0, (level, done.stdout[-2000:])
