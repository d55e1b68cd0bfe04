"""Programs in C++ that try the headers hard: bytes that make contacts and models, eight threads."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from test_front import OPTIMIZE, PROGRAMS
from test_package import CORE, FLAGS, SHADOW, succeed, tool

from grasp_env.grasp import presets
from policies import LearnedInitialForce

SEED = os.environ.get("GRASP_TRIAL_SEED", "0")
SANITIZED = [
    "-O1", "-g1", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all", "-D_GLIBCXX_ASSERTIONS",
]  # fmt: skip


def program(name: str, folder: Path, *flags: str, compiler: str = "g++") -> Path:
    made = folder / name
    every = [*FLAGS, SHADOW[compiler], *OPTIMIZE, *flags, f"-I{CORE / 'include'}", "-pthread"]
    succeed(tool(compiler), *every, PROGRAMS / f"{name}.cpp", "-o", made)
    return made


def model(folder: Path) -> Path:
    return LearnedInitialForce.pretrained().export(folder / "four.model", presets.paper_cuboid())


def test_bytes_by_chance(tmp_path: Path) -> None:
    assert succeed(program("fuzz", tmp_path, "-DGRASP_SEEDED"), SEED, "1000") == "1000\n"


@pytest.mark.slow
@pytest.mark.parametrize("compiler", SHADOW)
def test_many_bytes_by_chance_under_the_sanitizers(compiler: str, tmp_path: Path) -> None:
    """clang++ also with libFuzzer: `-fsanitize=fuzzer,address,undefined` without -DGRASP_SEEDED."""
    fuzz = program("fuzz", tmp_path, "-DGRASP_SEEDED", *SANITIZED, compiler=compiler)
    assert succeed(fuzz, SEED + "1", "10000") == "10000\n"


@pytest.mark.slow
def test_nothing_is_read_before_it_is_written(tmp_path: Path) -> None:
    """Valgrind follows every bit; it does not know AVX-512."""
    if not shutil.which("valgrind"):
        pytest.skip("valgrind is not installed")
    fuzz = program("fuzz", tmp_path, "-DGRASP_SEEDED", "-O1", "-march=x86-64-v3")
    assert succeed("valgrind", "-q", "--error-exitcode=9", fuzz, SEED, "2000") == "2000\n"


@pytest.mark.slow
def test_eight_threads(tmp_path: Path) -> None:
    assert int(succeed(program("threads", tmp_path), model(tmp_path), "50")) == 50 * 6 * 12


@pytest.mark.slow
def test_eight_threads_under_the_thread_sanitizer(tmp_path: Path) -> None:
    made = program("threads", tmp_path, "-O1", "-g1", "-fsanitize=thread")
    assert int(succeed("setarch", "-R", made, model(tmp_path), "200")) == 200 * 6 * 12
