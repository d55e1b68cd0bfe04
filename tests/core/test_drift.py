"""Every public name of the C++ front is bound in Python, in the stub and documented."""

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
    "in the stub or a list of names": [
        CORE / "_core.pyi",
        ROOT / "grasp_env/force/solution.py",
        ROOT / "grasp_env/force/options.py",
    ],
    "on a page": [
        CORE / "README.md",
        ROOT / "grasp_env/force/solution.py",
        ROOT / "docs/choosing.md",
    ],
}
IN_PYTHON = {
    "Options.limit": "max_iterations",
    "Options.step_rule": "rule",
    "Problem.limits": "min_normal",
    "Request.previous": "before",
    "ForceOptimizer.forget": "previous",
    "Code.LIMIT": "iteration_limit",
    "Summary.residual": "equilibrium_residual",
    "Summary.margin": "cone_margin",
    "Summary.replaced": "start_replaced",
}
"""Names that differ in Python."""
CPP_ALONE = {
    "Options.gap",
    "Changes.keeps_problem",
    "Request.now",
    "Summary.joints",
    "Summary.limits",
    "Record.has_force",
    "Record.summary",  # attributes do it
    "Record.clear",
    "Record.refute",  # which write records
    "Start.standard",
    "Start.guess",
    "Start.central",
    "Request.adjustment",
    "Code.RANK_LOST",  # None, `Repair`, the environment, an error
}
"""Names that Python lacks."""


@cache
def names() -> tuple[str, ...]:
    """`Class.member` of every public member of the front."""
    found = set()
    for header in FRONT:
        text = re.sub(r"\s*//.*", "", (CORE / "include/grasp" / header).read_text())
        text = re.sub(r"\n {6,}", " ", text)  # the rest of a line
        for kind, name, body in re.findall(
            r"\n(enum class|enum|struct|class) (\w+)[^;{]*\{(.*?)\n\};", text, re.S
        ):
            public = body.partition("public:")[2] if kind == "class" else body
            for line in public.partition("private:")[0].splitlines():
                if re.match(r" {2}\w", line):  # not what stands inside of a function
                    found.update(f"{name}.{member}" for member in members(line) if member != name)
    return tuple(sorted(found))


def members(line: str) -> list[str]:
    """Names that a line declares."""
    if call := re.search(r"(\w+)\(", re.sub(r"[{=].*", "", line)):
        return [call[1]]
    plain = re.sub(r"<[^<>]*>|\{[^{}]*\}| = [^,;]*", "", line)
    return [
        part.split()[-1]
        for part in re.split(r"[,;]", plain)
        if part.split() and part.split()[-1].isidentifier()
    ]


@cache
def words(place: str) -> frozenset[str]:
    return frozenset(re.findall(r"\w+", "\n".join(path.read_text() for path in PLACES[place])))


@pytest.mark.parametrize("place", PLACES)
def test_every_public_name_is(place):
    def known(name: str) -> bool:
        member = name.split(".")[1]
        return name in CPP_ALONE or bool(
            {member, member.lower(), IN_PYTHON.get(name, member)} & words(place)
        )

    missing = [name for name in names() if not known(name)]
    assert not missing, f"not {place}: bind and describe them, or add them to CPP_ALONE"


def test_the_lists_hold_existing_names_only():
    assert set(IN_PYTHON) | CPP_ALONE <= set(names())
    assert {
        "ForceOptimizer.solve",
        "Options.elastic",
        "Changes.friction",
        "Summary.margin",
        "Method.conic",
    } <= set(names())
    assert members("    Doubles jerk{}, snap{};") == ["jerk", "snap"]  # a new name is found
    assert members("    std::span<const double, 6> wrench() const { return wrench_; }") == [
        "wrench"
    ]
