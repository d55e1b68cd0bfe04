"""Measures of grasp quality: closure margin, Ferrari and Canny's epsilon, singular values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from grasp_env.grasp.grasp import Grasp, as_grasp, transmitted_matrix
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, Wrench, positive
from grasp_env.quality.closure import force_closure
from grasp_env.quality.worst_wrench import WrenchBall, worst_case


class Epsilon(NamedTuple):
    """Result of `epsilon`.

    Attributes:
        lower: certified lower bound of epsilon [N per N].
        upper: certified upper bound.
        wrench: (6,) the wrench that needs the largest force [N, N m].
    """

    lower: float
    upper: float
    wrench: Wrench


def epsilon(
    grasp: Grasp,
    length: float | None = None,
    criterion: str = "sum",
    *,
    tolerance: float = 0.01,
    starts: int = 32,
    points: int = 400,
    seed: int = 0,
) -> Epsilon:
    """Return bounds of Ferrari and Canny's quality (1992, "Planning optimal grasps").

    Epsilon is the radius of the largest ball {w: |F|^2 + |M|^2 / length^2 <= epsilon^2}, moments
    about the object origin, whose wrenches are balanced by forces whose sum of normals is <= 1 N
    (their Q_1) or whose normals are all <= 1 N (their Q_infinity). It is the inverse of the cost of
    the worst wrench of the unit ball, see `worst_case`. It is 0 without force closure.

    Args:
        grasp: the contacts, of any models.
        length: length that converts moments to forces [m]; None: `grasp.length`, or 1 m for one
            contact.
        criterion: size of a force: "sum" or "max" of its normal forces.
        tolerance, starts, points, seed: see `worst_case`.

    Example:
        >>> from grasp_env.grasp import Grasp
        >>> pinch = Grasp.from_contacts(
        ...     [[0, 0, -0.02], [0, 0, 0.02]], [[0, 0, 1], [0, 0, -1]], 0.5, contact_model="soft", torsional_friction=0.005
        ... )
        >>> low, high, wrench = epsilon(pinch)   # the weakest direction is the moment about z: torsional friction / length
        >>> low <= 0.25 <= high <= 1.01 * low, float(abs(wrench[5]))
        (True, 0.02)
    """
    ball = WrenchBall(1.0, _length(grasp, length))
    worst = worst_case(
        grasp, ball, criterion, tolerance=tolerance, starts=starts, points=points, seed=seed
    )
    return Epsilon(1.0 / worst.upper, 1.0 / worst.lower, worst.wrench)


def _length(grasp: Grasp, length: float | None) -> float:
    if length is None:
        return as_grasp(grasp).length or 1.0
    return positive(length, "length", ranges.LENGTH)


@dataclass(frozen=True, eq=False)
class GraspQuality:
    """Result of `quality`; moments about the object origin, divided by `length`.

    Attributes:
        closure_margin: `ForceClosure.margin`, 0 to 1 / (N + 1).
        epsilon_sum: Ferrari and Canny's epsilon per newton of total normal force (1992, Q_1).
        epsilon_max: epsilon per newton of the largest normal force (Q_infinity), >= epsilon_sum.
        min_singular_value: smallest singular value of G [N per N]. It is the smallest norm of G f
            over contact forces f of norm one that are orthogonal to the internal forces (Li, Sastry
            1988, "Task-oriented optimal grasping by multifingered robot hands"). It ignores the
            cones.
        isotropy: smallest over largest singular value, 0 to 1 (Kim, Oh, Yi, Suh 2001; Roa, Suarez
            2015, Sec. 2.1).
        length: the grasp's length [m].
    """

    closure_margin: float
    epsilon_sum: Epsilon
    epsilon_max: Epsilon
    min_singular_value: float
    isotropy: float
    length: float


def singular_values(grasp: Grasp, length: float | None = None) -> Array:
    """Return the singular values (6,) of G [N per N], decreasing, of transmitted components.

    Moments and torsions are divided by `length` [m] (None: the grasp's).

    Example:
        >>> from grasp_env.grasp import presets
        >>> singular_values(presets.tripod()).round(3)
        array([1.732, 1.732, 1.732, 1.732, 1.225, 1.225])
    """
    scale = _length(as_grasp(grasp), length)
    matrix = transmitted_matrix(grasp, scale)
    matrix[3:] /= scale
    return np.asarray(np.linalg.svd(matrix, compute_uv=False), dtype=np.float64)


def quality(
    grasp: Grasp, *, tolerance: float = 0.01, starts: int = 32, points: int = 400, seed: int = 0
) -> GraspQuality:
    """Return the quality measures of a grasp.

    `worst_case` documents tolerance, starts, points and seed.

    Example:
        >>> from grasp_env.grasp import presets
        >>> tripod = quality(presets.tripod())
        >>> tripod.closure_margin, tripod.epsilon_sum.lower, tripod.epsilon_max.lower, tripod.isotropy
        (0.25, 0.29, 0.67, 0.71)
    """
    by_sum, by_max = (
        epsilon(
            grasp, None, criterion, tolerance=tolerance, starts=starts, points=points, seed=seed
        )
        for criterion in ("sum", "max")
    )
    values = singular_values(grasp)
    return GraspQuality(
        force_closure(grasp).margin,
        by_sum,
        by_max,
        float(values[-1]),
        float(values[-1] / values[0]),
        grasp.length,
    )
