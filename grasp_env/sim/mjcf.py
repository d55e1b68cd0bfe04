"""MJCF of a hand and an object, with numbers as names of links, joints and shapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from grasp_env.sim.engine import MujocoEngine
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.limbs import touching_pairs
from grasp_env.sim.hand.tree import Geometry, Link, Palm
from grasp_env.sim.hand.urdf import digits
from grasp_env.sim.objects.description import OBJECT_COLOR, ObjectDescription

PALM, OBJECT = "palm", "object"  # names of bodies
OBJECT_GROUP = 1  # geometry group of the object's visual shape; the hand's is 0
_Z_TO_Y = "-1.5707963267948966 0 0"  # capsules and cylinders of MuJoCo lie along z


def link_name(link: int) -> str:
    """Return the name of a link's body and of its joint."""
    return f"link{link}"


def scene_mjcf(
    hand: HandDescription,
    item: ObjectDescription,
    gravity: Iterable[float],
    timestep: float,
    engine: MujocoEngine,
) -> str:
    """Return the MJCF of the fixed hand and the free object at the origin.

    Joints have no damping, armature or motors: torques are applied directly. The object's friction
    coefficients have priority, and are the products with the tips' friction that Bullet forms.
    Gravity is in [m/s^2], the time step in [s].
    """
    spring = f"{engine.time_constant or 2.0 * timestep!r} {engine.damping_ratio!r}"
    soft = f'solref="{spring}" solimp="{digits(engine.impedance)}"'
    sliding = item.friction * hand.tip_friction
    turning = item.torsional_friction * hand.tip_friction
    meshes: list[str] = []

    def collision(body: Link | Palm) -> str:
        return "".join(_shape(shape, meshes) for shape in body.collision if shape.kind != "mesh")

    tree = _tree(hand, collision)
    if item.shape == "mesh":
        shapes = [f'type="mesh" {_mesh(piece, meshes)} euler="0 0 0"' for piece in item.pieces]
    else:
        shapes = [_object_look(item, meshes)]
    friction = f'priority="1" friction="{sliding!r} {turning!r} 0"'
    geoms = "".join(f"<geom {shape} {friction}/>" for shape in shapes)
    return f"""<mujoco><compiler angle="radian" eulerseq="XYZ" inertiafromgeom="false" autolimits="false"/>
<option timestep="{timestep!r}" gravity="{digits(gravity)}" cone="{engine.cone}" impratio="{engine.impratio!r}"
 integrator="{engine.integrator}" solver="Newton" iterations="{engine.solver_iterations}" tolerance="{engine.tolerance!r}"
 noslip_iterations="{engine.noslip_iterations}"><flag autoreset="disable"/></option>
<default><geom condim="{4 if turning else 3}" friction="{hand.tip_friction**2!r} 0 0" {soft}/>
<joint damping="0" armature="0" frictionloss="0" solreflimit="{spring}" solreffriction="{spring}" solimpfriction="{digits(engine.impedance)}"/><equality {soft}/></default>
<asset>{"".join(meshes)}</asset>
<worldbody>{tree}{_free_body(item, geoms)}</worldbody>
<contact>{"".join(_excludes(hand))}</contact>
<equality>{"".join(_couplings(hand))}</equality></mujoco>"""


def looks_mjcf(
    hand: HandDescription, item: ObjectDescription | None = None
) -> tuple[str, dict[str, Geometry]]:
    """Return the MJCF for pictures: the bodies of `scene_mjcf` with visual shapes and a light.

    Also return the visual shapes of kind "mesh", by the names of the meshes that the MJCF uses but
    does not define.
    """
    meshes: list[str] = []
    files: dict[str, Geometry] = {}

    def looks(body: Link | Palm) -> str:
        return "".join(
            _shape(shape, meshes, f'rgba="{digits((*(shape.color or body.color), 1.0))}"', files)
            for shape in body.visual
        )

    tree = _tree(hand, looks)
    if item is not None:
        color = f'rgba="{digits((*OBJECT_COLOR, 1.0))}" group="{OBJECT_GROUP}"'
        tree += _free_body(item, f"<geom {_object_look(item, meshes)} {color}/>")
    text = f"""<mujoco><compiler angle="radian" eulerseq="XYZ" inertiafromgeom="false" autolimits="false"/>
<statistic extent="1" center="0 0 0"/>
<visual><headlight ambient="0.62 0.62 0.62" diffuse="0 0 0" specular="0 0 0"/><quality shadowsize="4096" offsamples="0"/></visual>
<default><geom contype="0" conaffinity="0"/></default>
<asset>{"".join(meshes)}</asset>
<worldbody><light directional="true" pos="0.5 1 0.6" dir="-0.5 -1 -0.6" diffuse="0.42 0.42 0.42" specular="0.08 0.08 0.08"/>
{tree}</worldbody></mujoco>"""
    return text, files


def _tree(hand: HandDescription, shapes: Callable[[Link | Palm], str]) -> str:
    """Return the bodies of palm and links, with the elements that `shapes` makes."""
    children: dict[str, list[int]] = {}
    for index, link in enumerate(hand.links):
        children.setdefault(link.parent, []).append(index)

    def body(index: int) -> str:
        link = hand.links[index]
        ixx, ixy, ixz, iyy, iyz, izz = link.inertia
        limits = 'limited="false"'
        if math.isfinite(link.lower):
            limits = f'limited="true" range="{digits((link.lower, link.upper))}"'
        kind = "slide" if link.sliding else "hinge"
        return (
            f'<body name="{link_name(index)}" pos="{digits(link.origin)}" euler="{digits(link.rotation)}">'
            f'<inertial pos="{digits(link.center)}" mass="{link.mass!r}" fullinertia="{digits((ixx, iyy, izz, ixy, ixz, iyz))}"/>'
            f'<joint name="{link_name(index)}" type="{kind}" axis="{digits(link.axis)}" {limits}/>'
            f"{shapes(link)}{bodies(link.name)}</body>"
        )

    def bodies(parent: str) -> str:
        return "".join(body(index) for index in children.get(parent, ()))

    return f'<body name="{PALM}">{shapes(hand.palm)}{bodies(hand.palm.name)}</body>'


def _free_body(item: ObjectDescription, shape: str) -> str:
    inertial = f'<inertial pos="0 0 0" mass="{item.mass!r}" diaginertia="{digits(item.moments)}"/>'
    return f'<body name="{OBJECT}"><freejoint/>{inertial}{shape}</body>'


def _shape(
    shape: Geometry, meshes: list[str], look: str = "", files: dict[str, Geometry] | None = None
) -> str:
    """Return the element of a shape with attributes `look`; add those of kind "mesh" to `files`."""
    kind, size = shape.kind, shape.size
    if kind == "mesh" and files is not None:
        name = f"file{len(files)}"
        files[name] = shape
        form = f'mesh="{name}"'
    elif kind == "hull":
        kind = "mesh"
        form = _mesh(shape.corners, meshes)
    elif kind == "box":
        form = f'size="{digits(0.5 * side for side in size)}"'
    else:  # MuJoCo takes half the length of a cylinder
        form = f'size="{digits((size[0], *(0.5 * length for length in size[1:])))}"'
    return f'<geom type="{kind}" {form} pos="{digits(shape.origin)}" euler="{digits(shape.rotation)}" {look}/>'


def _object_look(item: ObjectDescription, meshes: list[str]) -> str:
    """Return type, size and orientation of the object's visual shape."""
    if item.shape == "mesh":
        corners, faces = item.faces
        return f'type="mesh" {_mesh(corners, meshes, faces)} euler="0 0 0"'
    half = [0.5 * side for side in item.size]
    if item.shape == "cuboid":
        return f'type="box" size="{digits(half)}" euler="0 0 0"'
    if item.shape == "capsule":
        half[1] -= half[0]
    return f'type="{item.shape}" size="{digits(half)}" euler="{_Z_TO_Y}"'


def _mesh(corners: Any, meshes: list[str], faces: Any = None) -> str:
    """Add a mesh, or the hull of its corners, to `meshes`; return the attribute that refers to it."""
    name = f"mesh{len(meshes)}"
    extra = ""
    if faces is not None:
        extra = f' face="{" ".join(map(str, np.ravel(faces).tolist()))}" inertia="shell"'
    meshes.append(f'<mesh name="{name}" vertex="{digits(np.ravel(corners))}"{extra}/>')
    return f'mesh="{name}"'


def _couplings(hand: HandDescription) -> Iterable[str]:
    for index, (link, driver) in enumerate(zip(hand.links, hand.drivers, strict=True)):
        if link.mimic is not None:
            joints = f'joint1="{link_name(index)}" joint2="{link_name(driver)}"'
            yield f'<joint {joints} polycoef="{link.mimic.offset!r} {link.mimic.ratio!r} 0 0 0"/>'


def _excludes(hand: HandDescription) -> Iterable[str]:
    """Yield pairs that do not collide: links and parents, and links that always overlap."""
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    parents = {(numbers.get(link.parent, -1), index) for index, link in enumerate(hand.links)}
    for pair in sorted(parents | set(touching_pairs(hand))):
        first, second = (PALM if index < 0 else link_name(index) for index in pair)
        yield f'<exclude body1="{first}" body2="{second}"/>'
