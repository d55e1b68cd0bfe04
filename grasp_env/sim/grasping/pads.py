"""Grippers of two fingers: soft contacts that are assumed, and pads that stand before the rest of their jaws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Vector3
from grasp_env.sim.objects.description import ObjectDescription

PATCH_RADIUS = 0.012
"""[m] of the disc that a soft pad touches with, where nothing else is known: a square pad of 21 mm holds as much torsion."""
UNIFORM = 2.0 / 3.0
"""Of friction times patch radius: torsional friction of a disc under uniform pressure (Howe and Cutkosky 1996, Eq. 5)."""
SOFT_PAIR = 2
"""Fingers of a hand that cannot hold with hard contacts: nothing keeps the object from turning about the line between them."""
_STANDS = 0.0015  # [m] by which a pad's sphere stands before the rest of its jaw
_MOST = 0.006  # [m] that it is moved for that, at most


def torsion_of(friction: float) -> float:
    """Torsional friction [m] of soft pads: 2/3 of friction times the radius of the patch that they touch with."""
    return UNIFORM * friction * PATCH_RADIUS


def softened(item: ObjectDescription, hand: HandDescription) -> ObjectDescription:
    """The object as the hand touches it: with two fingers, contacts without torsional friction get that of soft pads."""
    if hand.finger_count != SOFT_PAIR or item.torsional_friction > 0.0:
        return item
    return replace(item, torsional_friction=torsion_of(item.friction))


def padded(hand: HandDescription) -> HandDescription:
    """A hand of two fingers with its tips moved towards each other, until they stand 1.5 mm before the rest of their links.

    The flat face of a jaw would touch beside the sphere that stands for its pad. Tips that stand before the rest stay.
    """
    if hand.finger_count != SOFT_PAIR:
        return hand
    kinematics = HandKinematics(hand)
    ends = np.clip([kinematics.lower, kinematics.upper], -np.pi, np.pi)
    middle = kinematics.coupled(ends.mean(axis=0))
    frames, _ = kinematics.links(middle)
    tips = kinematics.tips(middle)
    way = tips[1] - tips[0]
    way /= max(float(np.linalg.norm(way)), 1e-9)
    links, moved = list(hand.links), list[Fingertip]()
    for tip, number, towards in zip(hand.fingertips, kinematics.tip_links.tolist(), (way, -way), strict=True):
        step = _short_of(links[number], tip, frames[number].T @ towards)
        x, y, z = (np.array(tip.center) + step * (frames[number].T @ towards)).tolist()
        moved.append(replace(tip, center=(x, y, z)))
        links[number] = _with_sphere(links[number], tip, (x, y, z))
    return replace(hand, links=tuple(links), fingertips=tuple(moved))


def _short_of(link: Link, tip: Fingertip, way: Array) -> float:
    """How far a tip must move along `way` (3,), link frame, to stand before the link's other shapes [m]; 0 where that is too far."""
    from grasp_env.sim.hand.solids import outline  # it loads scipy, which other hands need not wait for

    front = float(np.dot(tip.center, way)) + tip.radius
    steps = [
        _STANDS + outline(shape) @ way - front
        for shape in link.collision
        if not _is_sphere(shape, tip) and shape.kind != "mesh"
    ]
    needed = np.concatenate([*steps, np.zeros(1)])
    return float(needed[needed <= _MOST].max(initial=0.0))


def _is_sphere(shape: Geometry, tip: Fingertip) -> bool:
    return shape.kind == "sphere" and bool(np.allclose(shape.origin, tip.center, atol=1e-9))


def _with_sphere(link: Link, tip: Fingertip, center: Vector3) -> Link:
    """The link with the sphere of its tip elsewhere."""
    shapes = (replace(shape, origin=center) if _is_sphere(shape, tip) else shape for shape in link.collision)
    return replace(link, collision=tuple(shapes))
