"""Convex shapes as the corners of their hulls: outlines of shapes, simplified hulls, cut and shrunk
hulls.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.tree import Geometry, Vector3
from grasp_env.sim.mesh_shape import numbered, sides_of

# of a hull; one that contains it replaces a larger one, and protrudes by 1/8 of a round end's
# radius
MAX_CORNERS = 40
_FLAT = 3e-8  # [m], largest ratio of volume to area (about half of the thickness) of a flat shape
_NOWHERE: Vector3 = (0.0, 0.0, 0.0)
_THIN = 5e-4  # [m], thickness that is added to a flat shape on either side


def outline(shape: Geometry) -> Array:
    """Return points (K, 3) [m], link frame, whose hull is the shape.

    The hull of a round shape is up to 4 % larger. A mesh has no points.
    """
    place = Frame.of(shape.origin, shape.rotation)
    if shape.kind == "box":
        points = 0.5 * _SIGNS * shape.size
    elif shape.kind == "sphere":
        points = _BALL * shape.size[0]
    elif shape.kind in ("capsule", "cylinder"):
        ends = 0.5 * shape.size[1] * np.array([[[0.0, 0.0, -1.0]], [[0.0, 0.0, 1.0]]])
        points = ((_BALL if shape.kind == "capsule" else _RING) * shape.size[0] + ends).reshape(
            -1, 3
        )
    else:
        points = np.array(shape.corners, dtype=float).reshape(-1, 3)
    return points @ place.rotation.T + place.origin


def hull_shape(
    corners: Array,
    origin: Vector3 = _NOWHERE,
    rotation: Vector3 = _NOWHERE,
    color: Vector3 | None = None,
) -> Geometry:
    """Return the hull of corners (K, 3) [m] as a shape at `origin` [m], turned by roll, pitch and
    yaw `rotation` [rad].
    """
    return Geometry(
        "hull", (), origin, rotation, color, tuple((x, y, z) for x, y, z in corners.tolist())
    )


def hull_of(points: Array) -> ConvexHull:
    """Return the hull of points (K, 3) [m], of which there must be one and all finite; flat hulls
    are made 1 mm thick.
    """
    try:
        hull = ConvexHull(points)
        if hull.volume > _FLAT * hull.area:
            return hull
    except (QhullError, ValueError):
        pass
    if len(points) == 0 or not np.isfinite(points).all():
        raise ValueError("no finite points")
    axes = principal_axes(points)
    spread = np.ptp(points @ axes.T, axis=0)
    for axis in axes[spread < 2.0 * _THIN]:
        points = np.vstack([points - _THIN * axis, points + _THIN * axis])
    return ConvexHull(points)


def principal_axes(points: Array) -> Array:
    """Return the principal axes of points (K, 3) as unit rows (3, 3), smallest spread first."""
    away = points - points.mean(axis=0)
    return np.linalg.eigh(away.T @ away)[1].T


def few_corners(points: Array, most: int = MAX_CORNERS) -> Array:
    """Return at most `most` corners (K, 3) whose hull contains all points (K, 3); the hull's own
    corners if they are few.

    The point farthest outside is added until `most` is reached. Then all corners move outward until
    no point is outside.
    """
    hull = hull_of(points)
    points = hull.points[hull.vertices]
    if len(points) <= most:
        return points
    axes = principal_axes(points)
    heights = points @ np.vstack([axes, -axes]).T
    chosen = list(dict.fromkeys(heights.argmax(axis=0).tolist()))
    grain = 1e-5 * float(np.ptp(points, axis=0).max())
    while len(chosen) < most:
        faces = hull_of(points[chosen]).equations
        outside = (points @ faces[:, :3].T + faces[:, 3]).max(axis=1)
        outside[chosen] = 0.0
        if outside.max() <= grain:
            break
        chosen.append(int(outside.argmax()))
    corners = points[chosen]
    for _ in range(30):
        small = ConvexHull(corners)
        excess = np.maximum(
            (points @ small.equations[:, :3].T).max(axis=0) + small.equations[:, 3], 0.0
        )
        if excess.max() <= grain:
            break
        moves = np.zeros_like(corners)
        weights = np.full(len(corners), 1e-300)
        np.add.at(moves, small.simplices, (excess**2)[:, None, None] * small.equations[:, None, :3])
        np.add.at(weights, small.simplices, excess[:, None])
        corners = corners + 0.7 * moves / weights[:, None]
    small = hull_of(corners)
    middle = corners.mean(axis=0)
    faces = small.equations
    inner = -(faces[:, :3] @ middle + faces[:, 3])
    needed = (points @ faces[:, :3].T).max(axis=0) - faces[:, :3] @ middle
    return middle + max(1.0, float((needed / inner).max())) * (corners - middle)


def cut_below(points: Array, normal: Array, offset: float) -> Array:
    """Return corners of the part of the hull of points (K, 3) with normal @ x <= offset; none if
    that part is empty or flat.
    """
    hull = hull_of(points)
    heights = hull.points @ normal - offset
    edges = numbered(sides_of(hull.simplices))[0]
    a = heights[edges[:, 0]]
    b = heights[edges[:, 1]]
    crossing = a * b < 0.0
    at = (a[crossing] / (a[crossing] - b[crossing]))[:, None]
    cut = hull.points[edges[crossing, 0]] * (1.0 - at) + hull.points[edges[crossing, 1]] * at
    left = np.vstack([hull.points[hull.vertices][heights[hull.vertices] <= 0.0], cut])
    if len(left) < 4 or heights[hull.vertices].min() > -2.0 * _THIN:
        return np.empty((0, 3))
    return hull_of(left).points


def shrunk(points: Array, depth: float) -> Array:
    """Return corners of the hull of points (K, 3) [m] shrunk by `depth`, at most by a third of its
    largest inner ball's radius.
    """
    faces = np.unique(hull_of(points).equations.round(12), axis=0)
    rows = np.column_stack([faces[:, :3], np.ones(len(faces))])
    ball = linprog(
        (0.0, 0.0, 0.0, -1.0), A_ub=rows, b_ub=-faces[:, 3], bounds=(None, None), method="highs"
    ).x
    faces[:, 3] += min(depth, float(ball[3]) / 3.0)
    return np.unique(HalfspaceIntersection(faces, ball[:3]).intersections.round(9), axis=0)


def _sphere_points(count: int) -> Array:
    """Return points spread over a sphere by the golden angle, whose hull contains the unit ball."""
    heights = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turns = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(count)
    wide = np.sqrt(1.0 - heights * heights)
    points = np.column_stack([wide * np.cos(turns), wide * np.sin(turns), heights])
    return points / -ConvexHull(points).equations[:, 3].max()


_SIGNS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_TURNS = np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False)
_RING = np.column_stack([np.cos(_TURNS), np.sin(_TURNS), np.zeros(16)]) / math.cos(math.pi / 16)
_BALL = _sphere_points(100)
