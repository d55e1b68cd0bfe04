"""Find the fingertips of a hand in a file, and fit a sphere in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import AllFaults, Array
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import names_of
from grasp_env.sim.hand.files.groups import Groups
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.tips import Ball, end_direction, inscribed
from grasp_env.sim.hand.tree import Fingertip

_NEAR = 1e-3  # [m] from a joint, below which points give no direction


def find_ends(groups: Groups) -> tuple[list[str], list[str]]:
    """Return the links that are fingertips, and sentences on ends of branches that are none."""
    parents = {groups.places[joint.parent].carrier for joint in groups.moving}
    ends = [joint.child for joint in groups.moving if joint.child not in parents]
    bare = [end for end in ends if not groups.points(groups.of(end))]
    if not bare or len(bare) == len(ends):
        return ends, []
    note = f"end links without a shape are not fingertips: {names_of(bare)}"
    return [end for end in ends if end not in bare], [note]


def fitted_tips(
    groups: Groups, balls: Mapping[str, Ball | None], radius: float | None
) -> list[tuple[Fingertip, Array]]:
    """Return the fingertips, each with the direction in which its link ends.

    The tip of a link is the given ball, or the one sphere at the link's end, or one of the given
    radius [m] at the link's origin, or the inscribed one. An error lists all faults.
    """
    with AllFaults() as check:
        return [check(_fitted, groups, name, ball, radius) for name, ball in balls.items()]


def _fitted(
    groups: Groups, name: str, ball: Ball | None, radius: float | None
) -> tuple[Fingertip, Array]:
    place = groups.places[name]
    if place.carrier is None:
        raise InvalidInputError(
            f"the fingertip {name!r} does not move, it is part of the palm; choose another"
        )
    axis = np.array(next(joint.axis for joint in groups.moving if joint.child == place.carrier))
    group = groups.of(name)
    own_pieces = groups.points(group)
    pieces = own_pieces or groups.points(groups.of(place.carrier))
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
        ball = _sphere(groups, name, group, pieces, direction)
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
