"""Looks of hands and objects as meshes, from their descriptions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh

from grasp_env._check import Array
from grasp_env.errors import GraspError
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.meshes import read_mesh
from grasp_env.sim.hand.tree import Geometry, Link, Palm
from grasp_env.sim.objects.description import ObjectDescription

_MOST_FACES = 20_000
"""Of one link: beyond it its collision shapes are drawn instead."""
Part = tuple[Array, np.ndarray, tuple[float, float, float]]
"""Corners (V, 3) [m], faces (F, 3), colour in [0, 1]."""


def looks(body: Link | Palm) -> list[Part]:
    """Meshes in the link's frame, one of each colour: its looks, or what of it touches where it has none that can be read."""
    for shapes in (body.visual, body.collision):
        try:
            parts = _parts(shapes, body.color)
        except (GraspError, OSError):
            continue
        if parts and sum(len(faces) for _, faces, _ in parts) <= _MOST_FACES:
            return parts
    return []


def item_mesh(item: ObjectDescription) -> trimesh.Trimesh:
    """An object, body frame."""
    if item.shape == "mesh":
        corners, faces = item.faces
        return trimesh.Trimesh(corners, faces, process=False)
    if item.shape == "cuboid":
        return trimesh.creation.box(item.size)
    if item.shape == "sphere":
        return trimesh.creation.icosphere(4, 0.5 * item.size[0])
    kind = "capsule" if item.shape == "capsule" else "cylinder"
    radius, length = 0.5 * item.size[0], item.size[1] - (item.size[0] if kind == "capsule" else 0.0)
    mesh = _solid(kind, (radius, length))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-0.5 * np.pi, (1.0, 0.0, 0.0)))
    return mesh


def _parts(shapes: Sequence[Geometry], color: tuple[float, float, float]) -> list[Part]:
    by_color: dict[tuple[float, float, float], list[trimesh.Trimesh]] = {}
    for shape in shapes:
        place = Frame.of(shape.origin, shape.rotation)
        mesh = _mesh(shape)
        mesh.vertices = mesh.vertices @ place.rotation.T + place.origin
        by_color.setdefault(color if shape.color is None else shape.color, []).append(mesh)
    joined: list[Any] = [(tint, trimesh.util.concatenate(meshes)) for tint, meshes in by_color.items()]
    return [(np.asarray(mesh.vertices), np.asarray(mesh.faces), tint) for tint, mesh in joined]


def _mesh(shape: Geometry) -> trimesh.Trimesh:
    """A geometry in its own frame."""
    if shape.kind == "hull":
        return trimesh.convex.convex_hull(np.array(shape.corners))
    if shape.kind == "mesh":
        corners, faces = read_mesh(shape.file)
        return trimesh.Trimesh(corners * np.array(shape.size), faces, process=False)
    return _solid(shape.kind, shape.size)


def _solid(kind: str, size: Sequence[float]) -> trimesh.Trimesh:
    """A box, sphere, cylinder or capsule, axis z, centred."""
    if kind == "box":
        return trimesh.creation.box(size)
    if kind == "sphere":
        return trimesh.creation.icosphere(3, size[0])
    if kind == "cylinder":
        return trimesh.creation.cylinder(size[0], size[1], sections=64)
    mesh = trimesh.creation.capsule(size[1], size[0], count=(32, 32))
    mesh.vertices -= mesh.bounds.mean(axis=0)
    return mesh
