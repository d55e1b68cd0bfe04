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
"""Default radius of a soft pad's contact patch [m]; a square pad of 21 mm resists as much torsion."""
# torsional friction of a disc under uniform pressure, over friction times radius (Howe and
# Cutkosky 1996, Eq. 5)
_UNIFORM = 2.0 / 3.0
SOFT_PAIR = 2
"""Fingers of a hand that needs soft contacts: hard ones do not stop the object from turning."""
_PROTRUSION = 0.0015  # distance by which a pad's sphere protrudes from its jaw [m]
# the same of a jaw that turns against a fixed one: a flat side would touch them beside their pads
_OBLIQUE = 0.004
# distance of such tips at which the direction of moving is chosen [m], and shares of the joints'
# ranges among which the posture for that is
_OPENING, _SHARES = 0.04, tuple(np.linspace(0.0, 1.0, 21).tolist())
_MAX_STEP = 0.008  # largest distance that it is moved for that [m]


def torsion_of(friction: float) -> float:
    """Return the torsional friction [m] of soft pads with `PATCH_RADIUS`."""
    return _UNIFORM * friction * PATCH_RADIUS


def with_soft_contacts(item: ObjectDescription, hand: HandDescription) -> ObjectDescription:
    """Give an object in a two-finger hand the torsional friction of soft pads, if it has none."""
    if hand.finger_count != SOFT_PAIR or item.torsional_friction > 0.0:
        return item
    return replace(item, torsional_friction=torsion_of(item.friction))


def has_fixed_jaw(hand: HandDescription) -> bool:
    """True if one jaw turns against a fixed one, which slides a little in place of the arm."""
    numbers = {link.name: link for link in hand.links}
    kinds = [numbers[tip.link].sliding for tip in hand.fingertips]
    return hand.finger_count == SOFT_PAIR and kinds[0] != kinds[1]


def with_protruding_tips(hand: HandDescription) -> HandDescription:
    """Move the tips of a two-finger hand towards each other until they protrude 1.5 mm.

    Otherwise the flat face of a jaw would touch beside the sphere that models its pad.
    """
    if hand.finger_count != SOFT_PAIR:
        return hand
    kinematics = HandKinematics(hand)
    low, high = np.clip([kinematics.lower, kinematics.upper], -np.pi, np.pi)
    distance, shares = (_OBLIQUE, _SHARES) if has_fixed_jaw(hand) else (_PROTRUSION, (0.5,))
    postures = [kinematics.coupled(low + share * (high - low)) for share in shares]
    tips, frames = min(
        ((kinematics.tips(posture), kinematics.links(posture)[0]) for posture in postures),
        key=lambda pair: abs(float(np.linalg.norm(pair[0][1] - pair[0][0])) - _OPENING),
    )
    across = tips[1] - tips[0]
    across /= max(float(np.linalg.norm(across)), 1e-9)
    links = list(hand.links)
    moved = list[Fingertip]()
    for tip, number, direction in zip(
        hand.fingertips, kinematics.tip_links.tolist(), (across, -across), strict=True
    ):
        inward = frames[number].T @ direction
        link = links[number]
        x, y, z = (
            np.array(tip.center) + _step_to_protrude(link, tip, inward, distance) * inward
        ).tolist()
        moved.append(replace(tip, center=(x, y, z)))
        shapes = (
            replace(shape, origin=(x, y, z)) if _is_sphere(shape, tip) else shape
            for shape in link.collision
        )
        links[number] = replace(link, collision=tuple(shapes))
    return replace(hand, links=tuple(links), fingertips=tuple(moved))


def _step_to_protrude(link: Link, tip: Fingertip, inward: Array, distance: float) -> float:
    """Return how far to move a tip along `inward` (3,), link frame, to protrude by a distance [m].

    0 if that is more than `_MAX_STEP`.
    """
    from grasp_env.sim.hand.solids import outline  # imports scipy, which other hands do not need

    front = float(np.dot(tip.center, inward)) + tip.radius
    others = [
        shape for shape in link.collision if not _is_sphere(shape, tip) and shape.kind != "mesh"
    ]
    steps = np.concatenate(
        [np.zeros(1), *(distance + outline(shape) @ inward - front for shape in others)]
    )
    return float(steps[steps <= _MAX_STEP].max(initial=0.0))


def _is_sphere(shape: Geometry, tip: Fingertip) -> bool:
    return shape.kind == "sphere" and bool(np.allclose(shape.origin, tip.center, atol=1e-9))
