"""Fit the fingertip: a sphere in the end of a finger's last link, with the link's other shapes cut
back behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.solids import cut_below, few_corners, hull_of, hull_shape, outline
from grasp_env.sim.hand.tree import Geometry, Link, Vector3

SMALLEST, LARGEST = 0.004, 0.015  # smallest and largest radius of fitted spheres [m]
# fraction of the largest distance: if the mean of the far points is nearer, it gives no direction
_MIDDLE = 0.25
_END = 0.03  # [m] length of the link's end in which the sphere is fitted
_SHORT = (0.001, 0.002, 0.004)  # [m], allowed gaps between the sphere and the end of the link
# a larger gap is chosen if the radius grows by more than this times the increase of the gap
_PRICE = 0.6


class Ball(NamedTuple):
    """A sphere in a link's frame [m]."""

    center: Vector3
    radius: float


def end_direction(points: Array, axis: Array, outward: Array) -> Array:
    """Return the unit direction (3,) in which a link ends: towards the points (K, 3) [m] farthest
    from the axis of its joint.

    The direction away from the palm, `outward`, decides if points are equally far on both sides, as
    for a jaw whose frame is in its middle.
    """
    flat = points - np.outer(points @ axis, axis)
    away = np.linalg.norm(flat, axis=1)
    far = flat[away >= 0.8 * away.max()]
    ends = far.mean(axis=0)
    if np.linalg.norm(ends) < _MIDDLE * away.max():
        beyond = far[far @ (outward - (outward @ axis) * axis) > 0.0]
        ends = beyond.mean(axis=0) if len(beyond) else far[0]
    return ends / max(float(np.linalg.norm(ends)), 1e-12)


def inscribed(pieces: Sequence[Array], direction: Array, axis: Array) -> Ball:
    """Return the largest sphere that fits in the end of a link and comes near its tip.

    The end is the part of the convex pieces (K, 3) within 3 cm of the farthest point along
    `direction`; its hull is used. If the end is wide, the sphere lies in its middle along `axis`.
    If the link is too thin, the sphere has a radius of 4 mm and protrudes.
    """
    far = max(float((piece @ direction).max()) for piece in pieces)
    ends = [end for piece in pieces if len(end := cut_below(piece, -direction, _END - far))]
    faces = hull_of(np.vstack(ends if ends else list(pieces))).equations
    normals = faces[:, :3]
    offsets = -faces[:, 3]
    best: tuple[float, Array, float, Array, Array] | None = None
    for short in _SHORT:
        # constraints on a sphere (c, r): normals @ c + r <= offsets, direction @ c + r >= far -
        # short, r <= LARGEST
        inside = np.column_stack([normals, np.ones(len(normals))])
        rows = np.vstack([inside, -np.append(direction, 1.0), (0.0, 0.0, 0.0, 1.0)])
        sides = np.append(offsets, (short - far, LARGEST))
        found = _best((0.0, 0.0, 0.0, 1.0), rows, sides)
        if found is not None and (best is None or found[3] - _PRICE * short > best[0]):
            best = float(found[3]) - _PRICE * short, found[:3], float(found[3]), rows, sides
    if best is None:  # the link is thinner than rounding errors
        center = np.vstack(ends if ends else list(pieces)).mean(axis=0)
        radius = 0.0
    else:
        _, center, radius, rows, sides = best
        # a slightly smaller sphere can move sideways even if a coarse hull leaves no other place
        # for the largest
        inside = rows[:, :3]
        spare = sides - 0.97 * radius * rows[:, 3]
        sideways = [_best(sign * axis, inside, spare) for sign in (1.0, -1.0)]
        low, high = (center if place is None else place for place in sideways)
        center = 0.5 * (low + high)
    x, y, z = center.tolist()
    return Ball((x, y, z), min(max(radius, SMALLEST), LARGEST))


def cut_back(link: Link, ball: Ball, direction: Array) -> Link:
    """Return the link with shapes that cover or surround the front of its tip's sphere cut off
    behind the sphere.
    """
    center = np.array(ball.center)
    back = float(np.dot(ball.center, direction)) - ball.radius
    shapes: list[Geometry] = []
    for shape in link.collision:
        points = outline(shape)
        front = cut_below(points, -direction, -float(center @ direction))
        if (
            (shape.kind == "sphere" and np.linalg.norm(np.array(shape.origin) - center) < 1e-9)
            or len(front) == 0
            or np.linalg.norm(front - center, axis=1).max() <= 0.9 * ball.radius
            # the sphere is not at this shape's end
            or (points @ direction).max() > float(center @ direction) + 3.0 * ball.radius
        ):
            shapes.append(shape)
        elif len(left := cut_below(points, direction, back)):
            shapes.append(hull_shape(few_corners(left), color=shape.color))
    return replace(link, collision=tuple(shapes))


def _best(gain: Sequence[float] | Array, rows: Array, sides: Array) -> Array | None:
    """Maximise gain @ x subject to rows @ x <= sides; None if there is no solution."""
    found = linprog(-np.asarray(gain), A_ub=rows, b_ub=sides, bounds=(None, None), method="highs")
    return None if found.x is None or not found.success else np.asarray(found.x)
