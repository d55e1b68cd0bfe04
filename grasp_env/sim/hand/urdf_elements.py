"""The elements of a URDF file as numbers, each checked where it is read."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env._files import parsed, shown_path
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.hand.check import Inertia, Vector3, inertia_of, limits, numbers
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.tree import Geometry

_MOVING, _FIXED = ("revolute", "continuous"), "fixed"


@dataclass(frozen=True)
class UrdfLink:
    """A <link>: mass 0 and unit inertia where it has no <inertial>; `color` is that of its first visual."""

    name: str
    mass: float
    inertial_frame: Frame
    inertia: Inertia
    collision: tuple[Geometry, ...]
    visual: tuple[Geometry, ...]
    color: Vector3 | None


@dataclass(frozen=True)
class UrdfJoint:
    """A <joint>: `origin` and `rotation` put the child at angle 0; `effort` is None where it names none."""

    name: str
    parent: str
    child: str
    fixed: bool
    origin: Vector3
    rotation: Vector3
    axis: Vector3
    lower: float
    upper: float
    effort: float | None


def read_elements(path: str | os.PathLike[str]) -> tuple[str, dict[str, UrdfLink], list[UrdfJoint]]:
    """Name of the robot, its links by name, and its joints in the order of the file.

    Raises:
        InvalidInputError: No such file, no XML, or an element that a hand cannot have.
    """
    hint = "; a URDF is plain XML, so run xacro files through xacro first"
    robot = parsed(path, ElementTree.fromstring, InvalidInputError, f"the URDF {shown_path(path)}", "XML", hint)
    if robot.tag != "robot":
        raise InvalidInputError(f"{path}: the first element is <{robot.tag}>, a URDF starts with <robot name=...>")
    palette = {
        material.get("name", ""): color
        for material in robot.iter("material")
        if (color := _color(material, f"{path}: material")) is not None
    }
    links: dict[str, UrdfLink] = {}
    for element in robot.findall("link"):
        link = _link(element, _name(element, f"{path}: <link>"), f"{path}", palette)
        if link.name in links:
            raise InvalidInputError(f"{path}: two links are called {link.name!r}; give each its own name")
        links[link.name] = link
    if not links:
        raise InvalidInputError(f"{path}: there is no <link>; a hand has a palm and moving links")
    joints = [_joint(element, f"{path}") for element in robot.findall("joint")]
    names = [joint.name for joint in joints]
    for name in names:
        if names.count(name) > 1:
            raise InvalidInputError(f"{path}: two joints are called {name!r}; give each its own name")
    return robot.get("name") or "hand", links, joints


def _name(element: Element, where: str) -> str:
    name = element.get("name", "")
    if not name.strip():
        raise InvalidInputError(f"{where} has no name; write name=...")
    return name


def _row(element: Element | None, key: str, count: int, default: str | None, where: str) -> tuple[float, ...]:
    """An attribute of `count` numbers; `default` stands for a missing element or attribute."""
    text = default if element is None else element.get(key, default)
    if text is None:
        raise InvalidInputError(f"{where} lacks {key}=")
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        raise InvalidInputError(f"{where}: {key}={shown(text.split())} must be {count} numbers") from None
    return numbers(values, count, f"{where}: {key}")


def _number(element: Element | None, key: str, default: str | None, where: str) -> float:
    return _row(element, key, 1, default, where)[0]


def _origin(element: Element, where: str) -> tuple[Vector3, Vector3]:
    """Position [m] and roll, pitch, yaw [rad] of an <origin>, zero where there is none."""
    origin = element.find("origin")
    x, y, z = _row(origin, "xyz", 3, "0 0 0", f"{where}, <origin>")
    roll, pitch, yaw = _row(origin, "rpy", 3, "0 0 0", f"{where}, <origin>")
    return (x, y, z), (roll, pitch, yaw)


def _color(material: Element, where: str) -> Vector3 | None:
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, _ = _row(color, "rgba", 4, None, f"{where}, <color>")
    return red, green, blue


def _link(element: Element, name: str, path: str, palette: dict[str, Vector3]) -> UrdfLink:
    where = f"{path}: link {name!r}"
    mass, frame, inertia = 0.0, Frame.of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    inertial = element.find("inertial")
    if inertial is not None:
        mass = _number(inertial.find("mass"), "value", None, f"{where}, <inertial>, <mass>")
        if mass < 0.0:
            raise InvalidInputError(f"{where}: mass={mass} kg must be above 0")
        frame = Frame.of(*_origin(inertial, f"{where}, <inertial>"))
        if mass > 0.0:
            inertia = _inertia(inertial.find("inertia"), where)
    collision, visual, color = [], [], None
    for shape in element.findall("collision"):
        geometry = _geometry(shape, f"{where}, <collision>", None)
        if geometry is None:
            raise InvalidInputError(
                f"{where}: its collision shape is a mesh; replace it by spheres, capsules, boxes or cylinders. "
                "Meshes to look at may stay, they are left out"
            )
        collision.append(geometry)
    for shape in element.findall("visual"):
        own = _look(shape, f"{where}, <visual>", palette)
        color = color or own
        geometry = _geometry(shape, f"{where}, <visual>", None if own == color else own)
        if geometry is not None:
            visual.append(geometry)
    return UrdfLink(name, mass, frame, inertia, tuple(collision), tuple(visual), color)


def _inertia(element: Element | None, where: str) -> Inertia:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    required = ("ixx", "iyy", "izz")
    values = [
        _number(element, name, None if name in required else "0", f"{where}, <inertial>, <inertia>") for name in names
    ]
    return inertia_of(values, where)


def _look(element: Element, where: str, palette: dict[str, Vector3]) -> Vector3 | None:
    material = element.find("material")
    if material is None:
        return None
    return _color(material, where) or palette.get(material.get("name", ""))


def _geometry(element: Element, where: str, color: Vector3 | None) -> Geometry | None:
    """The shape of a <visual> or <collision>; None for a mesh."""
    geometry = element.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None:
        raise InvalidInputError(f"{where} has no shape in its <geometry>; write a sphere, capsule, box or cylinder")
    if shape.tag == "mesh":
        return None
    if shape.tag == "box":
        size = _row(shape, "size", 3, None, f"{where}, <box>")
    elif shape.tag == "sphere":
        size = _row(shape, "radius", 1, None, f"{where}, <sphere>")
    elif shape.tag in ("capsule", "cylinder"):
        size = tuple(_number(shape, key, None, f"{where}, <{shape.tag}>") for key in ("radius", "length"))
    else:
        raise InvalidInputError(f"{where}: the shape <{shape.tag}> is none of sphere, capsule, box and cylinder")
    try:
        origin, rotation = _origin(element, where)
        return Geometry(shape.tag, size, origin, rotation, color)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None


def _joint(element: Element, path: str) -> UrdfJoint:
    name = _name(element, f"{path}: <joint>")
    where, kind = f"{path}: joint {name!r}", element.get("type")
    if kind not in (*_MOVING, _FIXED):
        raise InvalidInputError(
            f"{where} is of type {kind!r}; a hand's joints are revolute, continuous or fixed. Make it one of these"
        )
    if element.find("mimic") is not None:
        raise InvalidInputError(
            f"{where} mimics another joint, which is not simulated; remove <mimic> and drive it, or make it fixed"
        )
    ends = []
    for role in ("parent", "child"):
        end = element.find(role)
        if end is None or not end.get("link"):
            raise InvalidInputError(f'{where} names no {role}; write <{role} link="..."/>')
        ends.append(end.get("link", ""))
    origin, rotation = _origin(element, where)
    if kind == _FIXED:
        return UrdfJoint(name, ends[0], ends[1], True, origin, rotation, (1.0, 0.0, 0.0), -math.inf, math.inf, None)
    axis = np.array(_row(element.find("axis"), "xyz", 3, "1 0 0", f"{where}, <axis>"))
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise InvalidInputError(f"{where}: the axis {axis.tolist()} has no direction; write its three numbers")
    x, y, z = (axis if abs(length - 1.0) < 1e-12 else axis / length).tolist()
    limit = element.find("limit")
    lower, upper = -math.inf, math.inf
    if kind == "revolute":
        if limit is None:
            raise InvalidInputError(f"{where} has no <limit>; write lower, upper [rad] and effort [N m]")
        lower, upper = (_number(limit, key, "0", f"{where}, <limit>") for key in ("lower", "upper"))
        lower, upper = limits(lower, upper, f"{where}, <limit> [rad]")
    effort = None if limit is None or "effort" not in limit.attrib else _number(limit, "effort", None, where)
    return UrdfJoint(name, ends[0], ends[1], False, origin, rotation, (x, y, z), lower, upper, effort)
