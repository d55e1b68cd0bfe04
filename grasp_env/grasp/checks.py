"""Checks of contact geometry: points, tangents, the place and size of a grasp, rank of G."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from grasp_env.core import along_normal, normalise
from grasp_env.errors import InvalidInputError, RankDeficientGraspError, shown
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array

RANK_TOLERANCE = 1e-8
"""Least ratio of singular values of G, moments divided by the grasp's length, for rank 6."""
DEFAULT_TANGENTS = np.zeros((0, 3))
"""Tangents for the default rule."""


def checked_points(positions: ArrayLike) -> Array:
    """Return contact points (N, 3)."""
    points = as_array(positions, (None, 3), "positions")
    if len(points) > ranges.CONTACTS:
        raise InvalidInputError(
            f"positions must have at most {ranges.CONTACTS} contacts, got {len(points)}"
        )
    return points


def normalise_normals(normals: Array) -> None:
    """Scale normals (N, 3) to unit length in place; raise if one is more than 1 % off."""
    before = normals.copy()
    worst = normalise(normals)
    if worst >= 0:
        raise InvalidInputError(
            f"normals must be unit vectors into the object, with a length of one to 1 %; normal {worst} is {before[worst].tolist()} "
            f"with length {math.hypot(*before[worst]):.6g}: divide it by its length"
        )


def check_place(count: int, size: float, centre: Array) -> None:
    """Raise if several contacts are too close together, too far apart, or far from the origin."""
    if count == 0:
        raise InvalidInputError("positions must have at least one contact, got none")
    if count == 1:
        return
    if not ranges.LENGTH.low <= size <= ranges.LENGTH.high:
        raise InvalidInputError(
            f"positions must lie within {ranges.LENGTH} of their centre (root mean square), got {size:g} m: give them in metres"
        )
    if (far := math.hypot(*centre.tolist())) > ranges.DISTANCE * size:
        raise InvalidInputError(
            f"positions must have their centre within {ranges.DISTANCE:g} times their length, {size:g} m, of the origin, got {far:g} m: "
            "put the object frame's origin near the contacts"
        )


def check_torsion(gamma: Array, length: float) -> None:
    """Raise if torsional friction is too large for the grasp's size; one contact has no size."""
    most = ranges.TORSIONAL_LEVER * length
    if length > 0.0 and (gamma > most).any():
        raise InvalidInputError(
            f"torsional_friction must be at most {ranges.TORSIONAL_LEVER:g} times the grasp's length, {most:g} m, got {shown(gamma)}: "
            "a fingertip has about 0.005 m"
        )


def checked_tangents(tangents: ArrayLike | None, normals: Array) -> Array:
    """Return directions for o (N, 3), not along a normal; (0, 3) for the default rule."""
    if tangents is None:
        return DEFAULT_TANGENTS
    along: Array = as_array(tangents, (len(normals), 3), "tangents")
    worst = along_normal(along, normals)
    if worst >= 0:
        raise InvalidInputError(
            f"tangent {worst} is {along[worst].tolist()}, along its normal {normals[worst].tolist()}: give a direction "
            "in the tangent plane"
        )
    return along


def rank_of(singular: np.ndarray) -> int:
    """Return the rank of a G in unit moments from its `singular` values (K,)."""
    return int((singular > RANK_TOLERANCE * singular.max(initial=1e-300)).sum())


def rank_error(rank: int, count: int, hint: str = "") -> RankDeficientGraspError:
    """Return the error for a rank below 6."""
    return RankDeficientGraspError(
        f"rank(G) = {rank} < 6 with {count} contact{'s' * (count != 1)}: some wrenches cannot be balanced. Use at least three contacts "
        f"with friction that do not lie on one line, or two soft ones{hint}"
    )


def checked_pseudoinverse(matrix: Array, frame: Array, count: int) -> Array:
    """Return the least-norm inverse of G (6, K), with its rank decided in a `frame` (6, 6)."""
    if not (np.isfinite(matrix).all() and np.isfinite(frame).all()):
        # only from `unchecked`
        raise InvalidInputError("positions, normals and tangents must be finite")
    u, s, vt = np.linalg.svd(frame @ matrix, full_matrices=False)
    if len(s) < 6 or s[-1] < RANK_TOLERANCE * s[0]:
        raise rank_error(rank_of(s), count)
    # least norm in force: with full row rank (T G)^+ T = G^+
    return (vt.T / s) @ u.T @ frame
