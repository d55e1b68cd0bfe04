"""Scores of solutions, recomputed from their numbers and the problem alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.force.bounds import Measure
from benchmarks.force.entrant import STATUSES, Answer
from benchmarks.force.problems import Array, Problem

LEVELS = {"solved_coarse": 1e-4, "solved": 1e-6}
"""Largest gap to the reference, and largest violation of balance, cones and limits, of a solved
problem."""


class Parts(NamedTuple):
    """A result: force (N k,) and multipliers (6 + L,) or None, status, message of an error."""

    force: Array | None
    multipliers: Array | None
    status: str
    message: str = ""


def parts_of(problem: Problem, answer: Answer | Exception) -> Parts:
    """Copy a solver's result; errors and results that do not fit the problem are failures."""
    if isinstance(answer, Exception):
        return Parts(None, None, "failed", f"{type(answer).__name__}: {answer}"[:200])
    parts = answer if isinstance(answer, tuple) else (answer,)
    force, multipliers, status = (*parts, None, None, None)[:3]
    size = problem.matrix.shape[1]
    rows = 6 + len(problem.limit_bound)
    status = "solved" if status is None else status
    force = _numbers(force, size)
    multipliers = _numbers(multipliers, 6, rows)
    if multipliers is not None:
        multipliers = np.pad(multipliers, (0, rows - multipliers.size))
    if not isinstance(status, str) or status not in STATUSES:
        return Parts(force, multipliers, "failed", f"no status: {status!r}"[:200])
    if status == "solved" and force is None:
        return Parts(None, multipliers, "failed", f"no force of {size} finite numbers")
    return Parts(force, multipliers, status)


def score(problem: Problem, objective: str, best: float, answer: Parts) -> dict[str, Any]:
    """Return the columns of a result.

    Args:
        problem: the problem.
        objective: "sum" or "phi".
        best: the reference's optimum; inf: there is no force.
        answer: the parts.

    Returns:
        status; gap, balance, violation, limit_excess if there is a force; solved_coarse and solved;
        proved: the multipliers prove the optimum to 1e-6, or that there is no force; wrong: the
        verdict is false.
    """
    force, multipliers, status, message = answer
    wrong = status == ("solved" if best == np.inf else "infeasible")
    row: dict[str, Any] = {"status": status, "wrong": wrong}
    proved = False
    missed = np.inf
    measure = Measure.of(problem)
    if status == "infeasible" and best == np.inf:
        proved = multipliers is not None and measure.witness(multipliers) > 0.0
        missed = 0.0 if proved else np.inf
    elif status == "solved" and force is not None and best < np.inf:
        value = float(measure.objective(objective, force))
        level = LEVELS["solved"]
        misses = {
            "balance": measure.balance(force),
            "violation": measure.violation(force),
            "limit_excess": measure.excess(force),
        }
        row |= {"gap": abs(value - best) / best} | misses
        missed = max(row["gap"], *misses.values())
        if multipliers is not None and max(misses.values()) <= level:
            proved = bool(value - measure.lower(objective, multipliers) <= level * value < np.inf)
    if message:
        row["detail"] = message
    solved = {name: bool(missed <= level) for name, level in LEVELS.items()}
    return row | {"proved": proved} | solved


def _numbers(values: Any, *sizes: int) -> Array | None:
    """Return a flat copy; None if its size is another, or a number is not finite."""
    try:
        array = np.array(values, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        return None
    return array if array.size in sizes and np.isfinite(array).all() else None
