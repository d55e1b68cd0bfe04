"""Write a hand as URDF text, with its hulls as mesh files, for PyBullet; the numbers are those of
the kinematics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from grasp_env.inputs.files import digest
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.tree import Geometry, Link, Palm, Vector3
from grasp_env.sim.mesh_files import obj_text
from grasp_env.sim.mesh_shape import hull_faces

# that Bullet adds around the hulls of a URDF [m]; changeDynamics cannot change it
HULL_MARGIN = 1e-3
_SPEED_LIMIT = "100"  # [rad/s]; Bullet's default, far above what a grasp needs


def hand_files(hand: HandDescription, margin: float = 0.0) -> dict[str, str]:
    """Return names and texts of all files of the hand: "hand.urdf", and each of its hulls once.

    Collision hulls are shrunk by `margin` [m], for an engine that adds it around them, but by no
    more than a third of the radius of their largest inner ball, so that thin hulls keep their
    shape.
    """
    files = {"hand.urdf": hand_urdf(hand)}
    for body in (hand.palm, *hand.links):
        for role, shapes, depth in (
            ("visual", body.visual, 0.0),
            ("collision", body.collision, margin),
        ):
            hulls = {shape.corners for shape in shapes if shape.kind == "hull"}
            files |= {_hull_name(role, corners): _hull_obj(corners, depth) for corners in hulls}
    return files


def write_hand(hand: HandDescription, folder: str, margin: float = 0.0) -> str:
    """Write the `hand_files` into a folder; return the path of the URDF."""
    for name, text in hand_files(hand, margin).items():
        Path(folder, name).write_text(text, encoding="utf-8")
    return str(Path(folder, "hand.urdf"))


def hand_urdf(hand: HandDescription) -> str:
    """Return the hand as a URDF document whose palm frame is the world frame.

    Joints keep their names; PyBullet may number them in another order, see `bullet.joint_indices`.
    Hulls are mesh files beside the URDF, see `hand_files`.
    """
    robot = Element("robot", name=hand.name)
    palm = SubElement(robot, "link", name=hand.palm.name)
    inertial = SubElement(palm, "inertial")
    SubElement(inertial, "mass", value="0")
    SubElement(inertial, "inertia", dict.fromkeys(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), "0"))
    _add_shapes(palm, hand.palm)
    for link in hand.links:
        _add_joint(robot, link)
        element = SubElement(robot, "link", name=link.name)
        _add_inertial(element, link)
        _add_shapes(element, link)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def digits(values: Iterable[float]) -> str:
    """Return numbers with all their digits, so that the engines and the kinematics agree."""
    return " ".join(repr(float(value)) for value in values)


def _add_origin(element: Element, origin: Vector3, rotation: Vector3 = (0.0, 0.0, 0.0)) -> None:
    SubElement(element, "origin", xyz=digits(origin), rpy=digits(rotation))


def _add_joint(robot: Element, link: Link) -> None:
    turning = math.isinf(link.lower)
    joint = SubElement(
        robot,
        "joint",
        name=link.joint,
        type="prismatic" if link.sliding else "continuous" if turning else "revolute",
    )
    SubElement(joint, "parent", link=link.parent)
    SubElement(joint, "child", link=link.name)
    _add_origin(joint, link.origin, link.rotation)
    SubElement(joint, "axis", xyz=digits(link.axis))
    limit = SubElement(joint, "limit", effort=repr(link.torque_limit), velocity=_SPEED_LIMIT)
    if link.mimic is not None:
        ratio = repr(link.mimic.ratio)
        offset = repr(link.mimic.offset)
        SubElement(joint, "mimic", joint=link.mimic.joint, multiplier=ratio, offset=offset)
    if not turning:
        limit.attrib |= {"lower": repr(link.lower), "upper": repr(link.upper)}


def _add_inertial(element: Element, link: Link) -> None:
    inertial = SubElement(element, "inertial")
    _add_origin(inertial, link.center)
    SubElement(inertial, "mass", value=repr(link.mass))
    names: tuple[str, ...] = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    SubElement(inertial, "inertia", dict(zip(names, map(repr, link.inertia), strict=True)))


def _add_shapes(element: Element, body: Link | Palm) -> None:
    for index, geometry in enumerate(body.visual):
        visual = _add_geometry(element, "visual", geometry)
        # PyBullet keeps one color for each name
        material = SubElement(visual, "material", name=f"{body.name}_{index}")
        SubElement(material, "color", rgba=digits((*(geometry.color or body.color), 1.0)))
    for geometry in body.collision:
        _add_geometry(element, "collision", geometry)


def _add_geometry(element: Element, role: str, geometry: Geometry) -> Element:
    part = SubElement(element, role)
    _add_origin(part, geometry.origin, geometry.rotation)
    shape = SubElement(part, "geometry")
    if geometry.kind == "box":
        SubElement(shape, "box", size=digits(geometry.size))
    elif geometry.kind == "hull":
        SubElement(shape, "mesh", filename=_hull_name(role, geometry.corners))
    elif geometry.kind == "mesh":
        SubElement(shape, "mesh", filename=geometry.file, scale=digits(geometry.size))
    else:
        names: tuple[str, ...] = ("radius", "length")[: len(geometry.size)]
        SubElement(shape, geometry.kind, dict(zip(names, map(repr, geometry.size), strict=True)))
    return part


def _hull_name(role: str, corners: tuple[Vector3, ...]) -> str:
    """Return the file name of a hull, unique for its role and corners."""
    return f"{role}_{digest(np.array(corners).tobytes())[:16]}.obj"


@lru_cache(maxsize=512)
def _hull_obj(corners: tuple[Vector3, ...], margin: float) -> str:
    """Return a hull as a Wavefront file, shrunk by a margin [m], with faces counterclockwise from
    outside.
    """
    from grasp_env.sim.hand.solids import shrunk

    return obj_text(
        [hull_faces(shrunk(np.array(corners), margin) if margin > 0.0 else np.array(corners))]
    )
