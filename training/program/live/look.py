"""Drawing of what both pages show: bodies as meshes, contacts with cones and forces, a screw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
import viser
from trimesh import creation

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.files.meshes import read_looks
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.hand.tree import Geometry, Link, Palm

Color = tuple[int, int, int]
COLORS: tuple[Color, ...] = (
    (196, 72, 56),
    (42, 108, 176),
    (214, 148, 36),
    (46, 140, 84),
    (124, 86, 172),
    (60, 150, 160),
    (186, 92, 132),
    (112, 122, 62),
)
"""Colours of contacts; beyond eight they repeat."""
LOAD = (150, 30, 140)
MOMENT = (206, 98, 190)
BODY = (148, 163, 184)
BAD = (214, 48, 49)
MAX_LINK_FACES = 20_000
"""Largest number of faces of a link's visual meshes; with more, the collision shapes are drawn."""
_CONE_HEIGHT, _CONE_SIDES = 0.3, 40


def add_body(scene: viser.SceneApi, mesh: trimesh.Trimesh, zoom: float) -> tuple[Any, Any]:
    """Add a transparent body with its sharp edges; return its frame, which moves, and its mesh."""
    bent = mesh.face_adjacency_angles > math.radians(30.0)
    edges = mesh.vertices[mesh.face_adjacency_edges[bent]] if bent.any() else np.zeros((1, 2, 3))
    frame = scene.add_frame("/object", show_axes=False)
    scene.add_line_segments(
        "/object/edges", zoom * edges, (90, 104, 124), thickness=1.6, thickness_units="screen"
    )
    options = {"color": BODY, "opacity": 0.4, "flat_shading": len(mesh.faces) < 500}
    body = scene.add_mesh_simple("/object/body", zoom * mesh.vertices, mesh.faces, **options)
    return frame, body


class Contacts:
    """Points, friction cones and force arrows of N contacts; they replace earlier ones.

    Args:
        scene: scene of the server.
        count: N.
        force_scale: drawn length of a newton.
    """

    def __init__(self, scene: viser.SceneApi, count: int, force_scale: float) -> None:
        scene.remove_by_name("/contacts")
        self._force_scale = force_scale
        self._colors = [COLORS[k % len(COLORS)] for k in range(count)]
        around = 1 + np.arange(_CONE_SIDES)
        mantle = np.column_stack([np.zeros_like(around), around, 1 + around % _CONE_SIDES])
        self.points = []
        self._cones = []
        blank = np.zeros((_CONE_SIDES + 1, 3))
        for k, color in enumerate(self._colors):
            self.points.append(scene.add_icosphere(f"/contacts/{k}", 0.05, color))
            cone = scene.add_mesh_simple(
                f"/contacts/{k}/cone", blank, mantle, color=color, opacity=0.35, side="double"
            )
            self._cones.append(cone)
        self._forces: Any = scene.add_arrows(
            "/contacts/forces", np.zeros((count, 2, 3)), np.array(self._colors)
        )

    def draw(
        self, positions: Array, frames: Array, forces: Array, friction: Array, bad: bool
    ) -> None:
        """Draw the contacts, in red if `bad`.

        Args:
            positions: (N, 3), scene units.
            frames: (N, 3, 3) contact frames; the columns are the inward normal, o and t.
            forces: (N, 3) forces on the object [N].
            friction: (N,) coefficients; 0: no cone.
            bad: True for red contacts.
        """
        angles = 2.0 * np.pi * np.arange(_CONE_SIDES) / _CONE_SIDES
        circle = np.column_stack([-np.ones(_CONE_SIDES), np.cos(angles), np.sin(angles)])
        for k, (point, cone) in enumerate(zip(self.points, self._cones, strict=True)):
            rim = circle * [1.0, friction[k], friction[k]] @ frames[k].T
            cone.vertices = _CONE_HEIGHT * np.vstack([np.zeros(3), rim])
            cone.visible = bool(friction[k] > 0.0)
            point.position = positions[k]
            point.color = BAD if bad else self._colors[k]
            cone.color = point.color
        self._forces.points = np.stack([positions - self._force_scale * forces, positions], axis=1)
        self._forces.visible = bool(forces.any())


def screw(twist: Array, centre: Array, extent: float) -> Array:
    """Return the screw of a twist as arrows (6, 2, 3): its axis and a ring, larger with rotation.

    Args:
        twist: (6,) velocity of the origin and angular velocity, of any scale.
        centre: (3,) point near which the axis is drawn [m].
        extent: length of a scene unit [m].
    """
    velocity = twist[:3] + np.cross(twist[3:], centre)
    turning = float(np.linalg.norm(twist[3:]))
    turns = turning * extent > 1e-6 * np.linalg.norm(velocity)
    axis = twist[3:] / turning if turns else velocity / np.linalg.norm(velocity)
    point = (centre + np.cross(twist[3:], velocity) / turning**2 if turns else centre) / extent
    sliding = float(axis @ velocity)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first *= 0.4 * turning * extent / (turning * extent + abs(sliding)) / np.linalg.norm(first)
    angles = np.linspace(0.0, 5.2, 6)[:, None]
    ring = point + np.cos(angles) * first + np.sin(angles) * np.cross(axis, first)
    line = point + math.copysign(0.85, sliding) * np.array([[-axis, axis]])
    return np.concatenate([line, np.stack([ring[:-1], ring[1:]], axis=1)])


def object_mesh(shape: str, size: Sequence[float]) -> trimesh.Trimesh:
    """Return a cuboid, sphere, cylinder or capsule of an `ObjectDescription`'s size [m]."""
    if shape == "cuboid":
        return creation.box(size)
    if shape == "sphere":
        return creation.icosphere(4, 0.5 * size[0])
    if shape == "cylinder":
        mesh = creation.cylinder(0.5 * size[0], size[1], sections=64)
    else:
        mesh = creation.capsule(size[1] - size[0], 0.5 * size[0])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh.apply_transform(
        trimesh.transformations.rotation_matrix(-0.5 * np.pi, (1.0, 0.0, 0.0))
    )


def link_meshes(bodies: Sequence[Link | Palm]) -> list[list[tuple[trimesh.Trimesh, Color]]]:
    """Return meshes [m] and colours of links, link frame: visual or else collision shapes."""
    looks = read_looks(
        shape.file for body in bodies for shape in body.visual if shape.kind == "mesh"
    )
    return [_meshes_of(body, looks) for body in bodies]


def _meshes_of(
    body: Link | Palm, looks: Mapping[str, tuple[Array, Any]]
) -> list[tuple[trimesh.Trimesh, Color]]:
    for shapes in (body.visual, body.collision):
        meshes = [(_mesh(shape, looks), shape.color or body.color) for shape in shapes]
        if 0 < sum(len(mesh.faces) for mesh, _ in meshes) <= MAX_LINK_FACES:
            return [
                (mesh, (int(255 * red), int(255 * green), int(255 * blue)))
                for mesh, (red, green, blue) in meshes
            ]
    return []


def _mesh(shape: Geometry, looks: Mapping[str, tuple[Array, Any]]) -> trimesh.Trimesh:
    if shape.kind != "mesh":
        return trimesh.convex.convex_hull(outline(shape))
    corners, faces = looks[shape.file]
    frame = Frame.of(shape.origin, shape.rotation)
    return trimesh.Trimesh(
        corners * np.array(shape.size) @ frame.rotation.T + frame.origin, faces, process=False
    )
