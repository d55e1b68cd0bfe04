"""The front in C++ and its Python binding do not drift apart: every public name is bound, in the stub and on a page."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CORE = ROOT / "grasp_env/core"
FRONT = ("optimizer.hpp", "problem.hpp", "record.hpp")
PLACES = {
    "bound": [*(CORE / "bindings").glob("*.[ch]pp"), ROOT / "grasp_env/force/solution.py"],
    "in the stub or a list of names": [CORE / "_core.pyi", ROOT / "grasp_env/force/solution.py", ROOT / "grasp_env/force/options.py"],
    "on a page": [CORE / "README.md", ROOT / "grasp_env/force/solution.py", ROOT / "docs/choosing.md"],
}  # fmt: skip
IN_PYTHON = {
    "Options.limit": "max_iterations", "Options.step_rule": "rule", "Problem.limits": "min_normal", "Request.previous": "before",
    "ForceOptimizer.forget": "previous", "Code.LIMIT": "iteration_limit", "Summary.residual": "equilibrium_residual",
    "Summary.margin": "cone_margin", "Summary.replaced": "start_replaced", "Record.prices": "limit_multipliers",
}  # fmt: skip
"""What is called otherwise there."""
CPP_ALONE = {
    "Options.gap": "the tolerance that holds, from the options",
    "Changes.empty": "whether a call has anything of its own",
    "Record.clear": "writes a record",
    "Record.refute": "writes a record",
    "Record.has_force": "Python raises where there is none",
    "Record.summary": "Python's solutions have its fields as attributes",
    "Summary.joints": "Python's arrays know their lengths",
    "Summary.limits": "Python's arrays know their lengths",
    "Request.adjustment": "an action of the environment",
    "Request.now": "Python's keywords are its fields",
    "Start.central": "names where conic begins; nobody asks for it",
    "Start.standard": "initial=None",
    "Start.guess": "`Repair`",
    "Code.RANK_LOST": "`RankDeficientGraspError`",
}
"""What Python has no name for, and why."""


@cache
def names() -> tuple[str, ...]:
    """`Class.member` of every public member of the front."""
    found = set()
    for header in FRONT:
        text = re.sub(r"\s*//.*", "", (CORE / "include/grasp" / header).read_text())
        for kind, name, body in re.findall(r"\n(enum class|enum|struct|class) (\w+)[^;{]*\{(.*?)\n\};", text, re.S):
            public = body.partition("public:")[2] if kind == "class" else body
            for line in public.partition("private:")[0].splitlines():
                if re.match(r" {4}\w", line):  # not what stands inside of a function
                    found.update(f"{name}.{member}" for member in members(line) if member != name)
    return tuple(sorted(found))


def members(line: str) -> list[str]:
    """The names that a line declares."""
    if call := re.search(r"(\w+)\(", re.sub(r"[{=].*", "", line)):
        return [call[1]]
    plain = re.sub(r"<[^<>]*>|\{[^{}]*\}| = [^,;]*", "", line)
    return [part.split()[-1] for part in re.split(r"[,;]", plain) if part.split() and part.split()[-1].isidentifier()]


@cache
def words(place: str) -> frozenset[str]:
    return frozenset(re.findall(r"\w+", "\n".join(path.read_text() for path in PLACES[place])))


@pytest.mark.parametrize("place", PLACES)
def test_every_public_name_is(place: str) -> None:
    missing = []
    for name in names():
        if name in CPP_ALONE:
            continue
        member = name.split(".")[1]
        allowed = {member, member.lower(), IN_PYTHON.get(name, member)}
        if not allowed & words(place):
            missing.append(name)
    assert not missing, f"not {place}: bind and describe them, or say in CPP_ALONE why not"


def test_the_lists_name_what_is_there() -> None:
    assert set(IN_PYTHON) | set(CPP_ALONE) <= set(names())
    assert {"ForceOptimizer.solve", "Options.elastic", "Changes.friction", "Summary.margin", "Method.conic"} <= set(
        names()
    )


def test_a_new_name_is_seen() -> None:
    assert members("    Doubles jerk{}, snap{};") == ["jerk", "snap"]
    assert members("    std::span<const double, 6> wrench() const { return wrench_; }") == ["wrench"]
    assert members("    double tolerance = 0.0;") == ["tolerance"]
