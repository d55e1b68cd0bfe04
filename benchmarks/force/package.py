"""Conversion between problems and this package's contacts and limits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.force.problems import Problem
from grasp_env.force import ForceLimits, Margin
from grasp_env.grasp import Grasp

LIMITS = ("min_normal", "max_normal", "jacobian", "torque_limit", "torque_bias")
"""Fields of a problem that `ForceLimits` takes by the same names."""


def grasp_of(problem: Problem) -> tuple[Grasp, ForceLimits | None]:
    """Return the contacts of a problem, whether or not they touch, and its limits.

    The frames are the problem's up to rounding.
    """
    soft: dict[str, Any] = {}
    if (gamma := problem.torsional_friction) is not None:
        models = ["soft" if g > 0.0 else "hard" for g in gamma]
        soft = {"contact_model": models, "torsional_friction": np.where(gamma > 0.0, gamma, 1.0)}
    grasp = Grasp.from_contacts(problem.positions, problem.normals, problem.friction, **soft)
    limits: dict[str, np.ndarray] = {
        name: value for name in LIMITS if (value := getattr(problem, name)) is not None
    }
    return grasp, ForceLimits(**limits) if limits else None


def margin_of(problem: Problem) -> Margin | None:
    """Return the margin of a problem, if it has one."""
    if not problem.has_margin:
        return None
    return Margin(float(problem.share), 0.0 if problem.preload is None else problem.preload)


def problem_of(grasp: Grasp, wrench: ArrayLike, **others: Any) -> Problem:
    """Return a problem with the hard contacts of a grasp; `others` are further fields."""
    arrays = {name: np.array(getattr(grasp, name)) for name in ("positions", "frames", "friction")}
    return Problem(**{**arrays, "wrench": np.array(wrench, dtype=float), **others})
