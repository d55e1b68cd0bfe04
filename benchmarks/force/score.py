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
    """Parts of a result: force (N k,) and multipliers (6 + L,), if there are any, status, and the
    message of an error.
    """

    force: Array | None
    multipliers: Array | None
    status: str
    message: str = ""


def parts_of(problem: Problem, answer: Answer | Exception) -> Parts:
    """Return copies of the parts of a solver's result; errors and results that do not fit the
    problem are failures.
    """
    if isinstance(answer, Exception):
        return Parts(None, None, "failed", f"{type(answer).__name__}: {answer}"[:200])
    parts = answer if isinstance(answer, tuple) else (answer,)
    force, multipliers, status = (*parts, None, None, None)[:3]
    size = problem.matrix.shape[1]
    prices = 6 + len(problem.limit_bound)
    status = "solved" if status is None else status
    made = _numbers(force, size)
    proof = _numbers(multipliers, 6, prices)
    if proof is not None:
        proof = np.pad(proof, (0, prices - proof.size))
    if not isinstance(status, str) or status not in STATUSES:
        return Parts(made, proof, "failed", f"no status: {status!r}"[:200])
    if status == "solved" and made is None:
        return Parts(None, proof, "failed", f"no force of {size} finite numbers")
    return Parts(made, proof, status)


def score(problem: Problem, objective: str, best: float, answer: Parts) -> dict[str, Any]:
    """Return the columns of a result.

    Args:
        problem: the problem.
        objective: "sum" or "phi".
        best: the reference's optimum; inf: there is no force.
        answer: the parts.

    Returns:
        status; gap, balance, violation, limit_excess where there is a force; solved_coarse and
        solved; proved: the multipliers
        prove the optimum to 1e-6, or that there is no force; wrong: the verdict is false.
    """
    force, multipliers, status, message = answer
    row: dict[str, Any] = {
        "status": status,
        "wrong": status == ("solved" if best == np.inf else "infeasible"),
    }
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
    return (
        row | {"proved": proved} | {name: bool(missed <= level) for name, level in LEVELS.items()}
    )


def _numbers(given: Any, *sizes: int) -> Array | None:
    """Return a copy as a flat array; None if its size is another, or a number is not finite."""
    try:
        array = np.array(given, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        return None
    return array if array.size in sizes and np.isfinite(array).all() else None
