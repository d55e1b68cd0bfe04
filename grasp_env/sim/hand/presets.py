"""Real hands from published data: joint origins, ranges, masses and torque limits.

Allegro Hand V4, right (Wonik Robotics): joint origins, ranges and masses as in the manufacturer's
description of the hand; 0.7 N m is the largest joint torque in its data sheet. The continuous
torque is far smaller.

LEAP Hand, right (Shaw, Agarwal, Pathak: LEAP Hand: Low-Cost, Efficient, and Anthropomorphic Hand
for Robot Learning, RSS 2023): joint origins, ranges and masses as published by the authors, with
their limit of 0.95 N m for a joint.

Shapes are boxes with the dimensions of the parts; fingertips are spheres. Centres of mass and
inertias assume a uniform density in each link. The palm frame lies at the base of the middle
finger, with z along the straight fingers and x out of the palm.

A table has a row for each link of a finger, from the palm outward: its joint's origin [mm] and
roll, pitch and yaw [deg] in the parent's frame, its axis, range [rad], mass [g], and the sides and
centre of a box [mm]. Rows without a name are more boxes of the same link. The last row is the
centre and radius of the tip [mm].
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.inertia import Inertia, inertia_numbers
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Palm

_GREY = (0.55, 0.57, 0.61)
_DARK = (0.17, 0.19, 0.23)
_TIP = (0.93, 0.93, 0.90)

_ALLEGRO_FINGER = """
base     | 0 {y} {z} | {roll} 0 0 | 0 0 1 | -0.47  0.47  | {base}   | 19.6 27.5 16.4 | 0 0 8.2
proximal | 0 0 16.4  | 0 0 0      | 0 1 0 | -0.196 1.61  | 65       | 19.6 27.5 54   | 0 0 27
middle   | 0 0 54    | 0 0 0      | 0 1 0 | -0.174 1.709 | 35.5     | 19.6 27.5 38.4 | 0 0 19.2
distal   | 0 0 38.4  | 0 0 0      | 0 1 0 | -0.227 1.618 | {distal} | 19.6 26.9 21   | 0 0 4.2
tip      | 0 0 26.7  | 12
"""
_ALLEGRO_THUMB = """
base     | -18.2 19.333 -45.987|0 -95 -90|-1 0 0|  0.263 1.396| 17.6| 35.8 34 45.5  | -17.9 9 14.5
proximal | -27 5 39.9          |0   0   0| 0 0 1| -0.105 1.163| 11.9| 19.6 27.5 17.7| 0 0 8.85
middle   | 0 0 17.7            |0   0   0| 0 1 0| -0.189 1.644| 38  | 19.6 27.5 51.4| 0 0 25.7
distal   | 0 0 51.4            |0   0   0| 0 1 0| -0.162 1.719| 55.6| 19.6 26.9 39.1| 0 0 10.75
tip      | 0 0 42.3            |12
"""
_ALLEGRO_PALM = """
41.4 112   44.8 | -9     0   -23
41.4  53.8 42.8 | -9   -25.3 -66.7
41.4  72   13   | -9.3  -5.6 -88.7
"""
_LEAP_FINGER = """
base   | 0 {y} 0          | 0 0 0 | 0 1 0 | -0.314 2.23  | 44 | 34 20 45 | -26 -15 39.5
                                                              | 20 34  6 |   0 -15 18
                                                              | 14  4 20 |   0 -30  5
                                                              | 14  4 20 |   0   1  5
side   | -12.2 -14.5 38.1 | 0 0 0 | 1 0 0 | -1.047 1.047 | 32 | 22 26 34 |  11   0  7.5
middle |  13    14.3 15   | 0 0 0 | 0 1 0 | -0.506 1.885 | 37 | 34 26 22 |  -7 -15 35
                                                              | 20 34  9 |   0 -15 19.5
                                                              | 14  4 20 |   0 -30  5
                                                              | 14  4 20 |   0   0  5
distal |   0    -0.2 36.1 | 0 0 0 | 0 1 0 | -0.366 2.042 | 16 | 20 30 13 |   0 -15 20.5
                                                              | 14  4 20 |   0 -30  5
                                                              | 14  4 20 |   0   1  5
tip    |   1.1 -14.5 39.2 | 11
"""
_LEAP_THUMB = """
base   |   2.9 21.2 -62.2 | 0 0 0 | 0 0 -1 | -0.349 2.094 | 32 | 34 26 22 |   7.5  0   -11
side   |   0   14.3 -13   | 0 0 0 | 0 1  0 | -0.47  2.443 |  3 | 33  4 18 |   0    1.5   0
                                                               |  4 20 14 |  15   13     0
                                                               |  4 20 14 | -15   13     0
middle | -14.5 17     0   | 0 0 0 | 1 0  0 | -1.2   1.9   | 38 | 24 40 20 |  14   10.5   0
                                                               | 18 24 10 |  12   18   -14
                                                               | 32  4 20 |  15   31     0
                                                               |  4 20 14 |  -1   42     0
                                                               |  4 20 14 |  29   42     0
distal |  -0.2 46.6   0   | 0 0 0 | 1 0  0 | -1.34  1.88  | 49 | 24 37 20 |  15    8.5   0
                                                               | 30  4 20 |  14   29     0
                                                               | 18 24  8 |  11   18   -15
                                                               | 24  9 20 |  15   35     0
tip    |  14.6 51.2   1.1 | 11
"""
_LEAP_PALM = """
34  26 22 |  -7.7  30.4  -1.9
34  26 22 |  -7.7 -14.6  -1.9
34  26 22 |  -7.7 -59.6  -1.9
47 120 40 |  -7.2 -12.4 -32.9
46  54 44 |  -7.2 -31   -70.9
12  50 44 | -24.5  18   -70.9
"""


def allegro() -> dict[str, Any]:
    """Return the arguments of a `HandDescription`: four fingers with four joints each."""
    finger = _ALLEGRO_FINGER.format
    fingers = {
        "index": finger(y=43.5, z=-1.542, roll=-5, base=11.9, distal=36.8),
        "middle": finger(y=0, z=0.7, roll=0, base=5, distal=48.4),
        "ring": finger(y=-43.5, z=-1.542, roll=5, base=5, distal=26.4),
        "thumb": _ALLEGRO_THUMB,
    }
    return _hand("allegro", fingers, _ALLEGRO_PALM, 0.7)


def leap() -> dict[str, Any]:
    """Return the arguments of a `HandDescription`: four fingers with four joints each.

    The axes of the first two joints cross.
    """
    front = {"index": 45.4, "middle": 0, "ring": -45.4}
    fingers = {name: _LEAP_FINGER.format(y=y) for name, y in front.items()}
    return _hand("leap", fingers | {"thumb": _LEAP_THUMB}, _LEAP_PALM, 0.95)


def _hand(name: str, fingers: Mapping[str, str], palm: str, torque: float) -> dict[str, Any]:
    links = list[Link]()
    tips = list[Fingertip]()
    for finger, table in fingers.items():
        finger_links, tip = _finger(finger, table, torque)
        links += finger_links
        tips.append(tip)
    solid = tuple(_box(*row) for row in _rows(palm))
    return {
        "name": name,
        "palm": Palm("palm", solid, solid, _DARK),
        "links": tuple(links),
        "fingertips": tuple(tips),
        "placed": False,
    }


def _rows(table: str) -> list[list[str]]:
    return [line.split("|") for line in table.strip().splitlines()]


def _numbers(column: str) -> Any:
    return tuple(map(float, column.split()))


def _metres(column: str) -> Vector3:
    x, y, z = (1e-3 * value for value in _numbers(column))
    return x, y, z


def _radians(column: str) -> Vector3:
    roll, pitch, yaw = map(math.radians, _numbers(column))
    return roll, pitch, yaw


def _box(sides: str, center: str) -> Geometry:
    return Geometry("box", _metres(sides), _metres(center))


def _finger(name: str, table: str, torque: float) -> tuple[list[Link], Fingertip]:
    *rows, (_, center, radius) = _rows(table)
    tip = Geometry("sphere", (1e-3 * float(radius),), _metres(center))
    joints = list[list[str]]()
    boxes = list[list[Geometry]]()
    for *joint, sides, middle in rows:
        if joint[0].strip():
            joints.append(joint)
            boxes.append([])
        boxes[-1].append(_box(sides, middle))
    links = list[Link]()
    for (link, origin, turn, axis, span, grams), solids in zip(joints, boxes, strict=True):
        last = len(links) == len(joints) - 1
        collision = (*solids, tip) if last else tuple(solids)
        visual = (*solids, replace(tip, color=_TIP)) if last else tuple(solids)
        lower, upper = _numbers(span)
        mass = 1e-3 * float(grams)
        links.append(
            Link(
                f"{name}_{link.strip()}",
                links[-1].name if links else "palm",
                _metres(origin),
                _radians(turn),
                _numbers(axis),
                lower,
                upper,
                torque,
                mass,
                *_uniform(mass, collision),
                collision,
                visual,
                _GREY,
            )
        )
    return links, Fingertip(name, links[-1].name, tip.origin, tip.size[0])


def _uniform(mass: float, shapes: Sequence[Geometry]) -> tuple[Vector3, Inertia]:
    """Return the centre of mass of boxes and balls of one density, and the inertia about it."""
    volumes = [
        math.prod(shape.size) if shape.kind == "box" else 4.0 / 3.0 * math.pi * shape.size[0] ** 3
        for shape in shapes
    ]
    masses = mass * np.array(volumes) / sum(volumes)
    center = masses @ np.array([shape.origin for shape in shapes]) / mass
    total = np.zeros((3, 3))
    for share, shape in zip(masses.tolist(), shapes, strict=True):
        is_box = shape.kind == "box"
        squares = np.square(shape.size) / 12.0 if is_box else np.full(3, 0.2 * shape.size[0] ** 2)
        arm = np.array(shape.origin) - center
        second = share * (np.diag(squares) + np.outer(arm, arm))
        total += np.trace(second) * np.eye(3) - second
    x, y, z = center.tolist()
    return (x, y, z), inertia_numbers(total)
