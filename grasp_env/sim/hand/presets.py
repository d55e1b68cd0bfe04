"""Real hands from published data: joint origins, ranges, masses and torque limits.

Allegro Hand V4, right (Wonik Robotics): joint origins, ranges and masses as in the manufacturer's
description of the hand; 0.7 N m is the largest joint torque in its data sheet. The continuous
torque is far smaller.

LEAP Hand, right (Shaw, Agarwal, Pathak: LEAP Hand: Low-Cost, Efficient, and Anthropomorphic Hand
for Robot Learning, RSS 2023): joint origins, ranges and masses as published by the authors, with
their limit of 0.95 N m for a joint.

Shapes are boxes with the dimensions of the parts; fingertips are spheres. Centres of mass and
inertias assume a uniform density in each link. Lengths in the tables are in millimetres, masses in
grams. The palm frame lies at the base of the middle finger, with z along the straight fingers and x
out of the palm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.inertia import Inertia, inertia_numbers
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Palm

Boxes: TypeAlias = tuple[tuple[float, float, float, float, float, float], ...]
"""Sides and centre of each [mm], link frame."""

_X = (1.0, 0.0, 0.0)
_Y = (0.0, 1.0, 0.0)
_Z = (0.0, 0.0, 1.0)
_STRAIGHT = (0.0, 0.0, 0.0)
_GREY = (0.55, 0.57, 0.61)
_DARK = (0.17, 0.19, 0.23)
_TIP = (0.93, 0.93, 0.90)


class _Row(NamedTuple):
    """A link: its name, joint origin [mm] and roll, pitch, yaw in the parent's frame, axis, range
    [rad], mass [g], boxes.
    """

    name: str
    origin: Vector3
    turn: Vector3
    axis: Vector3
    lower: float
    upper: float
    mass: float
    boxes: Boxes


class _Finger(NamedTuple):
    """A finger: its links from the palm outward, and centre and radius [mm] of the sphere at its
    end.
    """

    name: str
    rows: Sequence[_Row]
    tip: Vector3
    radius: float


def allegro() -> dict[str, Any]:
    """Return the arguments of a `HandDescription`: four fingers with four joints each."""
    splay = math.radians(5.0)
    masses = {"index": (11.9, 36.8), "middle": (5.0, 48.4), "ring": (5.0, 26.4)}
    fingers = [
        _Finger(
            name,
            (
                _Row(
                    "base",
                    (0.0, y, z),
                    (turn, 0.0, 0.0),
                    _Z,
                    -0.47,
                    0.47,
                    masses[name][0],
                    ((19.6, 27.5, 16.4, 0, 0, 8.2),),
                ),
                _Row(
                    "proximal",
                    (0.0, 0.0, 16.4),
                    _STRAIGHT,
                    _Y,
                    -0.196,
                    1.61,
                    65.0,
                    ((19.6, 27.5, 54.0, 0, 0, 27.0),),
                ),
                _Row(
                    "middle",
                    (0.0, 0.0, 54.0),
                    _STRAIGHT,
                    _Y,
                    -0.174,
                    1.709,
                    35.5,
                    ((19.6, 27.5, 38.4, 0, 0, 19.2),),
                ),
                _Row(
                    "distal",
                    (0.0, 0.0, 38.4),
                    _STRAIGHT,
                    _Y,
                    -0.227,
                    1.618,
                    masses[name][1],
                    ((19.6, 26.9, 21.0, 0, 0, 4.2),),
                ),
            ),
            (0.0, 0.0, 26.7),
            12.0,
        )
        for name, y, z, turn in (
            ("index", 43.5, -1.542, -splay),
            ("middle", 0.0, 0.7, 0.0),
            ("ring", -43.5, -1.542, splay),
        )
    ]
    out = (0.0, -math.radians(95.0), -0.5 * math.pi)
    thumb = _Finger(
        "thumb",
        (
            _Row(
                "base",
                (-18.2, 19.333, -45.987),
                out,
                (-1.0, 0.0, 0.0),
                0.263,
                1.396,
                17.6,
                ((35.8, 34.0, 45.5, -17.9, 9, 14.5),),
            ),
            _Row(
                "proximal",
                (-27.0, 5.0, 39.9),
                _STRAIGHT,
                _Z,
                -0.105,
                1.163,
                11.9,
                ((19.6, 27.5, 17.7, 0, 0, 8.85),),
            ),
            _Row(
                "middle",
                (0.0, 0.0, 17.7),
                _STRAIGHT,
                _Y,
                -0.189,
                1.644,
                38.0,
                ((19.6, 27.5, 51.4, 0, 0, 25.7),),
            ),
            _Row(
                "distal",
                (0.0, 0.0, 51.4),
                _STRAIGHT,
                _Y,
                -0.162,
                1.719,
                55.6,
                ((19.6, 26.9, 39.1, 0, 0, 10.75),),
            ),
        ),
        (0.0, 0.0, 42.3),
        12.0,
    )
    palm = (
        (41.4, 112.0, 44.8, -9, 0, -23),
        (41.4, 53.8, 42.8, -9, -25.3, -66.7),
        (41.4, 72.0, 13.0, -9.3, -5.6, -88.7),
    )
    return _parts("allegro", [*fingers, thumb], palm, 0.7)


def leap() -> dict[str, Any]:
    """Return the arguments of a `HandDescription`: four fingers with four joints each, the first
    two with crossed axes.
    """
    fingers = [
        _Finger(
            name,
            (
                _Row(
                    "base",
                    (0.0, y, 0.0),
                    _STRAIGHT,
                    _Y,
                    -0.314,
                    2.23,
                    44.0,
                    (
                        (34.0, 20.0, 45.0, -26, -15, 39.5),
                        (20.0, 34.0, 6.0, 0, -15, 18),
                        (14.0, 4.0, 20.0, 0, -30, 5),
                        (14.0, 4.0, 20.0, 0, 1, 5),
                    ),
                ),
                _Row(
                    "side",
                    (-12.2, -14.5, 38.1),
                    _STRAIGHT,
                    _X,
                    -1.047,
                    1.047,
                    32.0,
                    ((22.0, 26.0, 34.0, 11, 0, 7.5),),
                ),
                _Row(
                    "middle",
                    (13.0, 14.3, 15.0),
                    _STRAIGHT,
                    _Y,
                    -0.506,
                    1.885,
                    37.0,
                    (
                        (34.0, 26.0, 22.0, -7, -15, 35),
                        (20.0, 34.0, 9.0, 0, -15, 19.5),
                        (14.0, 4.0, 20.0, 0, -30, 5),
                        (14.0, 4.0, 20.0, 0, 0, 5),
                    ),
                ),
                _Row(
                    "distal",
                    (0.0, -0.2, 36.1),
                    _STRAIGHT,
                    _Y,
                    -0.366,
                    2.042,
                    16.0,
                    (
                        (20.0, 30.0, 13.0, 0, -15, 20.5),
                        (14.0, 4.0, 20.0, 0, -30, 5),
                        (14.0, 4.0, 20.0, 0, 1, 5),
                    ),
                ),
            ),
            (1.1, -14.5, 39.2),
            11.0,
        )
        for name, y in (("index", 45.4), ("middle", 0.0), ("ring", -45.4))
    ]
    thumb = _Finger(
        "thumb",
        (
            _Row(
                "base",
                (2.9, 21.2, -62.2),
                _STRAIGHT,
                (0.0, 0.0, -1.0),
                -0.349,
                2.094,
                32.0,
                ((34.0, 26.0, 22.0, 7.5, 0, -11),),
            ),
            _Row(
                "side",
                (0.0, 14.3, -13.0),
                _STRAIGHT,
                _Y,
                -0.47,
                2.443,
                3.0,
                (
                    (33.0, 4.0, 18.0, 0, 1.5, 0),
                    (4.0, 20.0, 14.0, 15, 13, 0),
                    (4.0, 20.0, 14.0, -15, 13, 0),
                ),
            ),
            _Row(
                "middle",
                (-14.5, 17.0, 0.0),
                _STRAIGHT,
                _X,
                -1.2,
                1.9,
                38.0,
                (
                    (24.0, 40.0, 20.0, 14, 10.5, 0),
                    (18.0, 24.0, 10.0, 12, 18, -14),
                    (32.0, 4.0, 20.0, 15, 31, 0),
                    (4.0, 20.0, 14.0, -1, 42, 0),
                    (4.0, 20.0, 14.0, 29, 42, 0),
                ),
            ),
            _Row(
                "distal",
                (-0.2, 46.6, 0.0),
                _STRAIGHT,
                _X,
                -1.34,
                1.88,
                49.0,
                (
                    (24.0, 37.0, 20.0, 15, 8.5, 0),
                    (30.0, 4.0, 20.0, 14, 29, 0),
                    (18.0, 24.0, 8.0, 11, 18, -15),
                    (24.0, 9.0, 20.0, 15, 35, 0),
                ),
            ),
        ),
        (14.6, 51.2, 1.1),
        11.0,
    )
    palm = (
        (34.0, 26.0, 22.0, -7.7, 30.4, -1.9),
        (34.0, 26.0, 22.0, -7.7, -14.6, -1.9),
        (34.0, 26.0, 22.0, -7.7, -59.6, -1.9),
        (47.0, 120.0, 40.0, -7.2, -12.4, -32.9),
        (46.0, 54.0, 44.0, -7.2, -31, -70.9),
        (12.0, 50.0, 44.0, -24.5, 18, -70.9),
    )
    return _parts("leap", [*fingers, thumb], palm, 0.95)


def _parts(name: str, fingers: Sequence[_Finger], palm: Boxes, torque: float) -> dict[str, Any]:
    """Return the arguments of a `HandDescription` that is not placed."""
    solid = _boxes(palm)
    links = tuple(link for finger in fingers for link in _links(finger, torque))
    tips = tuple(
        Fingertip(
            finger.name,
            f"{finger.name}_{finger.rows[-1].name}",
            _metres(finger.tip),
            1e-3 * finger.radius,
        )
        for finger in fingers
    )
    return {
        "name": name,
        "palm": Palm("palm", solid, solid, _DARK),
        "links": links,
        "fingertips": tips,
        "placed": False,
    }


def _links(finger: _Finger, torque: float) -> list[Link]:
    links: list[Link] = []
    for row in finger.rows:
        last = row is finger.rows[-1]
        shapes = _boxes(row.boxes)
        ball = (Geometry("sphere", (1e-3 * finger.radius,), _metres(finger.tip)),) if last else ()
        looks = tuple(replace(shape, color=_TIP) for shape in ball)
        links.append(
            Link(
                f"{finger.name}_{row.name}",
                links[-1].name if links else "palm",
                _metres(row.origin),
                row.turn,
                row.axis,
                row.lower,
                row.upper,
                torque,
                1e-3 * row.mass,
                *_uniform(1e-3 * row.mass, (*shapes, *ball)),
                (*shapes, *ball),
                (*shapes, *looks),
                _GREY,
            )
        )
    return links


def _metres(row: Sequence[float]) -> Vector3:
    x, y, z = (1e-3 * value for value in row)
    return x, y, z


def _boxes(boxes: Boxes) -> tuple[Geometry, ...]:
    return tuple(Geometry("box", _metres(box[:3]), _metres(box[3:])) for box in boxes)


def _uniform(mass: float, shapes: Sequence[Geometry]) -> tuple[Vector3, Inertia]:
    """Return the centre of mass of boxes and balls of one density, and the inertia about it."""
    volumes = [
        math.prod(s.size) if s.kind == "box" else 4.0 / 3.0 * math.pi * s.size[0] ** 3
        for s in shapes
    ]
    masses = mass * np.array(volumes) / sum(volumes)
    center = masses @ np.array([shape.origin for shape in shapes]) / mass
    total = np.zeros((3, 3))
    for part, shape in zip(masses.tolist(), shapes, strict=True):
        own = (
            np.square(shape.size) / 12.0
            if shape.kind == "box"
            else np.full(3, 0.2 * shape.size[0] ** 2)
        )
        arm = np.array(shape.origin) - center
        second = part * (np.diag(own) + np.outer(arm, arm))
        total += np.trace(second) * np.eye(3) - second
    x, y, z = center.tolist()
    return (x, y, z), inertia_numbers(total)
