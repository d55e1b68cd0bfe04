"""Assemble a hand from the links and joints of a file.

Links behind a fixed joint are merged into their parent. One warning lists all repairs, one error
all faults.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import AllFaults, Array
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import parsed
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.files.elements import NO_INERTIA, FileJoint, HandFile, names_of
from grasp_env.sim.hand.files.joints import find_rods, free_ranges, judge_ranges
from grasp_env.sim.hand.files.options import HandOptions, Inertial
from grasp_env.sim.hand.files.part import arrange, read_part
from grasp_env.sim.hand.files.pieces import hulls_of_files
from grasp_env.sim.hand.files.plausible import Body, Judge
from grasp_env.sim.hand.files.urdf import UrdfReader
from grasp_env.sim.hand.files.xacro import robot_of
from grasp_env.sim.hand.frames import IDENTITY, Frame
from grasp_env.sim.hand.inertia import Inertia, inertia_matrix, inertia_numbers, with_rotor
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.hand.tips import Ball, cut_back, end_direction, inscribed
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Palm
from grasp_env.sim.xml_files import read_xml

_NEAR = 1e-3  # [m] from a joint, below which points give no direction


class ReadHand(NamedTuple):
    """The parts of a hand in a file; `repairs` says what was assumed, left out or changed."""

    name: str
    palm: Palm
    links: tuple[Link, ...]
    fingertips: tuple[Fingertip, ...]
    repairs: list[str]


class _Place(NamedTuple):
    """The place of a file's link."""

    carrier: str | None  # the moving link to which it belongs; None for the palm
    frame: Frame  # in that link


def read_hand(path: str | os.PathLike[str], options: HandOptions) -> ReadHand:
    """Read a hand as `HandDescription.from_file` says; links stand after their parents."""
    with AllFaults() as check:
        check(options.checked_palm)
        check(options.tips)
        check(options.radius)
        check(options.expansion)
    try:
        return _Importer(_opened(path, options), options).hand
    except InvalidInputError as error:
        message = str(error)
        where = "" if message.startswith("cannot read") else f"{path}: "
        raise InvalidInputError(f"{where}{message}") from None


def _opened(path: str | os.PathLike[str], options: HandOptions) -> HandFile:
    """Return the reader of a file, chosen by its first element."""
    first: Element = parsed(path, read_xml, InvalidInputError, f"the file {path}", "XML")
    if first.tag == "sdf":
        raise InvalidInputError("it is SDF, which is not read: give the hand's URDF, xacro or MJCF")
    expand, arguments = options.expansion()
    if first.tag == "robot":
        return UrdfReader(path, robot_of(Path(os.fsdecode(path)), first, expand, arguments))
    if expand or arguments:
        raise InvalidInputError(
            f"the first element is <{first.tag[:40]}>, xacro expands <robot>: leave out xacro= and xacro_args="
        )
    if first.tag == "mujoco":
        with need("mujoco"):
            from grasp_env.sim.hand.files.mjcf import MjcfReader
        return MjcfReader(path, tuple(options.tips() or ()))
    raise InvalidInputError(
        f"the first element is <{first.tag[:40]}>; a URDF starts with <robot name=...>, a MuJoCo model with <mujoco>"
    )


class _Importer:
    """Assembles the hand of one file."""

    def __init__(self, file: HandFile, options: HandOptions) -> None:
        chosen_tips = options.tips()
        part, self.links, joints = read_part(file, options.checked_palm(), chosen_tips or {})
        ranges = options.ranges([joint.name for joint in joints if not joint.fixed])
        joints, frozen = arrange(part, [_ranged(joint, ranges.get(joint.name)) for joint in joints])
        joints, wide = judge_ranges(joints, ranges)
        self.joints, uncoupled = free_ranges(joints, ranges)
        self.root = part.root
        self.use_file_rotors = options.rotor_inertia is None
        self.repairs = [*file.notes, *part.notes, *frozen, *wide, *uncoupled]
        self.moving = [joint for joint in self.joints if not joint.fixed]
        if not self.moving:
            why = "no joint moves; a hand needs joints of type revolute, continuous or prismatic"
            raise InvalidInputError("; ".join([why, *frozen]))
        # may take seconds, but meshes are cached by content
        self.links = file.with_shapes(self.links)
        self.places = self._placed()
        for reason in dict.fromkeys(file.undrawn.values()):
            names = [name for name, why in file.undrawn.items() if why == reason]
            self.repairs.append(f"visual meshes that {reason} are left out: {names_of(names)}")
        if bare := [name for name in self._bodies() if self._only_drawn(name)]:
            self.repairs.append(
                f"links without collision shapes are drawn and touch nothing: {names_of(bare)}; give them <collision> in the file"
            )
        self._corners = hulls_of_files(
            shape.file
            for joint in self.moving
            for _, shape in self._outlines(self._group(joint.child))
            if shape.kind == "mesh"
        )
        bodies = [self._body(joint) for joint in self.moving]
        drivers = {joint.name: joint.mimic.joint for joint in self.moving if joint.mimic}
        with AllFaults() as check:
            torques = check(options.torques, [joint.name for joint in self.moving], drivers)
            inertials = check(options.bodies, [joint.child for joint in self.moving])
            tips = check(lambda: self._tips(chosen_tips, options.radius()))
        color = self.links[self.root].color or (0.17, 0.19, 0.23)
        palm = Palm(self.root, *self._shapes(self.root, None), color)
        links = self._judged(bodies, torques, inertials)
        if chosen_tips is None and (rods := find_rods(links, [tip for tip, _ in tips])):
            self.repairs.append(
                f"rods that only move a finger are not fingertips: {names_of(sorted(rods))}"
            )
            tips = [pair for pair in tips if pair[0].name not in rods]
        links = [
            _with_tips(link, [pair for pair in tips if pair[0].link == link.name]) for link in links
        ]
        self.hand = ReadHand(
            file.name, palm, tuple(links), tuple(tip for tip, _ in tips), self.repairs
        )

    def _placed(self) -> dict[str, _Place]:
        places = {self.root: _Place(None, IDENTITY)}
        for joint in self.joints:
            carrier, frame = places[joint.parent]
            fixed = _Place(carrier, frame @ Frame.of(joint.origin, joint.rotation))
            places[joint.child] = fixed if joint.fixed else _Place(joint.child, IDENTITY)
        return places

    def _shapes(
        self, name: str, carrier: str | None
    ) -> tuple[tuple[Geometry, ...], tuple[Geometry, ...]]:
        """Return collision and visual shapes of a link with everything fixed to it.

        Links without visual shapes show their collision shapes.
        """
        collision = list[Geometry]()
        visual = list[Geometry]()
        for other, place in self.places.items():
            if place.carrier != carrier:
                continue
            link = self.links[other]
            color = None if link.color == self.links[name].color else link.color
            collision += [shape.carried(place.frame) for shape in link.collision]
            for shape in link.visual or link.collision:
                visual.append(replace(shape.carried(place.frame), color=shape.color or color))
        return tuple(collision), tuple(visual)

    def _bodies(self) -> list[str]:
        """Return the names of the palm and of the moving links."""
        return [self.root, *(joint.child for joint in self.moving)]

    def _only_drawn(self, name: str) -> bool:
        """Return True if a link and all that is fixed to it have visual shapes only."""
        group = [self.links[other] for other in self._group(name)]
        return any(link.visual for link in group) and not any(link.collision for link in group)

    def _body(self, joint: FileJoint) -> Body:
        carrier, frame = self.places[joint.parent]
        shapes = self._shapes(joint.child, joint.child)
        points = np.vstack([*self._points(self._group(joint.child)), np.empty((0, 3))])
        place = frame.carry(joint.origin, joint.rotation)
        return Body(joint, *self._inertial(joint.child), *shapes, points, carrier, *place)

    def _judged(
        self,
        bodies: list[Body],
        torques: Mapping[str, float],
        inertials: Mapping[str, float | Inertial],
    ) -> list[Link]:
        """Return the moving links with plausible numbers."""
        judge = Judge(bodies)
        links = list[Link]()
        for body, (mass, center, inertia), limit in zip(
            bodies, judge.inertials(inertials), judge.torques(torques), strict=True
        ):
            joint = body.joint
            if self.use_file_rotors and joint.rotor > 0.0 and not joint.sliding:
                inertia = with_rotor(inertia, joint.rotor)
            color = self.links[joint.child].color or (0.5, 0.5, 0.5)
            links.append(
                Link(
                    joint.child,
                    body.carrier or self.root,
                    body.origin,
                    body.rotation,
                    joint.axis,
                    joint.lower,
                    joint.upper,
                    limit,
                    mass,
                    center,
                    inertia,
                    body.shapes,
                    body.looks,
                    color,
                    joint.name,
                    joint.sliding,
                    joint.mimic,
                )
            )
        self.repairs += judge.notes
        return links

    def _inertial(self, name: str) -> tuple[float, Vector3, Inertia]:
        """Return mass, centre and inertia of a moving link with everything fixed to it.

        The mass is 0 if the file has none.
        """
        links = [(self.places[other].frame, self.links[other]) for other in self._group(name)]
        parts = [
            (frame @ link.inertial_frame, link.mass, inertia_matrix(link.inertia))
            for frame, link in links
            if link.mass > 0.0
        ]
        mass = sum(weight for _, weight, _ in parts)
        if mass <= 0.0:
            return 0.0, (0.0, 0.0, 0.0), NO_INERTIA
        center = sum((weight * frame.origin for frame, weight, _ in parts), np.zeros(3)) / mass
        total = np.zeros((3, 3))
        for frame, weight, inertia in parts:
            arm = frame.origin - center
            total += frame.rotation @ inertia @ frame.rotation.T + weight * (
                arm @ arm * np.eye(3) - np.outer(arm, arm)
            )
        x, y, z = center.tolist()
        return mass, (x, y, z), inertia_numbers(0.5 * (total + total.T))

    def _tips(
        self, balls: dict[str, Ball | None] | None, radius: float | None
    ) -> list[tuple[Fingertip, Array]]:
        """Return the fingertips, each with the direction in which its link ends."""
        if balls is None:
            parents = {self.places[joint.parent].carrier for joint in self.moving}
            ends = [joint.child for joint in self.moving if joint.child not in parents]
            bare = [end for end in ends if not self._points(self._group(end))]
            if bare and len(bare) < len(ends):
                self.repairs.append(
                    f"end links without a shape are not fingertips: {names_of(bare)}"
                )
                ends = [end for end in ends if end not in bare]
            balls = dict.fromkeys(ends)
        with AllFaults() as check:
            return [check(self._tip, name, ball, radius) for name, ball in balls.items()]

    def _group(self, name: str) -> list[str]:
        """Return the names of a link and of everything fixed to it."""
        group = [name]
        for joint in self.joints:
            if joint.fixed and joint.parent in group:
                group.append(joint.child)
        return group

    def _outlines(self, group: Sequence[str]) -> list[tuple[Frame, Geometry]]:
        """Return the links' collision shapes, or else visual ones, each with its link's frame."""
        links = [(self.places[name].frame, self.links[name]) for name in group]
        solids = [(frame, shape) for frame, link in links for shape in link.collision]
        return solids or [(frame, shape) for frame, link in links for shape in link.visual]

    def _points(self, group: Sequence[str]) -> list[Array]:
        """Return convex pieces (K, 3) [m] of the `_outlines` of links, carrier's frame."""
        pieces = list[Array]()
        for frame, shape in self._outlines(group):
            if shape.kind != "mesh":
                pieces.append(outline(shape.carried(frame)))
                continue
            if shape.file not in self._corners:
                self._corners |= hulls_of_files([shape.file])
            place = frame @ Frame.of(shape.origin, shape.rotation)
            corners = self._corners[shape.file] * shape.size
            pieces.append(corners @ place.rotation.T + place.origin)
        return pieces

    def _tip(self, name: str, ball: Ball | None, radius: float | None) -> tuple[Fingertip, Array]:
        """Return a fingertip and the direction in which its link ends.

        The tip is the given ball, or the one sphere at the link's end, or one of the given radius
        at the link's origin, or the inscribed one.
        """
        place = self.places[name]
        if place.carrier is None:
            raise InvalidInputError(
                f"the fingertip {name!r} does not move, it is part of the palm; choose another"
            )
        axis = np.array(next(joint.axis for joint in self.moving if joint.child == place.carrier))
        group = self._group(name)
        own_pieces = self._points(group)
        pieces = own_pieces or self._points(self._group(place.carrier))
        # a link ends where its shapes are farthest, or at the given tip
        if ball is not None:
            ball = Ball(_moved(place.frame, ball.center), ball.radius)
            ends = np.array([ball.center])
        else:
            ends = np.vstack(own_pieces) if own_pieces else place.frame.origin[None]
        if np.linalg.norm(ends, axis=1).max() < _NEAR and pieces:
            ends = np.vstack(pieces)
        direction = end_direction(ends, axis, self._outward(place.carrier, ends))
        if ball is None:
            ball = self._sphere(name, group, pieces, direction)
        if ball is None and radius is not None:
            ball = Ball(place.frame.numbers()[0], radius)
        if ball is None and pieces:
            ball = inscribed(pieces, direction, axis)
        if ball is None:
            raise InvalidInputError(
                f"the fingertip {name!r} has no shape to lie in; pass tip_radius=, or fingertips={{{name!r}: (point, radius)}}"
            )
        return Fingertip(name, place.carrier, *ball), direction

    def _outward(self, link: str, points: Array) -> Array:
        """Return the vector (3,) from the palm's middle to a link's points (K, 3) [m], link frame.

        All joints are at 0.
        """
        frame, above = IDENTITY, link
        while above is not None:
            joint = next(joint for joint in self.moving if joint.child == above)
            above, outer = self.places[joint.parent]
            frame = outer @ Frame.of(joint.origin, joint.rotation) @ frame
        palm = [outline(shape) for shape in self._shapes(self.root, None)[0]]
        middle = np.vstack(palm).mean(axis=0) if palm else np.zeros(3)
        return frame.rotation.T @ (frame.rotation @ points.mean(axis=0) + frame.origin - middle)

    def _sphere(
        self, name: str, group: list[str], pieces: list[Array], direction: Array
    ) -> Ball | None:
        """Return the only sphere of a link, or else of those fixed to it, if it is at the end."""
        spheres = [
            [
                Ball(_moved(self.places[link].frame, shape.origin), shape.size[0])
                for link in links
                for shape in self.links[link].collision
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


def _with_tips(link: Link, tips: list[tuple[Fingertip, Array]]) -> Link:
    """Return the link with a sphere for each fingertip, its other shapes cut back behind them."""
    for tip, direction in tips:
        link = cut_back(link, Ball(tip.center, tip.radius), direction)
        centers = [shape.origin for shape in link.collision if shape.kind == "sphere"]
        if all(math.dist(center, tip.center) >= 1e-12 for center in centers):
            sphere = Geometry("sphere", (tip.radius,), tip.center)
            link = replace(link, collision=(*link.collision, sphere), visual=(*link.visual, sphere))
    return link


def _moved(frame: Frame, point: Vector3) -> Vector3:
    """Transform a point [m] to the outer frame; the identity changes no digit."""
    return frame.carry(point, (0.0, 0.0, 0.0))[0]


def _ranged(joint: FileJoint, limits: tuple[float, float] | None) -> FileJoint:
    return joint if limits is None else replace(joint, lower=limits[0], upper=limits[1])
