"""This project's solver: from Python, and as C functions compiled from its C++ front (`ours.cpp`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchmarks.force.build import library
from benchmarks.force.entrant import Answer, Library, Task
from benchmarks.force.package import grasp_of, margin_of
from benchmarks.force.problems import Array, Problem
from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import BarzilaiBorweinStep, ForceOptimizer
from grasp_env.force.solution import ForceSolution, Status
from grasp_env.grasp import Grasp

TOLERANCE = 1e-6
HERE = Path(__file__).with_name("ours.cpp")
CORE = HERE.parents[3] / "grasp_env/core"


class _FromPython:
    """`ForceOptimizer.solve`; changed contacts and limits are arguments of the call."""

    objectives: tuple[str, ...] = ("phi",)
    margins = True
    options: ClassVar[dict[str, Any]] = {"method": "newton"}
    note = "ForceOptimizer.solve, certified gap 1e-6, certificate included"

    def setup(self, task: Task) -> None:
        first = task.first
        grasp, self._limits = grasp_of(first)
        self._margin = margin_of(first)
        self._soft = first.torsional_friction is not None
        self._warm = task.mode == "warm" and task.objective == "phi"
        self._optimizer = self._make(grasp, "previous" if self._warm else None)
        self._solve = self._optimizer.solve
        names = ("positions", "normals", "friction", "jacobian", "torque_bias")
        self._moves = [name for name in names if getattr(first, name) is not None]
        self._loses = first.touching is not None

    def _make(self, grasp: Grasp, initial: Any) -> ForceOptimizer:
        options = {"limits": self._limits, "margin": self._margin, **self.options}
        return ForceOptimizer(grasp, initial=initial, tolerance=TOLERANCE, **options)

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        names = self._moves if problem.moved else ()
        changes: dict[str, Any] = {name: getattr(problem, name) for name in names}
        if self._margin is not None and problem.moved:
            changes["margin"] = margin_of(problem)
        if self._loses:
            changes["contacts"] = problem.touching
        if self._warm and start is None:
            self._optimizer.forget()
        try:
            solution = self._solve(problem.wrench, **changes)
            self.iterations = solution.iterations
        except InfeasibleWrenchError as error:
            solution = error.solution
        return self._answer(solution)

    def solve_many(self, problems: Sequence[Problem]) -> list[Answer]:
        """Solve a batch in vector registers, on one thread."""
        if self._loses or any(problem.moved for problem in problems):
            raise NotImplementedError
        wrenches = np.array([problem.wrench for problem in problems])
        return [self._answer(s) for s in self._optimizer.solve_many(wrenches, workers=1)]

    def _answer(self, solution: ForceSolution) -> Answer:
        force = solution.force
        if self._soft:
            force = np.column_stack([force, solution.torsion])
        multipliers = solution.multipliers
        if self._limits is not None:
            multipliers = np.concatenate([multipliers, solution.limit_multipliers])
        if solution.status is Status.INFEASIBLE:
            return None, multipliers, "infeasible"
        return force, multipliers, "solved" if solution.status is Status.OPTIMAL else "failed"


class ConicPython(_FromPython):
    """Least sum of normal forces by the interior point."""

    name = "conic_python"
    objectives = ("sum",)
    options: ClassVar[dict[str, Any]] = {"method": "conic"}


class NewtonPython(_FromPython):
    """Least Phi by Newton."""

    name = "newton_python"


class FlowPython(_FromPython):
    """Least Phi by the paper's reduced flow from its 12-basis."""

    name = "flow_python"
    options: ClassVar[dict[str, Any]] = {
        "method": "reduced_flow",
        "step_rule": BarzilaiBorweinStep(),
    }


class LearnedPython(_FromPython):
    """Newton from the shipped network; problems unlike its training have the default start."""

    name = "learned_python"
    division = "learned"

    def _make(self, grasp: Grasp, initial: Any) -> ForceOptimizer:
        from policies import LearnedInitialForce

        rule = LearnedInitialForce.pretrained(remembers=initial is not None)
        self.training_seconds = rule.checkpoint.card["seconds"]
        return super()._make(grasp, rule)


class _Compiled(Library):
    """A function of ours.cpp, compiled once for this machine."""

    note = "the C++ front, -O3 -march=native, timed in C; certified gap 1e-6, certificate included"
    margins = True

    def __init__(self) -> None:
        include = CORE / "include"
        flags = [
            *("-std=c++20", "-O3", "-march=native", "-ffp-contract=fast"),
            *("-fno-math-errno", "-fno-trapping-math", "-Wno-psabi", f"-I{include}"),
        ]
        headers = [HERE.parents[1] / "force.h", *sorted(include.rglob("*.hpp"))]
        super().__init__(str(library("ours", [HERE], flags, headers, cpp=True)), self.name)


class Conic(_Compiled):
    """Least sum of normal forces by the interior point."""

    name = "conic"
    objectives = ("sum",)


class Newton(_Compiled):
    """Least Phi by Newton; warm: from the last solution."""

    name = "newton"
    objectives = ("phi",)


class Flow(_Compiled):
    """Least Phi by the paper's reduced flow from its 12-basis, with the short Barzilai-Borwein step."""

    name = "flow"
    objectives = ("phi",)
