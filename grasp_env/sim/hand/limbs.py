"""A hand's links as convex solids: what the grasp search keeps clear of an object and of one another, and which always touch."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import numpy as np

from grasp_env import core
from grasp_env.sim.hand.description import Geometry, HandDescription
from grasp_env.sim.hand.frames import rotation_matrix
from grasp_env.sim.hand.kinematics import HandKinematics

_POSTURES = 64  # over the ranges of the joints
_NEAR, _MOSTLY = 0.002, 0.9  # [m] between links that are near; part of the postures in which those are that always are


def hand_limbs(hand: HandDescription) -> list[core.Limb]:
    """The collision shapes of the palm and of all links; what is drawn only is none."""
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    spheres = {(numbers[tip.link], tip.radius, tip.center) for tip in hand.fingertips}
    tips = {number for number, _, _ in spheres}
    parts = [(-1, shape) for shape in hand.palm.collision]
    parts += [(index, shape) for index, link in enumerate(hand.links) for shape in link.collision]
    return [_limb(link, shape, link in tips, spheres) for link, shape in parts if shape.kind != "mesh"]


def _limb(link: int, shape: Geometry, tipped: bool, spheres: set[tuple[int, float, tuple[float, ...]]]) -> core.Limb:
    origin, frame = np.array(shape.origin), rotation_matrix(shape.rotation)
    if shape.kind in ("sphere", "capsule"):
        half = 0.0 if shape.kind == "sphere" else 0.5 * shape.size[1]
        start, end = origin - half * frame[:, 2], origin + half * frame[:, 2]
        is_tip = shape.kind == "sphere" and (link, shape.size[0], shape.origin) in spheres
        return core.Limb.line(link=link, start=start.tolist(), end=end.tolist(), radius=shape.size[0], tip=is_tip)
    half, corners = (0.0, 0.0, 0.0), np.zeros((0, 3))
    if shape.kind == "hull":
        corners = np.array(shape.corners)
        middle = corners.mean(axis=0)
        corners, origin = corners - middle, origin + frame @ middle
    elif shape.kind == "box":
        half = tuple(0.5 * side for side in shape.size)
    else:
        half = (shape.size[0], shape.size[0], 0.5 * shape.size[1])
    # the rest of a link with a tip lies around the sphere and may touch with it
    return core.Limb.solid(
        link=link,
        kind=shape.kind,
        half=half,
        center=origin.tolist(),
        rotation=frame.ravel().tolist(),
        corners=corners,
        tip=tipped,
    )


def touching_pairs(hand: HandDescription, at_home: bool = True) -> tuple[tuple[int, int], ...]:
    """Pairs of links that touch whatever the hand does, by their numbers, -1 the palm: their contact means nothing.

    They overlap in the rest posture, or in half of some postures over the joints' ranges; or now and then, and are never far
    apart: their shapes are coarser than they are. Links of one joint always do and are not among them.

    Args:
        hand: The hand.
        at_home: Count the rest posture, too.
    """
    overlaps, nears, home = _pairs(hand)
    always = {pair for pair, count in overlaps.items() if 2 * count >= _POSTURES or nears[pair] >= _MOSTLY * _POSTURES}
    return tuple(sorted(always | home if at_home else always))


_Counts: TypeAlias = dict[tuple[int, int], int]


@lru_cache(maxsize=32)
def _pairs(hand: HandDescription) -> tuple[_Counts, _Counts, set[tuple[int, int]]]:
    """In how many of `_POSTURES` postures links overlap, and are within `_NEAR`; which overlap in the rest posture."""
    kinematics = HandKinematics(hand)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(hand), kinematics.home)
    low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
    draws = np.random.default_rng(0).random((_POSTURES, hand.joint_count))
    overlaps, nears = _Counts(), _Counts()
    for draw in draws:
        gaps = _least(limbs.link_gaps(low + draw * (high - low), _NEAR))
        for pair, gap in gaps.items():
            nears[pair] = nears.get(pair, 0) + 1
            if gap <= 0.0:
                overlaps[pair] = overlaps.get(pair, 0) + 1
    home = {pair for pair, gap in _least(limbs.link_gaps(kinematics.home, 0.0)).items() if gap <= 0.0}
    return overlaps, nears, home


def _least(found: list[tuple[int, int, float]]) -> dict[tuple[int, int], float]:
    """The least gap of each pair of links [m]."""
    out: dict[tuple[int, int], float] = {}
    for first, second, gap in found:
        out[first, second] = min(gap, out.get((first, second), np.inf))
    return out
