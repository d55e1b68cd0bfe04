"""Reads a user's own hand from a URDF: what a fixed joint carries becomes part of the link before it."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grasp_env._check import as_list, as_text
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.hand.check import Inertia, inertia_matrix, inertia_numbers, positive
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Palm
from grasp_env.sim.hand.urdf_elements import UrdfJoint, UrdfLink, read_elements


@dataclass(frozen=True)
class _Place:
    """Where a link of the file ended up: on a moving link, or None for the palm, and where on it."""

    carrier: str | None
    frame: Frame


def read_urdf(
    path: str | os.PathLike[str],
    fingertips: Sequence[str],
    tip_radius: float | None = None,
    torque_limit: float | None = None,
) -> tuple[str, Palm, tuple[Link, ...], tuple[Fingertip, ...]]:
    """The parts of a hand from a URDF; `HandDescription.from_urdf` describes the arguments.

    Returns:
        Name, palm, links (parents before children, else in the order of the file's joints) and fingertips.

    Raises:
        InvalidInputError: The file is no hand that can be simulated.
    """
    given = as_list(fingertips) or []
    tips = [text for tip in given if (text := as_text(tip)) is not None]
    if not tips or len(tips) < len(given):
        raise InvalidInputError(f"fingertips={shown(fingertips)} must be a list of one link name or more")
    fingertips = tips
    name, links, joints = read_elements(path)
    missing = [tip for tip in fingertips if tip not in links]
    if missing:
        raise InvalidInputError(f"{path}: no link is called {', '.join(map(repr, missing))}; links are {_names(links)}")
    root = _root(path, links, joints)
    ordered = _ordered(path, root, links, joints)
    places = {root: _Place(None, Frame.of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))}
    for joint in ordered:
        here = places[joint.parent].carrier
        frame = places[joint.parent].frame @ Frame.of(joint.origin, joint.rotation)
        places[joint.child] = _Place(here, frame) if joint.fixed else _Place(joint.child, Frame(np.eye(3), np.zeros(3)))
    moving = tuple(_moving_link(path, joint, links, places, root, torque_limit) for joint in ordered if not joint.fixed)
    if not moving:
        raise InvalidInputError(f"{path}: no joint moves; a hand needs joints of type revolute or continuous")
    collision, visual = _shapes(root, None, links, places)
    palm = Palm(root, collision, visual, links[root].color or (0.17, 0.19, 0.23))
    tips = tuple(_fingertip(path, tip, links, places, ordered, tip_radius) for tip in fingertips)
    return name, palm, _with_spheres(moving, tips), tips


def _names(values: Sequence[str] | dict[str, UrdfLink]) -> str:
    return ", ".join(map(repr, values))


def _root(path: object, links: dict[str, UrdfLink], joints: list[UrdfJoint]) -> str:
    """The one link that no joint carries."""
    children: dict[str, str] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise InvalidInputError(
                    f"{path}: joint {joint.name!r} names the link {link!r}, which is not in the file; "
                    f"links are {_names(links)}"
                )
        if joint.child in children:
            raise InvalidInputError(
                f"{path}: link {joint.child!r} hangs on two joints, {children[joint.child]!r} and {joint.name!r}; "
                "a hand must be a tree, cut the loop"
            )
        children[joint.child] = joint.name
    roots = [link for link in links if link not in children]
    if not roots:
        raise InvalidInputError(f"{path}: every link is carried by a joint, so the joints form a cycle; cut it")
    if len(roots) > 1:
        raise InvalidInputError(
            f"{path}: {len(roots)} links are carried by no joint, {_names(roots)}; one of them is the palm, "
            "fix the others to it with joints of type fixed"
        )
    return roots[0]


def _ordered(path: object, root: str, links: dict[str, UrdfLink], joints: list[UrdfJoint]) -> list[UrdfJoint]:
    """Joints with parents before children, else in the order of the file."""
    ordered, known, rest = list[UrdfJoint](), {root}, list(joints)
    while rest:
        ready = next((joint for joint in rest if joint.parent in known), None)
        if ready is None:
            cycle = [joint.name for joint in rest]
            raise InvalidInputError(f"{path}: the joints {_names(cycle)} form a cycle apart from {root!r}; cut it")
        rest.remove(ready)
        ordered.append(ready)
        known.add(ready.child)
    return ordered


def _shapes(
    name: str, carrier: str | None, links: dict[str, UrdfLink], places: dict[str, _Place]
) -> tuple[tuple[Geometry, ...], tuple[Geometry, ...]]:
    """Collision and visual shapes of a link and of all that is fixed to it; what has no look shows its collisions."""
    collision: list[Geometry] = []
    visual: list[Geometry] = []
    base = links[name].color
    for other, place in places.items():
        if place.carrier != carrier:
            continue
        link = links[other]
        own = None if link.color == base else link.color
        collision += [_carried(place.frame, shape) for shape in link.collision]
        for shape in link.visual or link.collision:
            visual.append(replace(_carried(place.frame, shape), color=shape.color or own))
    return tuple(collision), tuple(visual)


def _carried(frame: Frame, shape: Geometry) -> Geometry:
    origin, angles = frame.carry(shape.origin, shape.rotation)
    return replace(shape, origin=origin, rotation=angles)


def _moving_link(
    path: object,
    joint: UrdfJoint,
    links: dict[str, UrdfLink],
    places: dict[str, _Place],
    root: str,
    torque_limit: float | None,
) -> Link:
    """The link a joint moves, with all that is fixed to it."""
    before = places[joint.parent]
    origin, rotation = before.frame.carry(joint.origin, joint.rotation)
    mass, center, inertia = _inertial(path, joint.child, links, places)
    collision, visual = _shapes(joint.child, joint.child, links, places)
    effort = joint.effort or torque_limit  # many files say 0 for "unknown"
    if effort is None or effort <= 0.0:
        raise InvalidInputError(
            f"{path}: joint {joint.name!r} names no effort above 0; add <limit effort=...> [N m] or pass torque_limit="
        )
    return Link(
        name=joint.child,
        parent=before.carrier or root,
        origin=origin,
        rotation=rotation,
        axis=joint.axis,
        lower=joint.lower,
        upper=joint.upper,
        torque_limit=effort,
        mass=mass,
        center=center,
        inertia=inertia,
        collision=collision,
        visual=visual,
        color=links[joint.child].color or (0.5, 0.5, 0.5),
        joint=joint.name,
    )


def _inertial(
    path: object, name: str, links: dict[str, UrdfLink], places: dict[str, _Place]
) -> tuple[float, tuple[float, float, float], Inertia]:
    """Mass, centre and inertia about it, of a moving link and all that is fixed to it, in its frame."""
    parts = [
        (place.frame @ links[other].inertial_frame, links[other].mass, inertia_matrix(links[other].inertia))
        for other, place in places.items()
        if place.carrier == name and links[other].mass > 0.0
    ]
    if not parts:
        raise InvalidInputError(
            f"{path}: the moving link {name!r} has no mass; write an <inertial> with mass and inertia for it"
        )
    mass = sum(weight for _, weight, _ in parts)
    center = sum((weight * frame.origin for frame, weight, _ in parts), np.zeros(3)) / mass
    total = np.zeros((3, 3))
    for frame, weight, inertia in parts:
        arm = frame.origin - center
        total += frame.rotation @ inertia @ frame.rotation.T + weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = center.tolist()
    return mass, (x, y, z), inertia_numbers(0.5 * (total + total.T))


def _fingertip(
    path: object,
    name: str,
    links: dict[str, UrdfLink],
    places: dict[str, _Place],
    ordered: list[UrdfJoint],
    tip_radius: float | None,
) -> Fingertip:
    """The one sphere of a link, or of what is fixed to it, as a fingertip."""
    place = places[name]
    if place.carrier is None:
        raise InvalidInputError(f"{path}: the fingertip {name!r} does not move, it is part of the palm; choose another")
    candidates, group = [name], {name}
    for joint in ordered:
        if joint.fixed and joint.parent in group:
            group.add(joint.child)
            candidates.append(joint.child)
    spheres = [
        (places[link].frame @ Frame.of(shape.origin, shape.rotation), shape.size[0])
        for link in candidates
        for shape in links[link].collision
        if shape.kind == "sphere"
    ]
    own = sum(shape.kind == "sphere" for shape in links[name].collision)
    spheres = spheres[:own] if own else spheres
    if not spheres and tip_radius is not None:
        spheres = [(place.frame, positive(tip_radius, "tip_radius [m]"))]
    if len(spheres) != 1:
        found = "no sphere" if not spheres else f"{len(spheres)} spheres"
        raise InvalidInputError(
            f"{path}: the fingertip {name!r} has {found} among its collision shapes and needs one; "
            + ("add one, or pass tip_radius=" if not spheres else "leave one, or name a link with one")
        )
    frame, radius = spheres[0]
    return Fingertip(name, place.carrier, frame.numbers()[0], radius)


def _with_spheres(links: tuple[Link, ...], tips: tuple[Fingertip, ...]) -> tuple[Link, ...]:
    """The links with a sphere for each fingertip that had none."""
    result = []
    for link in links:
        for tip in tips:
            sphere = Geometry("sphere", (tip.radius,), tip.center)
            there = any(
                shape.kind == "sphere" and math.dist(shape.origin, tip.center) < 1e-12 for shape in link.collision
            )
            if tip.link == link.name and not there:
                link = replace(link, collision=(*link.collision, sphere), visual=(*link.visual, sphere))
        result.append(link)
    return tuple(result)
