"""Joints that one motor moves together: the ranges that they leave it, and the rods among their links, which are no fingers."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog

from grasp_env._check import Array
from grasp_env.sim.hand.files.elements import FileJoint, names_of
from grasp_env.sim.hand.frames import Frame, axis_rotation
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.hand.tree import Fingertip, Link

_LEAST_RANGE = 0.25
"""Part of a motor's range that coupled joints leave it at least; otherwise their own limits do not count."""
_POSTURES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Parts of the motors' ranges at which links are compared."""
_PINNED = 0.002
"""[m] between two links that a pin joins, at most: their shapes are coarse."""
_SHORTER = 0.9
"""Reach of a rod over that of the finger that it moves, at most."""


def free_ranges(joints: Sequence[FileJoint], given: Collection[str]) -> tuple[list[FileJoint], list[str]]:
    """The joints with ranges that fit their couplings, and a sentence on those that were changed.

    Other programs only keep the limits of the joint with the motor, so nobody notices wrong limits of coupled joints. Where these would
    leave the motor less than `_LEAST_RANGE` of its range, they become what the motor's range makes of them.

    Args:
        joints: All of them.
        given: Names of joints whose ranges a caller gives: these count.
    """
    left = {joint.name: (joint.lower, joint.upper) for joint in joints}
    for joint in joints:
        if joint.mimic is not None:
            low, high = sorted((end - joint.mimic.offset) / joint.mimic.ratio for end in (joint.lower, joint.upper))
            before = left[joint.mimic.joint]
            left[joint.mimic.joint] = max(before[0], low), min(before[1], high)
    drivers = {joint.name: joint for joint in joints}
    changed, out = list[str](), list[FileJoint]()
    for joint in joints:
        fitting = joint
        if joint.mimic is not None and joint.name not in given:
            driver, (low, high) = drivers[joint.mimic.joint], left[joint.mimic.joint]
            if math.isfinite(driver.lower) and high - low < _LEAST_RANGE * (driver.upper - driver.lower):
                lower, upper = sorted((joint.mimic.angle(driver.lower), joint.mimic.angle(driver.upper)))
                fitting = replace(joint, lower=lower, upper=upper)
                changed.append(joint.name)
        out.append(fitting)
    text = "the limits of coupled joints leave their motor hardly any range, so that they do not count"
    return out, [f"{text}: {names_of(changed)}"] if changed else []


def find_rods(links: Sequence[Link], tips: Sequence[Fingertip]) -> set[str]:
    """Names of the fingertips that are rods: they end at a pin in another finger that the same motors move.

    The rod touches that finger in every posture, and the finger reaches farther than the rod.
    """
    chains = [_chain(links, tip.link) for tip in tips]
    motors = [frozenset(link.mimic.joint if link.mimic else link.joint for link in chain) for chain in chains]
    alike = [
        (rod, finger)
        for rod in range(len(tips))
        for finger in range(len(tips))
        if motors[rod] == motors[finger] and rod != finger
    ]
    if not alike:
        return set()
    postures = [_frames(links, part) for part in _POSTURES]
    reach = [
        max(float(np.linalg.norm(frames[tip.link].rotation @ tip.center + frames[tip.link].origin)) for frames in postures)
        for tip in tips
    ]  # fmt: skip
    rods = set[str]()
    for rod, finger in alike:
        end = chains[rod][0]
        others = [link for link in chains[finger] if link not in chains[rod]]
        if reach[rod] < _SHORTER * reach[finger] and any(
            all(_touch(end, other, frames) for frames in postures) for other in others
        ):
            rods.add(tips[rod].name)
    return rods if len(rods) < len(tips) else set()


def _chain(links: Sequence[Link], name: str) -> list[Link]:
    """A link and those that carry it."""
    by_name = {link.name: link for link in links}
    chain = [by_name[name]]
    while chain[-1].parent in by_name:
        chain.append(by_name[chain[-1].parent])
    return chain


def _frames(links: Sequence[Link], part: float) -> dict[str, Frame]:
    """The frames of the links in the palm's, with all motors at a part of their ranges."""
    angles = {
        link.joint: max(link.lower, -math.pi) + part * (min(link.upper, math.pi) - max(link.lower, -math.pi))
        for link in links
    }
    frames = dict[str, Frame]()
    for link in links:
        angle = angles[link.joint] if link.mimic is None else link.mimic.angle(angles[link.mimic.joint])
        axis = np.array(link.axis)
        own = Frame(np.eye(3), angle * axis) if link.sliding else Frame(axis_rotation(axis, angle), np.zeros(3))
        place = Frame.of(link.origin, link.rotation) @ own
        frames[link.name] = frames[link.parent] @ place if link.parent in frames else place
    return frames


def _touch(one: Link, other: Link, frames: dict[str, Frame]) -> bool:
    """True if two links are within `_PINNED` of each other."""
    solids = [
        [outline(shape) @ frames[link.name].rotation.T + frames[link.name].origin for shape in link.collision]
        for link in (one, other)
    ]
    return any(_near(first, second) for first in solids[0] for second in solids[1])


def _near(first: Array, second: Array) -> bool:
    """True if no slab of `_PINNED` lies between the hulls of points (K, 3)."""
    middle = 0.5 * (first.mean(axis=0) + second.mean(axis=0))
    # a normal n with |n_i| <= 1, an offset d and the largest half width m: n @ a >= d + m, n @ b <= d - m
    rows = np.vstack([
        np.column_stack([middle - first, np.ones(len(first)), np.ones(len(first))]),
        np.column_stack([second - middle, -np.ones(len(second)), np.ones(len(second))]),
    ])  # fmt: skip
    bounds = [(-1.0, 1.0)] * 3 + [(None, None), (0.0, None)]
    found = linprog((0.0, 0.0, 0.0, 0.0, -1.0), A_ub=rows, b_ub=np.zeros(len(rows)), bounds=bounds)
    if found.x is None:
        return True
    return float(2.0 * found.x[4]) < _PINNED * max(float(np.linalg.norm(found.x[:3])), 1e-12)
