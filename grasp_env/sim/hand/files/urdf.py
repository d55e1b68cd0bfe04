"""Read a URDF file; all faults are reported together."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults
from grasp_env.sim.hand.check import Vector3, limits, numbers
from grasp_env.sim.hand.files.elements import NO_INERTIA, FileJoint, FileLink, listed
from grasp_env.sim.hand.files.meshes import PARENTS, find_mesh, unit_of, why_not_drawn
from grasp_env.sim.hand.files.pieces import MeshUse, solids_of
from grasp_env.sim.hand.frames import IDENTITY, Frame
from grasp_env.sim.hand.inertia import Inertia
from grasp_env.sim.hand.tree import UNITS, Geometry, Mimic

MAX_ELEMENTS = 500  # links, and joints, in a file
MAX_SHAPES = 2000  # collision and visual shapes together

# attributes of a shape, with the number of their values
_SIZES = {
    "sphere": {"radius": 1},
    "capsule": {"radius": 1, "length": 1},
    "cylinder": {"radius": 1, "length": 1},
    "box": {"size": 3},
}

_SLIDING, _FIXED = "prismatic", "fixed"


class UrdfReader:
    """A reader of one URDF file, or expanded xacro file, with the first element `robot`.

    Attributes:
        name: Name of the robot.
        names: Names of its links.
        ends: Name, parent and child of its joints; other faults of the joints are raised by
            `elements`.
        origins: Place of each joint in its parent [m], (3,); zero for one with faults.
        mimics: The driver that each coupled joint names.
        fixed: Names of fixed joints.
        undrawn: Visual meshes that are left out, with the reason.
        notes: A sentence for each thing that was assumed or left out.
    """

    def __init__(self, path: str | os.PathLike[str], robot: Element) -> None:
        self.path = Path(os.fsdecode(path))
        self.notes: list[str] = []
        self.name: str = robot.get("name") or "hand"
        self._links, self._joints = robot.findall("link"), robot.findall("joint")
        if not self._links:
            raise InvalidInputError("there is no <link>; a hand has a palm and moving links")
        if max(len(self._links), len(self._joints)) > MAX_ELEMENTS:
            raise InvalidInputError(
                f"there are {len(self._links)} links and {len(self._joints)} joints, allowed are up to {MAX_ELEMENTS}; take the hand out"
            )
        shapes = sum(
            len(link.findall(role)) for link in self._links for role in ("collision", "visual")
        )
        if shapes > MAX_SHAPES:
            raise InvalidInputError(
                f"there are {shapes} shapes, allowed are up to {MAX_SHAPES}; take the hand out"
            )
        self._materials = list(robot.iter("material"))
        self._palette: dict[str, Vector3] = {}
        self._missing: dict[str, list[str]] = {}
        self._shapes: dict[str, tuple[list[Geometry | MeshUse], list[Geometry | MeshUse]]] = {}
        self.names = [element.get("name", "") for element in self._links]
        self.ends = [
            (element.get("name", ""), _end(element, "parent"), _end(element, "child"))
            for element in self._joints
        ]
        self.origins = {element.get("name", ""): _place(element) for element in self._joints}
        self.mimics = {
            element.get("name", ""): mimic.get("joint", "")
            for element in self._joints
            if (mimic := element.find("mimic")) is not None and element.get("type") != _FIXED
        }
        self.fixed = {
            element.get("name", "") for element in self._joints if element.get("type") == _FIXED
        }
        self.undrawn: dict[str, str] = {}

    def elements(self, names: Collection[str]) -> tuple[dict[str, FileLink], list[FileJoint]]:
        """Return some links by name, and the joints between them in file order.

        An error lists all their faults. Mesh files are looked for here, and read by `with_shapes`.
        """
        self._palette = {
            material.get("name", ""): color
            for material in self._materials
            if (color := _color(material, f"material {material.get('name', '')!r}")) is not None
        }
        with AllFaults() as check:
            links = [
                check(self._link, element)
                for element in self._links
                if element.get("name", "") in names
            ]
            joints = [
                check(_joint, element)
                for element, (_, parent, child) in zip(self._joints, self.ends, strict=True)
                if not {parent, child} - {"", *names}
            ]
            joint_names = [joint for joint, *_ in self.ends]
            for kind, all_names in (("links", self.names), ("joints", joint_names)):
                for name, count in Counter(all_names).items():
                    if count > 1:
                        check.add(f"two {kind} are called {shown(name)}; give each its own name")
            check(self._check_meshes)
        return {link.name: link for link in links}, joints

    def _link(self, element: Element) -> FileLink:
        name = _name(element, "<link>")
        where = f"link {name!r}"
        looks = [
            (shape, self._color_of_visual(shape, f"{where}, <visual>"))
            for shape in element.findall("visual")
        ]
        link_color = next((color for _, color in looks if color), None)
        with AllFaults() as check:
            inertial = check(_inertial, element.find("inertial"), where)
            collision = [check(self._placed, shape, name) for shape in element.findall("collision")]
            visual = [
                check(self._placed, shape, name, None if color == link_color else color)
                for shape, color in looks
            ]
        self._shapes[name] = list(filter(None, collision)), list(filter(None, visual))
        return FileLink(name, *inertial, color=link_color)

    def _color_of_visual(self, element: Element, where: str) -> Vector3 | None:
        material = element.find("material")
        if material is None:
            return None
        return _color(material, where) or self._palette.get(material.get("name", ""))

    def _check_meshes(self) -> None:
        if self._missing:
            meshes = [
                f"{shown(name)} ({', '.join(dict.fromkeys(links))})"
                for name, links in self._missing.items()
            ]
            raise InvalidInputError(
                f"these meshes (of links) are neither beside the URDF nor in the {PARENTS} folders above it: {listed(meshes, 40)}. "
                "Download the whole package and keep its folder structure"
            )

    def with_shapes(self, links: dict[str, FileLink]) -> dict[str, FileLink]:
        """Return the links with their shapes: convex pieces of collision meshes, visual meshes."""
        solids = solids_of({name: self._shapes[name][0] for name in links}, self.path.name)
        shaped = dict[str, FileLink]()
        for name, link in links.items():
            visual = [
                look if isinstance(look, Geometry) else self._visual_mesh(look)
                for look in self._shapes[name][1]
            ]
            shaped[name] = replace(
                link, collision=tuple(solids[name]), visual=tuple(filter(None, visual))
            )
        return shaped

    def _placed(
        self, element: Element, link: str, color: Vector3 | None = None
    ) -> Geometry | MeshUse | None:
        """Return the shape of a <collision> or <visual>; None for a missing mesh, recorded."""
        where = f"link {link!r}, <{element.tag}>"
        shape = _shape(element, where)
        if shape.tag != "mesh":
            return _primitive(element, shape, where, color)
        origin, rotation = _origin(element, where)
        name, scale = _mesh(shape, where)
        path, unit = None, 1.0
        try:
            path = find_mesh(name, self.path)
            unit = 1.0 if path is None else unit_of(path)
        except InvalidInputError as error:
            if element.tag == "collision":
                raise InvalidInputError(f"{where}: {error}") from None
            self.undrawn[name] = "are missing" if path is None else "have an invalid unit"
            return None
        if path is not None:
            x, y, z = (unit * factor for factor in scale)
            return MeshUse(name, path, (x, y, z), origin, rotation, color)
        if element.tag == "collision":
            self._missing.setdefault(name, []).append(link)
        else:
            self.undrawn[name] = "are missing"
        return None

    def _visual_mesh(self, use: MeshUse) -> Geometry | None:
        """Return a visual mesh; None if it cannot be drawn, which is recorded."""
        if why := why_not_drawn(use.path, use.scale):
            self.undrawn[use.name] = why
            return None
        return Geometry("mesh", use.scale, use.origin, use.rotation, use.color, file=str(use.path))


def _name(element: Element, where: str) -> str:
    name = element.get("name", "")
    if not name.strip():
        raise InvalidInputError(f"{where} has no name; write name=...")
    return name


def _end(element: Element, role: str) -> str:
    """Return the link that a joint names as its "parent" or "child", or ""."""
    end = element.find(role)
    return "" if end is None else end.get("link", "")


def _row(
    element: Element | None, key: str, count: int, default: str | None, where: str
) -> tuple[float, ...]:
    """Return an attribute of `count` numbers; `default` replaces a missing element or attribute."""
    text = default if element is None else element.get(key, default)
    if text is None:
        raise InvalidInputError(f"{where} lacks {key}=")
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        raise InvalidInputError(
            f"{where}: {key}={shown(text.split())} must be {count} numbers"
        ) from None
    return numbers(values, count, f"{where}: {key}")


def _number(element: Element | None, key: str, default: str | None, where: str) -> float:
    return _row(element, key, 1, default, where)[0]


def _origin(element: Element, where: str) -> tuple[Vector3, Vector3]:
    """Return position [m] and roll, pitch, yaw [rad] of an <origin>, zero without one."""
    origin = element.find("origin")
    x, y, z = _row(origin, "xyz", 3, "0 0 0", f"{where}, <origin>")
    roll, pitch, yaw = _row(origin, "rpy", 3, "0 0 0", f"{where}, <origin>")
    return (x, y, z), (roll, pitch, yaw)


def _place(joint: Element) -> Vector3:
    """Return the position of a joint [m], zero if it is not three numbers."""
    with suppress(InvalidInputError):
        return _origin(joint, "")[0]
    return 0.0, 0.0, 0.0


def _color(material: Element, where: str) -> Vector3 | None:
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, _ = _row(color, "rgba", 4, None, f"{where}, <color>")
    return red, green, blue


def _inertial(inertial: Element | None, where: str) -> tuple[float, Frame, Inertia]:
    """Return mass, frame and inertia of an <inertial>; they may be physically impossible."""
    if inertial is None:
        return 0.0, IDENTITY, NO_INERTIA
    mass = _number(inertial.find("mass"), "value", None, f"{where}, <inertial>, <mass>")
    if mass < 0.0:
        raise InvalidInputError(f"{where}: mass={mass} kg must be above 0")
    frame = Frame.of(*_origin(inertial, f"{where}, <inertial>"))
    if mass == 0.0:
        return 0.0, frame, NO_INERTIA
    element = inertial.find("inertia")
    defaults = {"ixx": None, "ixy": "0", "ixz": "0", "iyy": None, "iyz": "0", "izz": None}
    xx, xy, xz, yy, yz, zz = (
        _number(element, name, default, f"{where}, <inertial>, <inertia>")
        for name, default in defaults.items()
    )
    return mass, frame, (xx, xy, xz, yy, yz, zz)


def _shape(element: Element, where: str) -> Element:
    """Return the element inside the <geometry> of a <visual> or <collision>."""
    geometry = element.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None:
        raise InvalidInputError(
            f"{where} has no shape in its <geometry>; write a sphere, capsule, box, cylinder or mesh"
        )
    return shape


def _mesh(shape: Element, where: str) -> tuple[str, Vector3]:
    name = shape.get("filename", "").strip()
    if not name:
        raise InvalidInputError(f"{where}, <mesh> lacks filename=")
    x, y, z = _row(shape, "scale", 3, "1 1 1", f"{where}, <mesh>")
    if 0.0 in (x, y, z):
        raise InvalidInputError(f"{where}, <mesh>: scale={(x, y, z)} must not be 0")
    return name, (x, y, z)


def _primitive(element: Element, shape: Element, where: str, color: Vector3 | None) -> Geometry:
    if shape.tag not in _SIZES:
        raise InvalidInputError(
            f"{where}: the shape <{shape.tag[:40]}> is not one of sphere, capsule, box, cylinder and mesh"
        )
    inside = f"{where}, <{shape.tag}>"
    size = [
        value
        for key, count in _SIZES[shape.tag].items()
        for value in _row(shape, key, count, None, inside)
    ]
    try:
        origin, rotation = _origin(element, where)
        return Geometry(shape.tag, tuple(size), origin, rotation, color)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None


def _joint(element: Element) -> FileJoint:
    name = _name(element, "<joint>")
    where = f"joint {name!r}"
    kind = element.get("type")
    if kind not in ("revolute", "continuous", _SLIDING, _FIXED):
        raise InvalidInputError(
            f"{where} is of type {shown(kind)}; a hand's joints are revolute, continuous, prismatic or fixed. Make it one of these"
        )
    parent = _end(element, "parent")
    child = _end(element, "child")
    for role, end in (("parent", parent), ("child", child)):
        if not end:
            raise InvalidInputError(f'{where} names no {role}; write <{role} link="..."/>')
    origin, rotation = _origin(element, where)
    if kind == _FIXED:
        return FileJoint(name, parent, child, True, origin, rotation)
    with AllFaults() as check:
        axis = check(_axis, element, where)
        limits = check(_limits, element.find("limit"), kind, where)
        effort = check(_effort, element.find("limit"), where)
        coupling = check(_mimic, element.find("mimic"), where)
    mimic = None
    if coupling is not None:
        driver, ratio, offset = coupling
        if ratio == 0.0:  # `arrange` makes it a fixed joint
            limits = offset, offset
        else:
            mimic = Mimic(driver, ratio, offset)
    return FileJoint(
        name, parent, child, False, origin, rotation, axis, *limits, effort, kind == _SLIDING, mimic
    )


def _axis(element: Element, where: str) -> Vector3:
    axis = np.array(_row(element.find("axis"), "xyz", 3, "1 0 0", f"{where}, <axis>"))
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise InvalidInputError(
            f"{where}: the axis {axis.tolist()} has no direction; write its three numbers"
        )
    x, y, z = (axis if abs(length - 1.0) < 1e-12 else axis / length).tolist()
    return x, y, z


def _limits(limit: Element | None, kind: str, where: str) -> tuple[float, float]:
    if kind == "continuous":
        return -math.inf, math.inf
    length, force = UNITS[kind == _SLIDING]
    if limit is None:
        raise InvalidInputError(
            f"{where} has no <limit>; write lower, upper [{length}] and effort [{force}]"
        )
    lower, upper = (_number(limit, key, "0", f"{where}, <limit>") for key in ("lower", "upper"))
    if lower == upper:
        return lower, upper  # `arrange` makes it a fixed joint
    return limits(lower, upper, f"{where}, <limit> [{length}]")


def _effort(limit: Element | None, where: str) -> float | None:
    if limit is None or "effort" not in limit.attrib:
        return None
    return _number(limit, "effort", None, where)


def _mimic(mimic: Element | None, where: str) -> tuple[str, float, float] | None:
    """Return the driver of a coupled joint, the ratio and the offset."""
    if mimic is None:
        return None
    inside = f"{where}, <mimic>"
    driver = mimic.get("joint", "")
    if not driver.strip():
        raise InvalidInputError(f"{inside} lacks joint=")
    ratio = _number(mimic, "multiplier", "1", inside)
    return driver, ratio, _number(mimic, "offset", "0", inside)
