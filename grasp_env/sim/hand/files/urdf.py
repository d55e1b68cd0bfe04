"""Read a URDF file; all faults are reported together."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from xml.etree.ElementTree import Element

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults
from grasp_env.sim.hand.check import Vector3, limits
from grasp_env.sim.hand.files.elements import NO_INERTIA, FileJoint, FileLink
from grasp_env.sim.hand.files.loops import cut_loops
from grasp_env.sim.hand.files.urdf_shapes import UrdfShapes
from grasp_env.sim.hand.files.urdf_values import number, placement, row
from grasp_env.sim.hand.frames import IDENTITY, Frame
from grasp_env.sim.hand.inertia import Inertia
from grasp_env.sim.hand.tree import UNITS, Mimic

MAX_ELEMENTS = 500  # links, and joints, in a file
MAX_SHAPES = 2000  # collision and visual shapes together

_SLIDING, _FIXED = "prismatic", "fixed"


class UrdfReader:
    """A reader of one URDF file, or expanded xacro file, with the first element `robot`.

    Loops are cut, see `cut_loops`, where the caller may name the palm and the fingertips.

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

    def __init__(
        self,
        path: str | os.PathLike[str],
        robot: Element,
        palm: str | None = None,
        tips: Collection[str] = (),
    ) -> None:
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
        self._shapes = UrdfShapes(path, robot)
        self.undrawn, self.notes = self._shapes.undrawn, self._shapes.notes
        self._read_tree()
        cut = cut_loops(self.names, self.ends, self.fixed, self.mimics, palm, tips)
        if cut.joints:
            self._links = [link for link in self._links if link.get("name") not in cut.links]
            self._joints = [joint for joint in self._joints if joint.get("name") not in cut.joints]
            self.notes += cut.notes
            self._read_tree()

    def _read_tree(self) -> None:
        """Set the attributes that say how the links hang together."""
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

    def elements(self, names: Collection[str]) -> tuple[dict[str, FileLink], list[FileJoint]]:
        """Return some links by name, and the joints between them in file order.

        An error lists all their faults. Mesh files are looked for here, and read by `with_shapes`.
        """
        self._shapes.read_palette()
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
            check(self._shapes.check_meshes)
        return {link.name: link for link in links}, joints

    def _link(self, element: Element) -> FileLink:
        name = _name(element, "<link>")
        where = f"link {name!r}"
        with AllFaults() as check:
            inertial = check(_inertial, element.find("inertial"), where)
            link_color = check(self._shapes.add, element, name)
        return FileLink(name, *inertial, color=link_color)

    def with_shapes(self, links: dict[str, FileLink]) -> dict[str, FileLink]:
        """Return the links with their shapes: convex pieces of collision meshes, visual meshes."""
        return self._shapes.with_shapes(links)


def _name(element: Element, where: str) -> str:
    name = element.get("name", "")
    if not name.strip():
        raise InvalidInputError(f"{where} has no name; write name=...")
    return name


def _end(element: Element, role: str) -> str:
    """Return the link that a joint names as its "parent" or "child", or ""."""
    end = element.find(role)
    return "" if end is None else end.get("link", "")


def _place(joint: Element) -> Vector3:
    """Return the position of a joint [m], zero if it is not three numbers."""
    with suppress(InvalidInputError):
        return placement(joint, "")[0]
    return 0.0, 0.0, 0.0


def _inertial(inertial: Element | None, where: str) -> tuple[float, Frame, Inertia]:
    """Return mass, frame and inertia of an <inertial>; they may be physically impossible."""
    if inertial is None:
        return 0.0, IDENTITY, NO_INERTIA
    mass = number(inertial.find("mass"), "value", None, f"{where}, <inertial>, <mass>")
    if mass < 0.0:
        raise InvalidInputError(f"{where}: mass={mass} kg must be above 0")
    frame = Frame.of(*placement(inertial, f"{where}, <inertial>"))
    if mass == 0.0:
        return 0.0, frame, NO_INERTIA
    element = inertial.find("inertia")
    defaults = {"ixx": None, "ixy": "0", "ixz": "0", "iyy": None, "iyz": "0", "izz": None}
    xx, xy, xz, yy, yz, zz = (
        number(element, name, default, f"{where}, <inertial>, <inertia>")
        for name, default in defaults.items()
    )
    return mass, frame, (xx, xy, xz, yy, yz, zz)


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
    origin, rotation = placement(element, where)
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
    axis = np.array(row(element.find("axis"), "xyz", 3, "1 0 0", f"{where}, <axis>"))
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
    lower, upper = (number(limit, key, "0", f"{where}, <limit>") for key in ("lower", "upper"))
    if lower == upper:
        return lower, upper  # `arrange` makes it a fixed joint
    return limits(lower, upper, f"{where}, <limit> [{length}]")


def _effort(limit: Element | None, where: str) -> float | None:
    if limit is None or "effort" not in limit.attrib:
        return None
    return number(limit, "effort", None, where)


def _mimic(mimic: Element | None, where: str) -> tuple[str, float, float] | None:
    """Return the driver of a coupled joint, the ratio and the offset."""
    if mimic is None:
        return None
    inside = f"{where}, <mimic>"
    driver = mimic.get("joint", "")
    if not driver.strip():
        raise InvalidInputError(f"{inside} lacks joint=")
    ratio = number(mimic, "multiplier", "1", inside)
    return driver, ratio, number(mimic, "offset", "0", inside)
