"""Programs in C++: random bytes, threads, and the examples, which print the numbers of their twins
in Python; pages compile with them."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

import pytest
from building import CORE, EXAMPLES, ROOT, SANITIZED, build, run, succeed

from grasp_env.grasp import presets
from policies import LearnedInitialForce

SEED = os.environ.get("GRASP_TRIAL_SEED", "0")
NUMBER = re.compile(r"-?\b\d+\.?\d*")
MOST_CHARACTERS = {True: 3_100, False: 10_300}


def model(folder: Path) -> Path:
    return LearnedInitialForce.pretrained().export(folder / "four.model", presets.paper_cuboid())


def test_random_bytes(programs):
    assert succeed(programs / "fuzz", SEED, "300") == "300\n"


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_many_random_bytes_under_the_sanitizers(compiler, tmp_path):
    made = build(tmp_path, *SANITIZED, compiler=compiler)
    assert succeed(made / "fuzz", SEED + "1", "10000") == "10000\n"


@pytest.mark.slow
def test_no_random_bytes_read_memory_before_it_is_written(tmp_path):
    """Valgrind follows every bit; it does not know AVX-512."""
    if not shutil.which("valgrind"):
        pytest.skip("valgrind is not installed")
    made = build(tmp_path, "-O1", "-march=x86-64-v3")
    assert succeed("valgrind", "-q", "--error-exitcode=9", made / "fuzz", SEED, "2000") == "2000\n"


def test_eight_threads(programs, tmp_path):
    assert int(succeed(programs / "threads", model(tmp_path), "5")) == 5 * 6 * 12


@pytest.mark.slow
def test_eight_threads_under_the_thread_sanitizer(tmp_path):
    made = build(tmp_path, "-O1", "-g1", "-fsanitize=thread")
    assert int(succeed("setarch", "-R", made / "threads", model(tmp_path), "200")) == 200 * 6 * 12


# --- examples and pages


@pytest.mark.parametrize(
    "path", sorted((CORE / "examples").glob("*.[ch]pp")), ids=lambda path: path.name
)
def test_an_example_is_short_and_has_a_twin(path):
    text = path.read_text()
    assert len(text) <= MOST_CHARACTERS[path in EXAMPLES]
    assert max(map(len, text.splitlines())) <= 100
    assert (ROOT / f"examples/{path.stem}.py").is_file()


def words(line: str) -> str:
    """A line without its numbers, and without the blanks that align them."""
    return "".join(NUMBER.sub("#", line.replace("-", "")).split())


@pytest.mark.parametrize("name", [path.stem for path in EXAMPLES])
def test_twins_print_the_same(name, programs, tmp_path):
    """Line by line and in the same order, except for times and for lines that Python alone prints;
    a wrong file is named."""
    arguments = [model(tmp_path)] if "learned" in name else []
    python = iter(succeed(sys.executable, ROOT / f"examples/{name}.py").splitlines())
    compared = 0
    for line in succeed(programs / name, *arguments).splitlines():
        if re.search(r"\bus\b|a second|two remain", line):
            continue
        twin = next((one for one in python if words(one) == words(line)), None)
        assert twin is not None, line
        for mine, other in zip(NUMBER.findall(line), NUMBER.findall(twin), strict=True):
            # the last digit that is printed may be rounded either way
            assert float(mine) == pytest.approx(
                float(other), abs=1.1 * 10.0 ** -len(mine.partition(".")[2])
            ), line
            compared += 1
    assert compared > 0
    for wrong in (["missing.model"], [__file__], []) if arguments else ():
        done = run(programs / name, *wrong)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)


def test_the_page_names_every_code():
    header = (CORE / "include/grasp/record.hpp").read_text()
    codes = re.search(r"enum Code \{(.*?)\n\}", header, re.DOTALL)
    assert codes is not None
    documented = re.findall(r"^\| `([A-Z_]+)`", (CORE / "README.md").read_text(), re.MULTILINE)
    assert documented == re.findall(r"^ +([A-Z_]+),", codes[1], re.MULTILINE) != []
