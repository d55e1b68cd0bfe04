"""The golden files: outcomes as rows of numbers, the cases that make them, reading and writing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.force import ForceSolution, Objective
from grasp_env.grasp import Grasp

FOLDER = Path(__file__).parent
NUMBERS = ("iterations", "trials", "objective", "lower_bound", "residual", "margin")
_NONE = np.empty(0)
_SIX = np.full(6, np.nan)


@dataclass(frozen=True, eq=False)
class Problem:
    """What a solution is a solution of; never stored, the cases make it anew. Hard contacts, no limits."""

    grasp: Grasp
    wrench: np.ndarray
    method: str
    tolerance: float
    objective: Objective


@dataclass(frozen=True, eq=False)
class Outcome:
    """One row.

    Attributes:
        end: a status, or what kind of numbers these are.
        text: the start's name, or that of the numbers.
        numbers: (6,) `NUMBERS` [1, 1, objective, objective, N, N], nan where there are none.
        force: (N, 4) normal, o, t [N], torsion [N m]. start: (N, 3) [N].
        wrench, multipliers: (6,).
        extra: (K,) what else the case looks at: frames, torques, an observation.
        problem: see the class; None where nothing was solved.
    """

    end: str
    text: str = ""
    numbers: np.ndarray = field(default_factory=lambda: _SIX)
    force: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))
    start: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    wrench: np.ndarray = field(default_factory=lambda: _SIX)
    multipliers: np.ndarray = field(default_factory=lambda: _SIX)
    extra: np.ndarray = field(default_factory=lambda: _NONE)
    problem: Problem | None = None

    def __getattr__(self, name: str) -> float:
        if name in NUMBERS:
            return float(self.numbers[NUMBERS.index(name)])
        raise AttributeError(name)


def of_solution(solution: ForceSolution, problem: Problem) -> Outcome:
    """The row of a solution."""
    return Outcome(
        solution.status.value,
        solution.initial,
        np.array([
            solution.iterations, solution.trials, solution.objective, solution.lower_bound,
            solution.equilibrium_residual, solution.cone_margin,
        ]),
        np.column_stack([solution.force, solution.torsion]),
        np.array(solution.initial_force),
        np.array(solution.wrench),
        np.array(solution.multipliers),
        problem=problem,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Case:
    """A named call, or several in a row.

    Attributes:
        run: () -> the outcomes.
        tight: whether objective and forces are compared, besides what every solution has to prove.
        start: part of the largest component to which starts are compared; inf: not at all.
        close: the same for arrays that no solver made.
    """

    name: str
    run: Callable[[], list[Outcome]]
    tight: bool = False
    start: float = np.inf
    close: float = 1e-12


def named(cases: list[Case]) -> dict[str, Case]:
    """Cases by name, each name once."""
    found = {case.name: case for case in cases}
    assert len(found) == len(cases), sorted(case.name for case in cases)
    return found


def save(path: Path, cases: Iterable[tuple[str, list[Outcome]]]) -> None:
    """Writes rows column by column: no pickles, and the same bytes from the same numbers."""
    rows = [(name, row) for name, outcomes in cases for row in outcomes]
    columns: dict[str, Any] = {
        "case": np.array([name for name, _ in rows]),
        "end": np.array([row.end for _, row in rows]),
        "text": np.array([row.text for _, row in rows]),
    }
    for name in ("numbers", "wrench", "multipliers"):
        columns[name] = np.array([getattr(row, name) for _, row in rows])
    for name in ("force", "start", "extra"):
        columns[f"{name}_size"] = np.array([getattr(row, name).size for _, row in rows])
        columns[name] = np.concatenate([getattr(row, name).reshape(-1) for _, row in rows])
    np.savez_compressed(path, **columns)


def load(path: Path) -> dict[str, list[Outcome]]:
    """The rows of every case in a file that `save` wrote."""
    with np.load(path, allow_pickle=False) as file:
        columns = {name: file[name] for name in file.files}
    parts = {
        name: np.split(columns[name], np.cumsum(columns[f"{name}_size"])[:-1]) for name in ("force", "start", "extra")
    }
    found: dict[str, list[Outcome]] = {}
    for k, name in enumerate(columns["case"]):
        row = Outcome(
            str(columns["end"][k]),
            str(columns["text"][k]),
            columns["numbers"][k],
            parts["force"][k].reshape(-1, 4),
            parts["start"][k].reshape(-1, 3),
            columns["wrench"][k],
            columns["multipliers"][k],
            parts["extra"][k],
        )
        found.setdefault(str(name), []).append(row)
    return found
