"""Reads a user's own hand from a URDF: what a fixed joint carries becomes part of the link before it.

Public files have massless links, inertias that no body has, placeholders for torques, meshes. What can be repaired is, and is
told; what cannot is told in one message.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from grasp_env._check import Array, as_list, as_text, is_a, together
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.hand.check import (
    Inertia,
    Vector3,
    inertia_matrix,
    inertia_numbers,
    nearest_inertia,
    numbers,
    positive,
)
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.mesh_uses import refuse
from grasp_env.sim.hand.pieces import hull_of_file
from grasp_env.sim.hand.solids import hull_of, outline
from grasp_env.sim.hand.tips import Ball, distal, freed, inscribed
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Mimic, Palm
from grasp_env.sim.hand.units import look_again
from grasp_env.sim.hand.urdf_elements import Reader, UrdfJoint, names_of

Tips: TypeAlias = Sequence[str] | dict[str, tuple[Sequence[float], float]] | None
"""Names of links; points on them [m], link frame, with radii [m]; None: the last moving links."""
Torques: TypeAlias = float | Sequence[float] | dict[str, float] | None

UNKNOWN_TORQUE, UNKNOWN_FORCE = 1.0, 20.0
"""[N m] and [N] of turning and sliding joints whose file says nothing of use: about what fingers of this size have."""
_PLACEHOLDER = {False: 100.0, True: 1000.0}  # [N m], of sliding joints [N], beyond which no finger's motor is
_NEAR = 1e-3  # [m] of a joint, where there is no direction away from it
_DENSITY, _LEAST_MASS = 1000.0, 1e-3  # [kg/m^3] and [kg] of links without a mass


@dataclass(frozen=True)
class UrdfHand:
    """What a URDF says of a hand.

    Attributes:
        repairs: What was assumed, left out or changed, a sentence each.
    """

    name: str
    palm: Palm
    links: tuple[Link, ...]
    fingertips: tuple[Fingertip, ...]
    repairs: tuple[str, ...]


@dataclass(frozen=True)
class _Place:
    """Where a link of the file ended up: on a moving link, or None for the palm, and where on it."""

    carrier: str | None
    frame: Frame


def read_urdf(
    path: str | os.PathLike[str],
    fingertips: Tips = None,
    tip_radius: float | None = None,
    torque_limit: Torques = None,
) -> UrdfHand:
    """The parts of a hand from a URDF; `HandDescription.from_urdf` describes the arguments.

    Returns:
        Its links with parents before children, else in the order of the file's joints.

    Raises:
        InvalidInputError: The file is no hand that can be simulated.
    """
    asked, radius = together(
        lambda: _asked_tips(fingertips), lambda: None if tip_radius is None else positive(tip_radius, "tip_radius [m]")
    )
    try:
        return _Importer(Reader(path), asked, radius, torque_limit).hand
    except InvalidInputError as error:
        message = str(error)
        raise InvalidInputError(message if message.startswith("cannot read") else f"{path}: {message}") from None


def _asked_tips(fingertips: Any) -> dict[str, Ball | None] | None:
    """What is known of each asked tip; None: nothing asked."""
    if fingertips is None:
        return None
    wrong = InvalidInputError(
        f"fingertips={shown(fingertips)} must be a list of one link name or more, or {{link: (point, radius)}} [m]"
    )
    if is_a(fingertips, dict):
        tips: dict[str, Ball | None] = {}
        for key, value in dict.items(fingertips):
            name, pair = as_text(key), as_list(value)
            if name is None or pair is None or len(pair) != 2:
                raise wrong
            x, y, z = numbers(pair[0], 3, f"fingertips: point [m] of {name!r}")
            tips[name] = Ball((x, y, z), positive(pair[1], f"fingertips: radius [m] of {name!r}"))
        if not tips:
            raise wrong
        return tips
    given = as_list(fingertips) or []
    names = [text for tip in given if (text := as_text(tip)) is not None]
    if not names or len(names) < len(given):
        raise wrong
    for name in names:
        if names.count(name) > 1:
            raise InvalidInputError(f"two fingertips are called {name!r}; give each its own link")
    return dict.fromkeys(names)


class _Importer:
    """Puts a hand together."""

    def __init__(
        self, reader: Reader, asked: dict[str, Ball | None] | None, radius: float | None, torque_limit: Torques
    ) -> None:
        self.repairs: list[str] = []
        (links, joints), root, *_ = together(
            reader.elements,
            lambda: _root(reader.names, reader.ends),
            lambda: _known(asked or {}, reader.names),
            lambda: _mimicked(reader),
        )
        self.root: str = root
        self.joints = _driven(_ordered(root, joints))
        self.moving = [joint for joint in self.joints if not joint.fixed]
        if not self.moving:
            raise InvalidInputError("no joint moves; a hand needs joints of type revolute, continuous or prismatic")
        self.links = reader.shaped(links)  # takes seconds, once for the files' content
        places = {root: _Place(None, Frame.of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))}
        for joint in self.joints:
            here = places[joint.parent].carrier
            frame = places[joint.parent].frame @ Frame.of(joint.origin, joint.rotation)
            own = Frame(np.eye(3), np.zeros(3))
            places[joint.child] = _Place(here, frame) if joint.fixed else _Place(joint.child, own)
        self.places = places
        for why in dict.fromkeys(reader.unseen.values()):
            left = [name for name, reason in reader.unseen.items() if reason == why]
            self.repairs.append(f"visual meshes that {why} are left out: {names_of(left)}")
        torques, fitted = together(lambda: self._torques(torque_limit), lambda: self._tips(asked, radius))
        moving = self._moving(torques)
        tips = [tip for tip, _ in fitted]
        collision, visual = self._shapes(root, None)
        palm = Palm(root, collision, visual, self.links[root].color or (0.17, 0.19, 0.23))
        links = [self._with_tips(link, [pair for pair in fitted if pair[0].link == link.name]) for link in moving]
        self.repairs += look_again(links, tips)
        self.hand = UrdfHand(reader.name, palm, tuple(links), tuple(tips), tuple(self.repairs))

    def _shapes(self, name: str, carrier: str | None) -> tuple[tuple[Geometry, ...], tuple[Geometry, ...]]:
        """Collision and visual shapes of a link and of all that is fixed to it; what has no look shows its collisions."""
        collision: list[Geometry] = []
        visual: list[Geometry] = []
        base = self.links[name].color
        for other, place in self.places.items():
            if place.carrier != carrier:
                continue
            link = self.links[other]
            own = None if link.color == base else link.color
            collision += [_carried(place.frame, shape) for shape in link.collision]
            for shape in link.visual or link.collision:
                visual.append(replace(_carried(place.frame, shape), color=shape.color or own))
        return tuple(collision), tuple(visual)

    def _torques(self, given: Any) -> list[float]:
        """The limit of each moving joint: as given, else as the file says where that can be."""
        if given is not None and not is_a(given, dict) and as_list(given) is None and not is_a(given, np.ndarray):
            return [positive(given, "torque_limit [N m]")] * len(self.moving)
        names = [joint.name for joint in self.moving]
        if given is not None and not is_a(given, dict):
            each = numbers(given, len(names), f"torque_limit [N m], one per joint ({names_of(names)})")
            return together(
                *(
                    lambda v=v, n=n: positive(v, f"torque_limit [N m] of {n!r}")
                    for v, n in zip(each, names, strict=True)
                )
            )
        known = {} if given is None else dict(dict.items(given))
        unknown = [name for name in known if as_text(name) not in names]
        if unknown:
            raise InvalidInputError(
                f"torque_limit: no joint is called {names_of(unknown)}; joints are {names_of(names)}"
            )
        limits, assumed = list[float](), dict[str, list[str]]()
        for joint in self.moving:
            said = joint.effort
            if joint.name in known:
                said = positive(known[joint.name], f"torque_limit [N m] of {joint.name!r}")
            elif said is None or not 0.0 < said <= _PLACEHOLDER[joint.sliding]:
                if joint.mimic is None:
                    assumed.setdefault("no effort" if said is None else f"effort {said:g}", []).append(joint.name)
                said = UNKNOWN_FORCE if joint.sliding else UNKNOWN_TORQUE
            limits.append(said)
        for what, joints in assumed.items():
            self.repairs.append(
                f"{what} of {names_of(joints)} is no motor's limit: {UNKNOWN_TORQUE:g} N m is assumed "
                f"(sliding: {UNKNOWN_FORCE:g} N); give the true one as torque_limit="
            )
        return limits

    def _moving(self, torques: list[float]) -> list[Link]:
        """The links that joints move, each with all that is fixed to it."""
        links, light, bent, astray = list[Link](), list[str](), list[str](), list[str]()
        for joint, torque in zip(self.moving, torques, strict=True):
            before = self.places[joint.parent]
            origin, rotation = before.frame.carry(joint.origin, joint.rotation)
            collision, visual = self._shapes(joint.child, joint.child)
            mass, center, inertia = self._inertial(joint.child)
            if mass <= 0.0:
                mass, center, inertia = _made_up(collision)
                light.append(f"{joint.child} ({1e3 * mass:.2g} g)")
            elif _astray(center, collision):
                mass, center, inertia = _made_up(collision, mass)
                astray.append(joint.child)
            possible = nearest_inertia(inertia, mass)
            if possible is not None:
                bent.append(joint.child)
            links.append(
                Link(
                    name=joint.child,
                    parent=before.carrier or self.root,
                    origin=origin,
                    rotation=rotation,
                    axis=joint.axis,
                    lower=joint.lower,
                    upper=joint.upper,
                    torque_limit=torque,
                    mass=mass,
                    center=center,
                    inertia=inertia if possible is None else possible,
                    collision=collision,
                    visual=visual,
                    color=self.links[joint.child].color or (0.5, 0.5, 0.5),
                    joint=joint.name,
                    sliding=joint.sliding,
                    mimic=joint.mimic,
                )
            )
        if light:
            self.repairs.append(
                f"moving links without mass get that of their shapes at 1 g/cm^3: {', '.join(light[:40])}"
            )
        if astray:
            self.repairs.append(
                f"centres of mass that lie outside their links by more than these measure are put inside: {names_of(astray)}"
            )
        if bent:
            self.repairs.append(f"inertias that no body has are replaced by the nearest possible: {names_of(bent)}")
        return links

    def _inertial(self, name: str) -> tuple[float, Vector3, Inertia]:
        """Mass, centre and inertia about it, of a moving link and all that is fixed to it, in its frame; mass 0: it has none."""
        parts = [
            (
                place.frame @ self.links[other].inertial_frame,
                self.links[other].mass,
                inertia_matrix(self.links[other].inertia),
            )
            for other, place in self.places.items()
            if place.carrier == name and self.links[other].mass > 0.0
        ]
        mass = sum(weight for _, weight, _ in parts)
        if mass <= 0.0:
            return 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        center = sum((weight * frame.origin for frame, weight, _ in parts), np.zeros(3)) / mass
        total = np.zeros((3, 3))
        for frame, weight, inertia in parts:
            arm = frame.origin - center
            total += frame.rotation @ inertia @ frame.rotation.T + weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        x, y, z = center.tolist()
        return mass, (x, y, z), inertia_numbers(0.5 * (total + total.T))

    def _tips(self, asked: dict[str, Ball | None] | None, radius: float | None) -> list[tuple[Fingertip, Array]]:
        """The fingertips, each with the direction in which its link ends."""
        if asked is not None:
            return together(
                *(lambda name=name, ball=ball: self._tip(name, ball, radius) for name, ball in asked.items())
            )
        parents = {self.places[joint.parent].carrier for joint in self.moving}
        ends = [joint.child for joint in self.moving if joint.child not in parents]
        bare = [end for end in ends if not self._points(self._group(end), True)]
        if bare and len(bare) < len(ends):
            self.repairs.append(f"links at the end of a branch that have no shape are no fingertips: {names_of(bare)}")
            ends = [end for end in ends if end not in bare]
        return together(*(lambda end=end: self._tip(end, None, radius) for end in ends))

    def _group(self, name: str) -> list[str]:
        """A link and what is fixed to it."""
        group = [name]
        for joint in self.joints:
            if joint.fixed and joint.parent in group:
                group.append(joint.child)
        return group

    def _points(self, group: Sequence[str], looks: bool) -> list[Array]:
        """The convex pieces (K, 3) [m] of some links' collision shapes, carrier's frame; `looks`: else of their visual ones."""
        solids = [(self.places[name].frame, shape) for name in group for shape in self.links[name].collision]
        if not solids and looks:
            solids = [(self.places[name].frame, shape) for name in group for shape in self.links[name].visual]
        pieces = list[Array]()
        for frame, shape in solids:
            if shape.kind == "mesh":
                place = frame @ Frame.of(shape.origin, shape.rotation)
                corners = hull_of_file(Path(shape.file)) * shape.size
                pieces.append(corners @ place.rotation.T + place.origin)
            else:
                pieces.append(outline(_carried(frame, shape)))
        return pieces

    def _tip(self, name: str, given: Ball | None, radius: float | None) -> tuple[Fingertip, Array]:
        """A fingertip: as given; the one sphere at the link's end; one of a given radius at its origin; or the inscribed one."""
        place = self.places[name]
        if place.carrier is None:
            raise InvalidInputError(f"the fingertip {name!r} does not move, it is part of the palm; choose another")
        joint = next(joint for joint in self.moving if joint.child == place.carrier)
        axis = np.array(joint.axis)
        group = self._group(name)
        own = self._points(group, True)
        pieces = own or self._points(self._group(place.carrier), True)
        ball = None if given is None else Ball(_moved(place.frame, given.center), given.radius)
        # a link ends where its shapes are farthest, or where the tip is said to be
        ends = (
            np.vstack(own) if own and ball is None else np.array([place.frame.origin if ball is None else ball.center])
        )
        if np.linalg.norm(ends, axis=1).max() < _NEAR and pieces:
            ends = np.vstack(pieces)
        direction = distal(ends, None if joint.sliding else axis)
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

    def _sphere(self, name: str, group: list[str], pieces: list[Array], direction: Array) -> Ball | None:
        """The one sphere among the collision shapes of a link, or of what is fixed to it, where it is at the end of the link."""
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
        return spheres[0] if end <= float(direction @ spheres[0].center) + 3.0 * spheres[0].radius else None

    def _with_tips(self, link: Link, tips: list[tuple[Fingertip, Array]]) -> Link:
        """The link with a sphere for each fingertip that had none, its other shapes behind them."""
        for tip, direction in tips:
            sphere = Geometry("sphere", (tip.radius,), tip.center)
            link = freed(link, Ball(tip.center, tip.radius), direction)
            there = any(
                shape.kind == "sphere" and math.dist(shape.origin, tip.center) < 1e-12 for shape in link.collision
            )
            if not there:
                link = replace(link, collision=(*link.collision, sphere), visual=(*link.visual, sphere))
        return link


def _moved(frame: Frame, point: Vector3) -> Vector3:
    """A point [m] of a frame, in the outer one; its digits stay if they can."""
    return frame.carry(point, (0.0, 0.0, 0.0))[0]


def _carried(frame: Frame, shape: Geometry) -> Geometry:
    origin, angles = frame.carry(shape.origin, shape.rotation)
    return replace(shape, origin=origin, rotation=angles)


def _astray(center: Vector3, shapes: Sequence[Geometry]) -> bool:
    """Whether a centre of mass is farther outside the box around a link's shapes than that is large."""
    if not shapes:
        return False
    points = np.vstack([outline(shape) for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    away = np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0))
    return bool(away > (high - low).max())


def _made_up(shapes: Sequence[Geometry], known: float = 0.0) -> tuple[float, Vector3, Inertia]:
    """Mass, centre and inertia of a link of which the file knows none, or the mass alone: of a box around its shapes, 1 g at least."""
    points = np.vstack([outline(shape) for shape in shapes]) if shapes else np.zeros((1, 3))
    volume = sum(float(hull_of(outline(shape)).volume) for shape in shapes)
    mass = known or max(_LEAST_MASS, _DENSITY * volume)
    x, y, z = (0.5 * (points.min(axis=0) + points.max(axis=0))).tolist()
    a, b, c = (np.maximum(np.ptp(points, axis=0), 0.01) ** 2 * mass / 12.0).tolist()
    return mass, (x, y, z), (b + c, 0.0, 0.0, a + c, 0.0, a + b)


def _known(tips: Mapping[str, Any], links: list[str]) -> None:
    missing = [tip for tip in tips if tip not in links]
    if missing:
        raise InvalidInputError(f"no link is called {', '.join(map(repr, missing))}; links are {names_of(links)}")


def _root(links: list[str], ends: list[tuple[str, str, str]]) -> str:
    """The one link that no joint carries.

    Raises:
        InvalidInputError: All that keeps the links from being a tree.
    """
    children: dict[str, str] = {}
    faults = list[str]()
    for joint, *pair in ends:
        faults += [
            f"joint {joint!r} names the link {link!r}, which is not in the file; links are {names_of(links)}"
            for link in pair
            if link and link not in links
        ]
        child = pair[1]
        if child and child in children:
            faults.append(
                f"link {child!r} hangs on two joints, {children[child]!r} and {joint!r}; a hand must be a tree, cut the loop"
            )
        children[child] = joint
    roots = [link for link in dict.fromkeys(links) if link not in children]
    if not roots:
        faults.append("every link is carried by a joint, so the joints form a cycle; cut it")
    elif len(roots) > 1 and not faults:
        faults.append(
            f"{len(roots)} links are carried by no joint, {names_of(roots)}; one of them is the palm, "
            "fix the others to it with joints of type fixed"
        )
    known, grew = {*roots}, True
    while grew and not faults:
        reached = {child for _, parent, child in ends if parent in known} - known
        known, grew = known | reached, bool(reached)
    if not faults and (rest := [joint for joint, parent, _ in ends if parent not in known]):
        faults.append(f"the joints {names_of(rest)} form a cycle apart from {roots[0]!r}; cut it")
    together(*(lambda fault=fault: refuse(fault) for fault in faults))
    return roots[0]


def _ordered(root: str, joints: list[UrdfJoint]) -> list[UrdfJoint]:
    """Joints of a tree with parents before children, else in the order of the file."""
    ordered, known, rest = list[UrdfJoint](), {root}, list(joints)
    while rest:
        ready = next(joint for joint in rest if joint.parent in known)
        rest.remove(ready)
        ordered.append(ready)
        known.add(ready.child)
    return ordered


def _mimicked(reader: Reader) -> None:
    """Every mimicked joint moves, and none mimics itself in the end."""
    others, fixed = reader.mimics, reader.fixed
    faults = list[str]()
    for joint, other in others.items():
        known = [name for name, _, _ in reader.ends]
        if other not in known:
            faults.append(
                f"joint {joint!r} mimics {other!r}, which is no joint of the file; joints are {names_of(known)}"
            )
        elif other in fixed:
            faults.append(
                f"joint {joint!r} mimics {other!r}, which does not move; make both of them fixed, or move {other!r}"
            )
        seen = [joint]
        while seen[-1] in others and others[seen[-1]] not in seen:
            seen.append(others[seen[-1]])
        if others.get(seen[-1]) == joint:
            faults.append(f"the joints {names_of(sorted(seen))} mimic each other in a loop; one of them needs a motor")
    together(*(lambda fault=fault: refuse(fault) for fault in faults))


def _driven(joints: list[UrdfJoint]) -> list[UrdfJoint]:
    """The joints, those that mimic others coupled to the one with a motor at the end of the chain."""
    by_name = {joint.name: joint for joint in joints}
    driven = list[UrdfJoint]()
    for joint in joints:
        mimic = joint.mimic
        while mimic is not None and (before := by_name[mimic.joint].mimic) is not None:
            mimic = Mimic(before.joint, mimic.ratio * before.ratio, mimic.angle(before.offset))
        driven.append(replace(joint, mimic=mimic))
    return driven
