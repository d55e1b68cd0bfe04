"""Problems of the force benchmark whose limits bind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.force.problems import Problem, Session

TRACKS = ("own", "shared", "margin", "infeasible", "loop")
"""Tracks whose hands have limits."""
LEVER = 0.005
"""Torsional over tangential friction of contacts made soft [m]."""


def made_soft(problem: Problem) -> Problem:
    """The problem with soft contacts."""
    return replace(problem, torsional_friction=LEVER * problem.friction)


def drawn(session: Session, rng: np.random.Generator, count: int) -> list[Problem]:
    """Problems of a session with other wrenches: limits bind, and some have no force."""
    problems = [session.problems[k] for k in rng.integers(len(session.problems), size=count)]
    wrenches = [
        problem.wrench * rng.uniform(0.1, 1.6)
        + 0.3 * np.abs(problem.wrench).max() * rng.standard_normal(6) * np.repeat([1.0, 0.03], 3)
        for problem in problems
    ]
    return [replace(p, wrench=w) for p, w in zip(problems, wrenches, strict=True)]
