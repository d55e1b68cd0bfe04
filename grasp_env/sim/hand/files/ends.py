"""Find the fingertips of a hand in a file, and fit a sphere in each."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import AllFaults, Array
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import FileJoint, names_of
from grasp_env.sim.hand.files.groups import Groups
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.solids import hull_of
from grasp_env.sim.hand.tips import Ball, end_direction, inscribed
from grasp_env.sim.hand.tree import Fingertip

_NEAR = 1e-3  # [m] from a joint, below which points give no direction
_BESIDE = 0.01  # largest distance of a tip's frame from the shapes of its link [m]


class Ends(NamedTuple):
    """The ends of branches: fingertips, rods, and sentences on those that are neither."""

    tips: list[str]  # links that move, or that are fixed to them and called tips
    rods: list[str]
    notes: list[str]


def find_ends(groups: Groups) -> Ends:
    """Return the fingertips of a hand for which a caller names none.

    They are the moving links with a shape that carry no other such link. A link that is fixed to
    one and is called a tip stands for it, see `_tip_of`. Links that spin on the palm, and rods, are
    left out.
    """
    chains = _chains(groups)
    shaped = [name for name in chains if groups.points(groups.of(name))]
    carriers = {joint.child for chain in chains.values() for joint in chain[:-1]}
    leaves = [name for name in chains if name not in carriers]
    if not shaped:
        return Ends(leaves, [], [])
    notes = list[str]()
    if bare := [leaf for leaf in leaves if leaf not in shaped]:
        notes.append(f"end links without a shape are not fingertips: {names_of(bare)}")
    covered = {joint.child for name in shaped for joint in chains[name][:-1]}
    ends = [name for name in shaped if name not in covered]
    if spinning := _spinning(groups, {end: chains[end] for end in ends}):
        notes.append(
            f"links on joints that turn without end, or by more than a turn, are not fingertips: {names_of(spinning)}; name them as fingertips= if they are"
        )
        ends = [end for end in ends if end not in spinning]
    tips = {end: _tip_of(groups, end) for end in ends}
    motors = {
        end: {joint.mimic.joint if joint.mimic else joint.name for joint in chains[end]}
        for end in ends
    }
    named = [end for end, tip in tips.items() if _is_tip(tip)]
    rods = list[str]()
    if len(named) >= 2:
        rods = [
            end
            for end in ends
            if end not in named and any(motors[end] <= motors[other] for other in named)
        ]
    return Ends([tip for end, tip in tips.items() if end not in rods], rods, notes)


def _chains(groups: Groups) -> dict[str, list[FileJoint]]:
    """Return the moving joints between the palm and each moving link, the link's own last."""
    chains = dict[str | None, list[FileJoint]]({None: []})
    for joint in groups.moving:
        chains[joint.child] = [*chains[groups.places[joint.parent].carrier], joint]
    return {name: chain for name, chain in chains.items() if name is not None}


def _spinning(groups: Groups, chains: Mapping[str, Sequence[FileJoint]]) -> list[str]:
    """Return the ends on the palm that turn by more than a turn and alone, such as gears and drums.

    There are none unless two other ends remain, and none of their motors turns so far: then the
    file has no true limits.
    """
    drivers = {joint.mimic.joint for joint in groups.moving if joint.mimic}
    wide = {
        joint.name
        for joint in groups.moving
        if not joint.sliding and not joint.mimic and joint.upper - joint.lower > 2.0 * math.pi
    }
    ends = [
        end for end, chain in chains.items() if len(chain) == 1 and chain[0].name in wide - drivers
    ]
    others = [chain for end, chain in chains.items() if end not in ends]
    if len(others) < 2 or any(joint.name in wide for chain in others for joint in chain):
        return []
    return ends


def _is_tip(name: str) -> bool:
    """Return True if a part of a link's name ends with "tip", as in thumb_tip_1 or leftFingertip."""
    words = re.findall(r"[A-Z]*[a-z]+|[A-Z]+", name)
    return any(word.lower().endswith(("tip", "tips")) for word in words)


def _tip_of(groups: Groups, end: str) -> str:
    """Return the link that is fixed to an end link and called a tip, else the end link.

    One without collision shapes counts if it lies within `_BESIDE` of the end link's shapes. Of
    several, the farthest from the joint is returned.
    """
    pieces = groups.points(groups.of(end))
    axis = np.array(next(joint.axis for joint in groups.moving if joint.child == end))
    reach = dict[str, float]()
    for name in groups.of(end)[1:]:
        if not _is_tip(name):
            continue
        origin = groups.places[name].frame.origin
        if groups.touches(name):
            points = np.vstack(groups.points(groups.of(name)))
            reach[name] = float(np.linalg.norm(points, axis=1).max())
        elif (
            np.linalg.norm(np.cross(axis, origin)) > _NEAR
            and min(_distance(piece, origin) for piece in pieces) <= _BESIDE
        ):
            reach[name] = float(np.linalg.norm(origin))
    return max(reach, key=lambda name: reach[name], default=end)


def _distance(piece: Array, point: Array) -> float:
    """Return the largest distance [m] of a point above the faces of a convex piece (K, 3)."""
    faces = hull_of(piece).equations
    return float((faces[:, :3] @ point + faces[:, 3]).max())


def fitted_tips(
    groups: Groups, balls: Mapping[str, Ball | None], radius: float | None, whole: bool
) -> list[tuple[Fingertip, Array]]:
    """Return the fingertips, each with the direction in which its link ends.

    The tip of a link is the given ball, or the one sphere at the link's end, or one of the given
    radius [m] at the link's origin, or the inscribed one. With `whole`, that is inscribed in the
    moving link and all that is fixed to it, else in the named link. An error lists all faults.
    """
    with AllFaults() as check:
        return [check(_fitted, groups, name, ball, radius, whole) for name, ball in balls.items()]


def _fitted(
    groups: Groups, name: str, ball: Ball | None, radius: float | None, whole: bool
) -> tuple[Fingertip, Array]:
    place = groups.places[name]
    if place.carrier is None:
        raise InvalidInputError(
            f"the fingertip {name!r} does not move, it is part of the palm; choose another"
        )
    axis = np.array(next(joint.axis for joint in groups.moving if joint.child == place.carrier))
    group = groups.of(name)
    around = groups.of(place.carrier)
    # what is only drawn on a link that touches, such as a mark, is no end of it
    drawn = whole and groups.touches(place.carrier) and not groups.touches(name)
    own_pieces = [] if drawn else groups.points(group)
    pieces = own_pieces if own_pieces and not whole else groups.points(around)
    # a link ends where its shapes are farthest, or at the given tip
    if ball is not None:
        ball = Ball(_moved(place.frame, ball.center), ball.radius)
        ends = np.array([ball.center])
    else:
        ends = np.vstack(own_pieces) if own_pieces else place.frame.origin[None]
    if np.linalg.norm(ends, axis=1).max() < _NEAR and pieces:
        ends = np.vstack(pieces)
    direction = end_direction(ends, axis, groups.outward(place.carrier, ends))
    if ball is None:
        ball = _sphere(groups, name, around if whole else group, pieces, direction)
    if ball is None and radius is not None:
        ball = Ball(place.frame.numbers()[0], radius)
    if ball is None and pieces:
        ball = inscribed(pieces, direction, axis)
    if ball is None:
        raise InvalidInputError(
            f"the fingertip {name!r} has no shape to lie in; pass tip_radius=, or fingertips={{{name!r}: (point, radius)}}"
        )
    return Fingertip(name, place.carrier, *ball), direction


def _sphere(
    groups: Groups, name: str, group: Sequence[str], pieces: list[Array], direction: Array
) -> Ball | None:
    """Return the only sphere of a link, or else of those fixed to it, if it is at the end."""
    spheres = [
        [
            Ball(_moved(groups.places[link].frame, shape.origin), shape.size[0])
            for link in links
            for shape in groups.links[link].collision
            if shape.kind == "sphere"
        ]
        for links in ([name], group)
    ]
    candidates = spheres[0] or spheres[1]
    if len(candidates) != 1:
        return None
    (ball,) = candidates
    end = max(float((piece @ direction).max()) for piece in pieces)
    return ball if end <= float(direction @ ball.center) + 3.0 * ball.radius else None


def _moved(frame: Frame, point: Vector3) -> Vector3:
    """Transform a point [m] to the outer frame; the identity changes no digit."""
    return frame.carry(point, (0.0, 0.0, 0.0))[0]
