"""Two-finger grippers: default soft contacts, and pads that protrude from their jaws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link
from grasp_env.sim.objects.description import ObjectDescription

PATCH_RADIUS = 0.012
"""Default radius of the contact patch of a soft pad [m]: a square pad of 21 mm resists as much
torsion."""
UNIFORM = 2.0 / 3.0
"""Torsional friction of a disc under uniform pressure, over friction times radius (Howe and
Cutkosky 1996, Eq. 5)."""
SOFT_PAIR = 2
"""Number of fingers that cannot hold with hard contacts: nothing stops the object from turning
about the line between them."""
_PROTRUSION = 0.0015  # distance by which a pad's sphere protrudes from its jaw [m]
_MAX_STEP = 0.006  # largest distance that it is moved for that [m]


def torsion_of(friction: float) -> float:
    """Return the torsional friction of soft pads [m]: 2/3 of friction times the radius of their
    contact patch.
    """
    return UNIFORM * friction * PATCH_RADIUS


def with_soft_contacts(item: ObjectDescription, hand: HandDescription) -> ObjectDescription:
    """Return the object with the torsional friction of soft pads, if the hand has two fingers and
    the object has none.
    """
    if hand.finger_count != SOFT_PAIR or item.torsional_friction > 0.0:
        return item
    return replace(item, torsional_friction=torsion_of(item.friction))


def with_protruding_tips(hand: HandDescription) -> HandDescription:
    """Return a two-finger hand with its tips moved towards each other until they protrude 1.5 mm
    from their links.

    Otherwise the flat face of a jaw would touch beside the sphere that models its pad. Tips that
    protrude already are kept.
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
    links = list(hand.links)
    moved = list[Fingertip]()
    for tip, number, towards in zip(
        hand.fingertips, kinematics.tip_links.tolist(), (way, -way), strict=True
    ):
        inward = frames[number].T @ towards
        link = links[number]
        x, y, z = (np.array(tip.center) + _step_to_protrude(link, tip, inward) * inward).tolist()
        moved.append(replace(tip, center=(x, y, z)))
        shapes = (
            replace(shape, origin=(x, y, z)) if _is_sphere(shape, tip) else shape
            for shape in link.collision
        )
        links[number] = replace(link, collision=tuple(shapes))
    return replace(hand, links=tuple(links), fingertips=tuple(moved))


def _step_to_protrude(link: Link, tip: Fingertip, way: Array) -> float:
    """Return the distance along `way` (3,), link frame, at which a tip protrudes from the other
    shapes [m]; 0 if it is too far.
    """
    from grasp_env.sim.hand.solids import outline  # imports scipy, which other hands do not need

    front = float(np.dot(tip.center, way)) + tip.radius
    others = [
        shape for shape in link.collision if not _is_sphere(shape, tip) and shape.kind != "mesh"
    ]
    needed = np.concatenate(
        [np.zeros(1), *(_PROTRUSION + outline(shape) @ way - front for shape in others)]
    )
    return float(needed[needed <= _MAX_STEP].max(initial=0.0))


def _is_sphere(shape: Geometry, tip: Fingertip) -> bool:
    return shape.kind == "sphere" and bool(np.allclose(shape.origin, tip.center, atol=1e-9))
