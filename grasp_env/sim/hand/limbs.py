"""Links of a hand as convex solids for collision checks in the grasp search, and pairs of links
that always touch.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from grasp_env import core
from grasp_env.sim.hand.description import Geometry, HandDescription
from grasp_env.sim.hand.frames import rotation_matrix
from grasp_env.sim.hand.kinematics import HandKinematics

_Pair: TypeAlias = tuple[int, int]
APART = 0.003
"""Least gap of two fingers in a planned grasp [m]."""
_POSTURES = 64  # random postures within the joint ranges
_NEAR = 0.002  # [m], largest gap of near links
_MOSTLY = 0.9  # fraction of the postures that counts as nearly all


def hand_limbs(hand: HandDescription) -> list[core.Limb]:
    """Return the collision shapes of the palm and of all links, without visual shapes."""
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    spheres = {(numbers[tip.link], tip.radius, tip.center) for tip in hand.fingertips}
    tips = {number for number, _, _ in spheres}
    parts = [(-1, shape) for shape in hand.palm.collision]
    parts += [(index, shape) for index, link in enumerate(hand.links) for shape in link.collision]
    return [
        _limb(link, shape, link in tips, spheres) for link, shape in parts if shape.kind != "mesh"
    ]


def _limb(
    link: int, shape: Geometry, tipped: bool, spheres: set[tuple[int, float, tuple[float, ...]]]
) -> core.Limb:
    origin = np.array(shape.origin)
    frame = rotation_matrix(shape.rotation)
    if shape.kind in ("sphere", "capsule"):
        half = 0.0 if shape.kind == "sphere" else 0.5 * shape.size[1]
        start = origin - half * frame[:, 2]
        end = origin + half * frame[:, 2]
        is_tip = shape.kind == "sphere" and (link, shape.size[0], shape.origin) in spheres
        return core.Limb.line(
            link=link, start=start.tolist(), end=end.tolist(), radius=shape.size[0], tip=is_tip
        )
    half = (0.0, 0.0, 0.0)
    corners = np.zeros((0, 3))
    if shape.kind == "hull":
        corners = np.array(shape.corners)
        middle = corners.mean(axis=0)
        corners = corners - middle
        origin = origin + frame @ middle
    elif shape.kind == "box":
        half = tuple(0.5 * side for side in shape.size)
    else:
        half = (shape.size[0], shape.size[0], 0.5 * shape.size[1])
    # the other shapes of a link with a tip surround the sphere and may touch the object with it
    center = origin.tolist()
    rotation = frame.ravel().tolist()
    return core.Limb.solid(
        link=link,
        kind=shape.kind,
        half=half,
        center=center,
        rotation=rotation,
        corners=corners,
        tip=tipped,
    )


def touching_pairs(hand: HandDescription, at_home: bool = True) -> tuple[tuple[int, int], ...]:
    """Return the pairs of links whose contact must be ignored, because their coarse shapes always
    touch; as indices, -1 for the palm.

    Two links form such a pair if they overlap in the rest posture, or in at least half of the
    random postures, or if they overlap in some posture and are within 2 mm in nearly all. So do two
    moving links that are nearer than fingers may be in all postures and overlap in hardly any, as
    on shafts side by side. Links that share a joint are left out, and the rest posture unless
    `at_home`.
    """
    overlaps, nears, close, home = _pairs(hand)
    always = {
        pair
        for pair, count in overlaps.items()
        if 2 * count >= _POSTURES or nears[pair] >= _MOSTLY * _POSTURES
    }
    always |= {
        pair
        for pair, count in close.items()
        if count == _POSTURES and -1 not in pair and overlaps[pair] <= (1.0 - _MOSTLY) * _POSTURES
    }
    return tuple(sorted(always | home if at_home else always))


@lru_cache(maxsize=32)
def _pairs(
    hand: HandDescription,
) -> tuple[Counter[_Pair], Counter[_Pair], Counter[_Pair], set[_Pair]]:
    """Count, for pairs of links, the random postures with overlap and with gaps below `_NEAR` and
    `APART`; find overlaps in the rest posture.
    """
    kinematics = HandKinematics(hand)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(hand), kinematics.home)
    low = np.maximum(kinematics.lower, -np.pi)
    high = np.minimum(kinematics.upper, np.pi)
    draws = np.random.default_rng(0).random((_POSTURES, hand.joint_count))
    overlaps = Counter[_Pair]()
    nears = Counter[_Pair]()
    close = Counter[_Pair]()
    for draw in draws:
        gaps = limbs.link_gaps(low + draw * (high - low), APART)
        nears.update({(first, second) for first, second, gap in gaps if gap <= _NEAR})
        close.update({(first, second) for first, second, _ in gaps})
        overlaps.update(_overlapping(gaps))
    return overlaps, nears, close, _overlapping(limbs.link_gaps(kinematics.home, 0.0))


def _overlapping(gaps: list[tuple[int, int, float]]) -> set[_Pair]:
    return {(first, second) for first, second, gap in gaps if gap <= 0.0}
