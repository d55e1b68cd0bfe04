"""Assemble a hand from the links and joints of a file: links behind a fixed joint are merged into
their parent.

All repairs of impossible or missing values are listed in one warning, all faults in one error.
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
    """The parts of a hand in a file, and a sentence for each thing that was assumed, left out or
    changed.
    """

    name: str
    palm: Palm
    links: tuple[Link, ...]
    fingertips: tuple[Fingertip, ...]
    repairs: list[str]


class _Place(NamedTuple):
    """The place of a file's link: the moving link to which it belongs, None for the palm, and its
    frame in that link.
    """

    carrier: str | None
    frame: Frame


def read_hand(path: str | os.PathLike[str], options: HandOptions) -> ReadHand:
    """Read the parts of a hand from a file, see `HandDescription.from_file`; links stand in the
    order of the joints, after their parents.
    """
    with AllFaults() as check:
        check(options.checked_palm)
        check(options.tips)
        check(options.radius)
        check(options.expansion)
    try:
        return _Importer(_opened(path, options), options).hand
    except InvalidInputError as error:
        message = str(error)
        raise InvalidInputError(
            message if message.startswith("cannot read") else f"{path}: {message}"
        ) from None


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
    """An importer that assembles the hand of one file."""

    def __init__(self, file: HandFile, options: HandOptions) -> None:
        given_tips = options.tips()
        part, self.links, joints = read_part(file, options.checked_palm(), given_tips or {})
        ranges = options.ranges([joint.name for joint in joints if not joint.fixed])
        joints, held = arrange(part, [_ranged(joint, ranges.get(joint.name)) for joint in joints])
        joints, wide = judge_ranges(joints, ranges)
        self.joints, uncoupled = free_ranges(joints, ranges)
        self.root = part.root
        self.own_rotors = options.rotor_inertia is None
        self.repairs = [*file.notes, *part.notes, *held, *wide, *uncoupled]
        self.moving = [joint for joint in self.joints if not joint.fixed]
        if not self.moving:
            sentences = [
                "no joint moves; a hand needs joints of type revolute, continuous or prismatic",
                *held,
            ]
            raise InvalidInputError("; ".join(sentences))
        # may take seconds, but meshes are cached by content
        self.links = file.with_shapes(self.links)
        self.places = self._placed()
        for why in dict.fromkeys(file.undrawn.values()):
            left = [name for name, reason in file.undrawn.items() if reason == why]
            self.repairs.append(f"visual meshes that {why} are left out: {names_of(left)}")
        groups = [self._group(joint.child) for joint in self.moving]
        self._corners = hulls_of_files(
            shape.file
            for group in groups
            for _, shape in self._outlines(group)
            if shape.kind == "mesh"
        )
        bodies = [self._body(joint) for joint in self.moving]
        drivers = {
            joint.name: joint.mimic.joint for joint in self.moving if joint.mimic is not None
        }
        with AllFaults() as check:
            torques = check(options.torques, [joint.name for joint in self.moving], drivers)
            inertials = check(options.bodies, [joint.child for joint in self.moving])
            fitted = check(lambda: self._tips(given_tips, options.radius()))
        palm = Palm(
            self.root,
            *self._shapes(self.root, None),
            self.links[self.root].color or (0.17, 0.19, 0.23),
        )
        links = self._judged(bodies, torques, inertials)
        if given_tips is None and (rods := find_rods(links, [tip for tip, _ in fitted])):
            self.repairs.append(
                f"rods that only move a finger are not fingertips: {names_of(sorted(rods))}"
            )
            fitted = [pair for pair in fitted if pair[0].name not in rods]
        links = [
            self._with_tips(link, [pair for pair in fitted if pair[0].link == link.name])
            for link in links
        ]
        tips = tuple(tip for tip, _ in fitted)
        self.hand = ReadHand(file.name, palm, tuple(links), tips, self.repairs)

    def _placed(self) -> dict[str, _Place]:
        """Return the place of each link."""
        places = {self.root: _Place(None, IDENTITY)}
        for joint in self.joints:
            carrier, frame = places[joint.parent]
            fixed = _Place(carrier, frame @ Frame.of(joint.origin, joint.rotation))
            places[joint.child] = fixed if joint.fixed else _Place(joint.child, IDENTITY)
        return places

    def _shapes(
        self, name: str, carrier: str | None
    ) -> tuple[tuple[Geometry, ...], tuple[Geometry, ...]]:
        """Return collision and visual shapes of a link with everything fixed to it; links without
        visuals show their collisions.
        """
        collision = list[Geometry]()
        visual = list[Geometry]()
        for other, place in self.places.items():
            if place.carrier != carrier:
                continue
            link = self.links[other]
            own = None if link.color == self.links[name].color else link.color
            collision += [shape.carried(place.frame) for shape in link.collision]
            for shape in link.visual or link.collision:
                visual.append(replace(shape.carried(place.frame), color=shape.color or own))
        return tuple(collision), tuple(visual)

    def _body(self, joint: FileJoint) -> Body:
        """Return the body that a joint moves."""
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
        for body, own, limit in zip(
            bodies, judge.inertials(inertials), judge.torques(torques), strict=True
        ):
            joint = body.joint
            turned = self.own_rotors and joint.rotor > 0.0 and not joint.sliding
            inertia = with_rotor(own.inertia, joint.rotor) if turned else own.inertia
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
                    own.mass,
                    own.center,
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
        """Return mass, centre and inertia of a moving link with everything fixed to it, in its
        frame; mass 0: the file has none.
        """
        links = [
            (place.frame, self.links[other])
            for other, place in self.places.items()
            if place.carrier == name
        ]
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
        self, given: dict[str, Ball | None] | None, radius: float | None
    ) -> list[tuple[Fingertip, Array]]:
        """Return the fingertips, each with the direction in which its link ends."""
        if given is None:
            parents = {self.places[joint.parent].carrier for joint in self.moving}
            ends = [joint.child for joint in self.moving if joint.child not in parents]
            bare = [end for end in ends if not self._points(self._group(end))]
            if bare and len(bare) < len(ends):
                self.repairs.append(
                    f"end links without a shape are not fingertips: {names_of(bare)}"
                )
                ends = [end for end in ends if end not in bare]
            given = dict.fromkeys(ends)
        with AllFaults() as check:
            return [check(self._tip, name, ball, radius) for name, ball in given.items()]

    def _group(self, name: str) -> list[str]:
        """Return the names of a link and of everything fixed to it."""
        group = [name]
        for joint in self.joints:
            group += [joint.child] if joint.fixed and joint.parent in group else []
        return group

    def _outlines(self, group: Sequence[str]) -> list[tuple[Frame, Geometry]]:
        """Return the collision shapes of links, or else their visuals, each with the frame of its
        link in the carrier's.
        """
        solids = [
            (self.places[name].frame, shape)
            for name in group
            for shape in self.links[name].collision
        ]
        looks = [
            (self.places[name].frame, shape) for name in group for shape in self.links[name].visual
        ]
        return solids or looks

    def _points(self, group: Sequence[str]) -> list[Array]:
        """Return convex pieces (K, 3) [m] of the `_outlines` of links, carrier's frame."""
        pieces = list[Array]()
        for frame, shape in self._outlines(group):
            if shape.kind == "mesh":
                place = frame @ Frame.of(shape.origin, shape.rotation)
                if shape.file not in self._corners:
                    self._corners |= hulls_of_files([shape.file])
                pieces.append(
                    self._corners[shape.file] * shape.size @ place.rotation.T + place.origin
                )
            else:
                pieces.append(outline(shape.carried(frame)))
        return pieces

    def _tip(self, name: str, given: Ball | None, radius: float | None) -> tuple[Fingertip, Array]:
        """Return a fingertip: as given; the one sphere at the link's end; one of a given radius at
        its origin; or the inscribed one.
        """
        place = self.places[name]
        if place.carrier is None:
            raise InvalidInputError(
                f"the fingertip {name!r} does not move, it is part of the palm; choose another"
            )
        axis = np.array(next(joint.axis for joint in self.moving if joint.child == place.carrier))
        group = self._group(name)
        own = self._points(group)
        pieces = own or self._points(self._group(place.carrier))
        ball = None if given is None else Ball(_moved(place.frame, given.center), given.radius)
        # a link ends where its shapes are farthest, or at the given tip
        ends = (
            np.array([ball.center]) if ball else np.vstack(own) if own else place.frame.origin[None]
        )
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
        """Return the vector (3,) from the middle of the palm to points (K, 3) of a link [m], in its
        frame, with all joints at 0.
        """
        own, above = IDENTITY, link
        while above is not None:
            joint = next(joint for joint in self.moving if joint.child == above)
            above, frame = self.places[joint.parent]
            own = frame @ Frame.of(joint.origin, joint.rotation) @ own
        palm = [outline(shape) for shape in self._shapes(self.root, None)[0]]
        middle = np.vstack(palm).mean(axis=0) if palm else np.zeros(3)
        return own.rotation.T @ (own.rotation @ points.mean(axis=0) + own.origin - middle)

    def _sphere(
        self, name: str, group: list[str], pieces: list[Array], direction: Array
    ) -> Ball | None:
        """Return the only sphere among the collision shapes of a link, or of links fixed to it, if
        it is at the end of the link.
        """
        spheres = [
            Ball(_moved(self.places[link].frame, shape.origin), shape.size[0])
            for link in group
            for shape in self.links[link].collision
            if shape.kind == "sphere"
        ]
        own = sum(shape.kind == "sphere" for shape in self.links[name].collision)
        spheres = spheres[:own] if own else spheres
        if len(spheres) != 1:
            return None
        end = max(float((piece @ direction).max()) for piece in pieces)
        return (
            spheres[0]
            if end <= float(direction @ spheres[0].center) + 3.0 * spheres[0].radius
            else None
        )

    def _with_tips(self, link: Link, tips: list[tuple[Fingertip, Array]]) -> Link:
        """Return the link with a sphere for each fingertip, its other shapes cut back behind them."""
        for tip, direction in tips:
            link = cut_back(link, Ball(tip.center, tip.radius), direction)
            balls = [shape.origin for shape in link.collision if shape.kind == "sphere"]
            if all(math.dist(center, tip.center) >= 1e-12 for center in balls):
                sphere = Geometry("sphere", (tip.radius,), tip.center)
                link = replace(
                    link, collision=(*link.collision, sphere), visual=(*link.visual, sphere)
                )
        return link


def _moved(frame: Frame, point: Vector3) -> Vector3:
    """Transform a point [m] to the outer frame; the identity changes no digit."""
    return frame.carry(point, (0.0, 0.0, 0.0))[0]


def _ranged(joint: FileJoint, limits: tuple[float, float] | None) -> FileJoint:
    return joint if limits is None else replace(joint, lower=limits[0], upper=limits[1])
