"""The examples run, in both languages to the same end, and what the page for C++ users shows compiles."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from test_package import CORE, FLAGS, SHADOW, run, succeed, tool

from grasp_env.grasp import presets
from policies import LearnedInitialForce

TICKS = "1000"
EXAMPLES = CORE / "examples"


def test_the_controllers_agree(tmp_path: Path) -> None:
    """A second of the loop, a contact lost in it."""
    model = LearnedInitialForce.pretrained("four_finger").export(tmp_path / "four.model", presets.paper_cuboid())
    flags = " ".join([*FLAGS, SHADOW["g++"]])
    configure = ["-DGRASP_EXAMPLES=ON", "-DCMAKE_BUILD_TYPE=Debug", f"-DCMAKE_CXX_COMPILER={tool('g++')}"]
    succeed(tool("cmake"), "-S", CORE, "-B", tmp_path, *configure, f"-DCMAKE_CXX_FLAGS={flags}")
    succeed("cmake", "--build", tmp_path)
    compiled = succeed(tmp_path / "controller", model, TICKS).splitlines()
    python = succeed(sys.executable, EXAMPLES / "controller.py", TICKS).splitlines()
    assert compiled[0] == python[0]
    found = re.fullmatch(
        rf"{TICKS} ticks: (\d+) beyond torque limits, 0 unsolved, {TICKS} knocks answered", compiled[0]
    )
    assert found is not None
    assert 10 < int(found[1]) < 500  # there are ticks of either kind
    for lines in (compiled, python):
        measured = [line for line in lines if "median" in line]
        assert [line.partition(":")[0] for line in measured] == [
            "Newton, moving contacts", "Newton within torque limits", "learned start",
        ]  # fmt: skip
        for line in measured:
            times = [float(number) for number in re.findall(r"(?<!p)\b\d+\.\d+", line)]
            assert len(times) == 4
            assert times == sorted(times)
    for wrong in (["missing.model"], [str(EXAMPLES / "controller.py")], []):
        done = run(tmp_path / "controller", *wrong)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1


def test_what_the_page_shows_compiles() -> None:
    blocks = re.findall(r"```cpp\n(.*?)```", (CORE / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    command = [tool("g++"), *FLAGS, "-fsyntax-only", f"-I{CORE / 'include'}", "-x", "c++", "-"]
    done = run(*command, input="\n".join(blocks))
    assert done.returncode == 0, done.stderr


def test_the_page_names_every_code() -> None:
    header = (CORE / "include/grasp/record.hpp").read_text()
    codes = re.search(r"enum Code \{ (.*?) \}", header)
    assert codes is not None
    assert set(re.findall(r"^\| `([A-Z_]+)`", (CORE / "README.md").read_text(), re.MULTILINE)) == set(
        codes[1].split(", ")
    )
