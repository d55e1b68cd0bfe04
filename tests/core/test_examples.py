"""The examples in C++ are short, and print the numbers of their twins in Python; what the page for C++ users shows compiles."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from test_package import CORE, FLAGS, ROOT, SHADOW, run, succeed, tool

from grasp_env.grasp import presets
from policies import LearnedInitialForce

ALL = sorted((CORE / "examples").glob("*.[ch]pp"))
EXAMPLES = [path for path in ALL if re.match(r"\d\d_", path.name)]
"""The others are parts of users' own programs: test_hand_controller.py."""
SOON = ("02_moving_contacts", "07_learned_start")
"""Those that are built each time; each takes seconds to compile."""
NUMBER = re.compile(r"-?\b\d+\.?\d*")
LINES, MOST_LINES = 60, 150


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where they are built, and a model."""
    folder = tmp_path_factory.mktemp("examples")
    flags = " ".join(["-O0", *FLAGS, SHADOW["g++"]])
    configure = ["-DGRASP_EXAMPLES=ON", "-DCMAKE_BUILD_TYPE=None", f"-DCMAKE_CXX_COMPILER={tool('g++')}"]
    succeed(tool("cmake"), "-S", CORE, "-B", folder, *configure, f"-DCMAKE_CXX_FLAGS={flags}")
    LearnedInitialForce.pretrained().export(folder / "four.model", presets.paper_cuboid())
    return folder


def words(line: str) -> str:
    """A line without its numbers, and without the blanks that align them."""
    return "".join(NUMBER.sub("#", line.replace("-", "")).split())


@pytest.mark.parametrize("path", ALL, ids=lambda path: path.name)
def test_an_example_is_short_and_has_a_twin(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert len(lines) < LINES if path in EXAMPLES else len(lines) <= MOST_LINES
    assert max(map(len, lines)) <= 132
    assert (ROOT / f"examples/{path.stem}.py").is_file()


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=[] if path.stem in SOON else pytest.mark.slow) for path in EXAMPLES]
)
def test_twins_print_the_same(path: Path, folder: Path) -> None:
    """Line by line and in the same order, but for what they took, and what Python alone says; a wrong file is named."""
    succeed("cmake", "--build", folder, "--target", path.stem)
    model = [folder / "four.model"] if "learned" in path.stem else []
    compiled = succeed(folder / path.stem, *model).splitlines()
    python = iter(succeed(sys.executable, ROOT / f"examples/{path.stem}.py").splitlines())
    compared = 0
    for line in compiled:
        if re.search(r"\bus\b|a second|two remain", line):
            continue
        twin = next((one for one in python if words(one) == words(line)), None)
        assert twin is not None, line
        for mine, other in zip(NUMBER.findall(line), NUMBER.findall(twin), strict=True):
            # the last digit that is printed may be rounded either way
            assert float(mine) == pytest.approx(float(other), abs=1.1 * 10.0 ** -len(mine.partition(".")[2])), line
            compared += 1
    assert compared > 0
    for wrong in (["missing.model"], [str(path)], []) if model else ():
        done = run(folder / path.stem, *wrong)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(("page", "count"), [("grasp_env/core/README.md", 2), ("docs/moving_contacts.md", 3)])
def test_what_a_page_shows_compiles(page: str, count: int) -> None:
    blocks = re.findall(r"```cpp\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    assert len(blocks) == count
    command = [tool("g++"), *FLAGS, "-fsyntax-only", f"-I{CORE / 'include'}", "-x", "c++", "-"]
    done = run(*command, input="\n".join(blocks))
    assert done.returncode == 0, done.stderr


def test_the_page_names_every_code() -> None:
    header = (CORE / "include/grasp/record.hpp").read_text()
    codes = re.search(r"enum Code \{(.*?)\n\}", header, re.DOTALL)
    assert codes is not None
    told = re.findall(r"^\| `([A-Z_]+)`", (CORE / "README.md").read_text(), re.MULTILINE)
    assert told == re.findall(r"^ +([A-Z_]+),", codes[1], re.MULTILINE) != []
