"""A golden case: a name and the calls it makes; and the loop that most of them share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from golden.grasps import SHIFT, about
from golden.record import Outcome, Problem, attempt, of_solution

from grasp_env.force import ForceOptimizer, Objective
from grasp_env.grasp import Grasp

FLOWS = ("reduced_flow", "full_flow")
TIGHT = {"reduced_flow": 1e-12, "full_flow": 1e-12, "newton": 1e-12, "conic": 1e-9}
"""Where solutions are compared digit by digit: the least relative gap that every method reaches; the conic ones stall below 1e-9."""


BASIS = 5e-5
"""Part of the largest component to which starts are compared that are made of the 12-basis: the recorded one is certified to 1e-10 of
Phi, so its forces are known to a few times 1e-5."""


@dataclass(frozen=True, eq=False)
class Case:
    """A named call, or several in a row.

    Attributes:
        run: () -> the outcomes.
        tight: whether objective and forces are compared, besides what every solution has to prove.
        start: part of the largest component to which starts are compared; inf: not at all.
        close: the same for arrays that no solver made.
        honest: part by which what a solution says of its objective may be off its force's.
    """

    name: str
    run: Callable[[], list[Outcome]]
    tight: bool = False
    start: float = np.inf
    close: float = 1e-12
    honest: float = 1e-9


def loads(name: str, wanted: np.ndarray) -> np.ndarray:
    """Wrenches (M, 6) given in metres about the object, in the units and about the origin of that grasp."""
    if name == "far":
        return np.array([about(each, SHIFT) for each in wanted])
    return wanted * np.array([1, 1, 1, 1e3, 1e3, 1e3]) if name == "millimetres" else wanted


def problem_of(grasp: Grasp, wrench: np.ndarray, options: dict[str, Any]) -> Problem:
    """What these options of `ForceOptimizer` ask."""
    method = options.get("method", "newton")
    return Problem(
        grasp,
        np.asarray(wrench),
        method,
        options.get("criterion", "sum"),
        options.get("tolerance") or (1e-6 if method == "conic" else 1e-4),
        Objective(options.get("force_weight", 1.0), options.get("barrier_weight", 0.01)),
        options.get("limits"),
    )


def solve(grasp: Grasp, wanted: np.ndarray, each: dict[str, Any] | None = None, **options: Any) -> list[Outcome]:
    """One optimizer, wrench after wrench; `each` goes to every `solve`."""
    rows: list[Outcome] = []
    optimizer: ForceOptimizer | None = None
    for wrench in wanted:
        problem = problem_of(grasp, wrench, options)

        def call(wrench: np.ndarray = wrench, problem: Problem = problem) -> Outcome:
            nonlocal optimizer
            optimizer = optimizer or ForceOptimizer(grasp, **options)
            return of_solution(optimizer.solve(wrench, **(each or {})), problem)

        rows.append(attempt(call, problem))
    return rows


def named(*groups: list[Case]) -> dict[str, Case]:
    """Cases by name, each name once."""
    every = [case for group in groups for case in group]
    found = {case.name: case for case in every}
    assert len(found) == len(every), sorted(case.name for case in every)
    return found
