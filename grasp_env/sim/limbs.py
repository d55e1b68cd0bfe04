"""How far the hand's links are from an object and from one another; links are capsules here."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from grasp_env._compile import compiled
from grasp_env.sim.hand import Geometry, HandDescription
from grasp_env.sim.hand_frames import rotation_matrix
from grasp_env.sim.kinematics_kernels import trace_hand
from grasp_env.sim.shapes import nearest

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_HALVINGS = 14  # leaves a thousandth of a limb's length
_GRID = (-1.0, 0.0, 1.0)
_PALM_GRID = tuple(np.linspace(-1.0, 1.0, 7).tolist())


class Limbs(NamedTuple):
    """Capsules that are fixed to links; C of them.

    Attributes:
        links: Number of the link, -1 for the palm, (C,) int64.
        starts: One end of the axis [m], link frame, (C, 3).
        ends: The other end, (C, 3).
        radii: [m], (C,).
        tips: 1 for a fingertip's own sphere, else 0, (C,) int64.
    """

    links: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray
    tips: np.ndarray


def hand_limbs(hand: HandDescription) -> Limbs:
    """The collision shapes of the palm and of all links; a box becomes lines along its longest side."""
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    spheres = {(numbers[tip.link], tip.radius, tip.center) for tip in hand.fingertips}
    links: list[int] = []
    rows: list[tuple[np.ndarray, np.ndarray, float]] = []
    tips: list[int] = []
    parts = [(-1, shape) for shape in hand.palm.collision]
    parts += [(index, shape) for index, link in enumerate(hand.links) for shape in link.collision]
    for link, shape in parts:
        is_tip = shape.kind == "sphere" and (link, shape.size[0], shape.origin) in spheres
        for row in _capsules(shape, _PALM_GRID if link < 0 else _GRID):
            links.append(link)
            rows.append(row)
            tips.append(int(is_tip))
    return Limbs(
        np.array(links, dtype=np.int64),
        np.array([row[0] for row in rows]).reshape(-1, 3),
        np.array([row[1] for row in rows]).reshape(-1, 3),
        np.array([row[2] for row in rows], dtype=float),
        np.array(tips, dtype=np.int64),
    )


def _capsules(shape: Geometry, grid: tuple[float, ...]) -> list[tuple[np.ndarray, np.ndarray, float]]:
    origin, frame = np.array(shape.origin), rotation_matrix(shape.rotation)
    if shape.kind == "box":
        half = 0.5 * np.array(shape.size)
        first, second, long = np.argsort(half).tolist()
        axis = half[long] * frame[:, long]
        lines = []
        for a in grid:
            for b in grid:
                middle = origin + a * half[first] * frame[:, first] + b * half[second] * frame[:, second]
                lines.append((middle - axis, middle + axis, 0.0))
        return lines
    radius = shape.size[0]
    half = 0.0 if shape.kind == "sphere" else 0.5 * shape.size[1]
    if shape.kind == "cylinder":
        half = max(half - 0.5 * radius, 0.0)  # the round ends make up for it
    return [(origin - half * frame[:, 2], origin + half * frame[:, 2], radius)]


@compiled
def write_limbs(limbs, chosen, frames, origins, starts, ends):
    """Write the ends of the chosen capsules [m], (C, 3) each, world frame, for links as `trace_hand` writes them."""
    for c in range(len(limbs.links)):
        if not chosen[c]:
            continue
        link = limbs.links[c]
        for k in range(3):
            if link < 0:
                starts[c, k], ends[c, k] = limbs.starts[c, k], limbs.ends[c, k]
                continue
            starts[c, k] = ends[c, k] = origins[link, k]
            for q in range(3):
                starts[c, k] += frames[link, k, q] * limbs.starts[c, q]
                ends[c, k] += frames[link, k, q] * limbs.ends[c, q]


@compiled
def surface_gap(surface, start, end, enough):
    """Least distance of a segment from a convex surface [m], by golden sections; stops where it is surely `enough`."""
    center, point, normal = np.empty(3), np.empty(3), np.empty(3)
    length = math.sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2 + (end[2] - start[2]) ** 2)
    low, high = 0.0, 1.0
    left, right = 1.0 - _GOLDEN, _GOLDEN
    gaps = (0.0, 0.0)
    for turn in range(_HALVINGS):
        if turn == 0:
            at_left = _gap_at(surface, start, end, left, center, point, normal)
            at_right = _gap_at(surface, start, end, right, center, point, normal)
        elif gaps[0] < gaps[1]:
            high, right, at_right = right, left, gaps[0]
            left = high - _GOLDEN * (high - low)
            at_left = _gap_at(surface, start, end, left, center, point, normal)
        else:
            low, left, at_left = left, right, gaps[1]
            right = low + _GOLDEN * (high - low)
            at_right = _gap_at(surface, start, end, right, center, point, normal)
        gaps = (at_left, at_right)
        # no point of the bracket is further from one of the two than the bracket is long
        if min(at_left, at_right) - (high - low) * length > enough or length == 0.0:
            break
    return min(gaps[0], gaps[1])


@compiled
def _gap_at(surface, start, end, part, center, point, normal):
    for k in range(3):
        center[k] = start[k] + part * (end[k] - start[k])
    return nearest(surface, center, point, normal)


@compiled
def segment_gap(a, b, c, d):
    """Least distance of the segments a-b and c-d [m] (Ericson 2005, 5.1.9)."""
    uu, vv, uv, ur, vr, rr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        u, v, r = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        uu, vv, uv = uu + u * u, vv + v * v, uv + u * v
        ur, vr, rr = ur + u * r, vr + v * r, rr + r * r
    s, t = 0.0, 0.0
    if uu > 0.0:
        spread = uu * vv - uv * uv
        if spread > 1e-12 * uu * vv:
            s = min(max((uv * vr - ur * vv) / spread, 0.0), 1.0)
        if vv > 0.0:
            t = (uv * s + vr) / vv
            if t < 0.0 or t > 1.0:
                t = min(max(t, 0.0), 1.0)
                s = min(max((t * uv - ur) / uu, 0.0), 1.0)
        else:
            s = min(max(-ur / uu, 0.0), 1.0)
    elif vv > 0.0:
        t = min(max(vr / vv, 0.0), 1.0)
    return math.sqrt(max(rr + s * s * uu + t * t * vv + 2.0 * s * ur - 2.0 * t * vr - 2.0 * s * t * uv, 0.0))


@compiled
def hand_clearance(tree, limbs, surface, angles):
    """Least distance of the links, without fingertips, from the object, and of links and tips from one another [m]."""
    count = len(angles)
    frames, origins, axes = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    starts, ends = np.empty((len(limbs.links), 3)), np.empty((len(limbs.links), 3))
    trace_hand(tree, angles, frames, origins, axes)
    write_limbs(limbs, np.ones(len(limbs.links), np.bool_), frames, origins, starts, ends)
    away, apart = math.inf, math.inf
    for c in range(len(limbs.links)):
        if limbs.tips[c] == 0:
            away = min(away, surface_gap(surface, starts[c], ends[c], math.inf) - limbs.radii[c])
        for e in range(c):
            one, other = limbs.links[c], limbs.links[e]
            # neighbours overlap around their joint; Bullet leaves them out too
            if one == other or tree.parents[max(one, other)] == min(one, other):
                continue
            gap = segment_gap(starts[c], ends[c], starts[e], ends[e]) - limbs.radii[c] - limbs.radii[e]
            apart = min(apart, gap)
    return away, apart
