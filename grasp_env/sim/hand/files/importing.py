"""Assemble a hand from the links and joints of a file.

Links behind a fixed joint are merged into their parent. One warning lists all repairs, one error
all faults.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
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
from grasp_env.sim.hand.files.arranging import arrange
from grasp_env.sim.hand.files.elements import NO_INERTIA, FileJoint, HandFile, names_of
from grasp_env.sim.hand.files.ends import Ends, find_ends, fitted_tips
from grasp_env.sim.hand.files.fixed_jaw import fixed_jaw
from grasp_env.sim.hand.files.groups import Groups
from grasp_env.sim.hand.files.joints import fill_ranges, find_rods, free_ranges, judge_ranges
from grasp_env.sim.hand.files.options import HandOptions, Inertial
from grasp_env.sim.hand.files.part import read_part
from grasp_env.sim.hand.files.plausible import Body, Judge
from grasp_env.sim.hand.files.urdf import UrdfReader
from grasp_env.sim.hand.files.xacro import robot_of
from grasp_env.sim.hand.inertia import Inertia, inertia_matrix, inertia_numbers, with_rotor
from grasp_env.sim.hand.tips import Ball, cut_back
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Palm
from grasp_env.sim.xml_files import read_xml


class ReadHand(NamedTuple):
    """The parts of a hand in a file; `repairs` says what was assumed, left out or changed."""

    name: str
    palm: Palm
    links: tuple[Link, ...]
    fingertips: tuple[Fingertip, ...]
    repairs: list[str]


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
        robot = robot_of(Path(os.fsdecode(path)), first, expand, arguments)
        return UrdfReader(path, robot, options.checked_palm(), tuple(options.tips() or ()))
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
        part, links, joints = read_part(file, options.checked_palm(), chosen_tips or {})
        ranges = options.ranges([joint.name for joint in joints if not joint.fixed])
        joints, empty = fill_ranges(joints, ranges)
        joints, frozen = arrange(part, [_ranged(joint, ranges.get(joint.name)) for joint in joints])
        joints, wide = judge_ranges(joints, ranges)
        joints, uncoupled = free_ranges(joints, ranges)
        self.use_file_rotors = options.rotor_inertia is None
        if all(joint.fixed for joint in joints):
            why = "no joint moves; a hand needs joints of type revolute, continuous or prismatic"
            raise InvalidInputError("; ".join([why, *frozen]))
        # may take seconds, but meshes are cached by content
        self.links = file.with_shapes(links)
        self.repairs = [*file.notes, *part.notes, *empty, *frozen, *wide, *uncoupled]
        self.groups = groups = Groups(part.root, self.links, joints)
        self.moving = groups.moving
        for reason in dict.fromkeys(file.undrawn.values()):
            names = [name for name, why in file.undrawn.items() if why == reason]
            self.repairs.append(f"visual meshes that {reason} are left out: {names_of(names)}")
        if bare := [name for name in groups.bodies() if groups.only_drawn(name)]:
            self.repairs.append(
                f"links without collision shapes are drawn and touch nothing: {names_of(bare)}; give them <collision> in the file"
            )
        bodies = [self._body(joint) for joint in self.moving]
        drivers = {joint.name: joint.mimic.joint for joint in self.moving if joint.mimic}
        with AllFaults() as check:
            torques = check(options.torques, [joint.name for joint in self.moving], drivers)
            inertials = check(options.bodies, [joint.child for joint in self.moving])
            ends = find_ends(groups) if chosen_tips is None else Ends(list(chosen_tips), [], [])
            balls = chosen_tips or dict.fromkeys(ends.tips)
            tips = check(lambda: fitted_tips(groups, balls, options.radius(), chosen_tips is None))
        self.repairs += ends.notes
        color = self.links[part.root].color or (0.17, 0.19, 0.23)
        palm = Palm(part.root, *groups.shapes(part.root, None), color)
        linked = self._judged(bodies, torques, inertials)
        rods = {*ends.rods}
        if chosen_tips is None:
            rods |= find_rods(linked, [tip for tip, _ in tips])
            tips = [pair for pair in tips if pair[0].name not in rods]
        if rods:
            self.repairs.append(
                f"rods that only move a finger are not fingertips: {names_of(sorted(rods))}"
            )
        linked = [
            _with_tips(link, [pair for pair in tips if pair[0].link == link.name])
            for link in linked
        ]
        fingertips = [tip for tip, _ in tips]
        alone = chosen_tips is None and len(fingertips) == 1
        if alone and (jaw := fixed_jaw(palm, linked, fingertips[0])) is not None:
            linked.append(jaw[0])
            fingertips.append(jaw[1])
            self.repairs.append(jaw[2])
        self.hand = ReadHand(file.name, palm, tuple(linked), tuple(fingertips), self.repairs)

    def _body(self, joint: FileJoint) -> Body:
        carrier, frame = self.groups.places[joint.parent]
        shapes = self.groups.shapes(joint.child, joint.child)
        points = np.vstack([*self.groups.points(self.groups.of(joint.child)), np.empty((0, 3))])
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
                    body.carrier or self.groups.root,
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
        links = [
            (self.groups.places[other].frame, self.links[other]) for other in self.groups.of(name)
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


def _with_tips(link: Link, tips: list[tuple[Fingertip, Array]]) -> Link:
    """Return the link with a sphere for each fingertip, its other shapes cut back behind them."""
    for tip, direction in tips:
        link = cut_back(link, Ball(tip.center, tip.radius), direction)
        centers = [shape.origin for shape in link.collision if shape.kind == "sphere"]
        if all(math.dist(center, tip.center) >= 1e-12 for center in centers):
            sphere = Geometry("sphere", (tip.radius,), tip.center)
            link = replace(link, collision=(*link.collision, sphere), visual=(*link.visual, sphere))
    return link


def _ranged(joint: FileJoint, limits: tuple[float, float] | None) -> FileJoint:
    return joint if limits is None else replace(joint, lower=limits[0], upper=limits[1])
