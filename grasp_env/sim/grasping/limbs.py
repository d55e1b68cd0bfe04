"""A hand's links as capsules: what the grasp search keeps clear of an object and of one another."""

from __future__ import annotations

import numpy as np

from grasp_env import core
from grasp_env._check import Array
from grasp_env.sim.hand.description import Geometry, HandDescription
from grasp_env.sim.hand.frames import rotation_matrix

_GRID = (-1.0, 0.0, 1.0)
_PALM_GRID = tuple(np.linspace(-1.0, 1.0, 7).tolist())


def hand_limbs(hand: HandDescription) -> list[core.Limb]:
    """The collision shapes of the palm and of all links; a box becomes lines along its longest side."""
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    spheres = {(numbers[tip.link], tip.radius, tip.center) for tip in hand.fingertips}
    parts = [(-1, shape) for shape in hand.palm.collision]
    parts += [(index, shape) for index, link in enumerate(hand.links) for shape in link.collision]
    limbs: list[core.Limb] = []
    for link, shape in parts:
        is_tip = shape.kind == "sphere" and (link, shape.size[0], shape.origin) in spheres
        limbs += [
            core.Limb(link=link, start=start.tolist(), end=end.tolist(), radius=radius, tip=is_tip)
            for start, end, radius in _capsules(shape, _PALM_GRID if link < 0 else _GRID)
        ]
    return limbs


def _capsules(shape: Geometry, grid: tuple[float, ...]) -> list[tuple[Array, Array, float]]:
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
