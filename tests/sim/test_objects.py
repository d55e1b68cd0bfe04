"""Sizes, inertia, random objects and invalid descriptions."""

from __future__ import annotations

import json
import pickle
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.sim.objects.description import ObjectDescription


def test_inertia_of_the_capsule_by_slices() -> None:
    item = ObjectDescription("capsule", (0.06, 0.13), mass=0.3)
    y = (np.arange(100000) + 0.5) / 100000 * 0.13 - 0.065
    squared = np.where(np.abs(y) < 0.035, 0.03**2, 0.03**2 - (np.abs(y) - 0.035) ** 2)
    mass = 0.3 * squared / squared.sum()
    across = (mass * (0.25 * squared + y**2)).sum()
    np.testing.assert_allclose(item.moments, (across, (mass * 0.5 * squared).sum(), across), rtol=1e-8)
    ball = ObjectDescription("capsule", (0.08, 0.08))
    np.testing.assert_allclose(ball.moments, ObjectDescription("sphere", (0.08,)).moments)


SOLIDS = {
    "cuboid": ((0.1, 0.05, 0.07), trimesh.creation.box((0.1, 0.05, 0.07))),
    "sphere": ((0.1,), trimesh.creation.icosphere(4, 0.05)),
    "cylinder": ((0.1, 0.07), trimesh.creation.cylinder(0.05, 0.07, sections=400)),
}


@pytest.mark.parametrize("shape", SOLIDS)
def test_inertia_of_the_solid_and_copies(shape: str) -> None:
    size, solid = SOLIDS[shape]
    item = ObjectDescription(shape, size, mass=0.3)
    solid = solid.copy()
    if shape == "cylinder":  # trimesh's axis is z
        solid.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    solid.density = 0.3 / solid.volume
    np.testing.assert_allclose(item.inertia_matrix, solid.moment_inertia, rtol=5e-3, atol=1e-9)
    np.testing.assert_allclose(item.extent, solid.extents, rtol=1e-3)
    assert replace(item, inertia=(1e-4, 2e-4, 1e-4)).inertia_matrix[1, 1] == 2e-4
    assert item.surface.nearest(np.zeros(3))[2] < 0.0  # is no part of a copy
    stored = ObjectDescription(**json.loads(json.dumps(asdict(item))))
    for made in (replace(item), pickle.loads(pickle.dumps(item)), stored):
        assert (made, hash(made)) == (item, hash(item))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"shape": "torus"}, "'cuboid', 'cylinder', 'sphere', 'capsule', 'mesh'"),
        ({"shape": "mesh"}, "needs the path"),
        ({"mesh": "a.obj"}, "mesh=None"),
        ({"size": (0.1, 0.1)}, r"must have shape \(3,\)"),
        ({"size": (100.0, 100.0, 100.0)}, "in metres"),
        ({"shape": "sphere", "size": (1e-4,)}, "0.001 to 1"),
        ({"shape": "capsule", "size": (0.1, 0.05)}, "at least its diameter"),
        ({"mass": 0.0}, "> 0"),
        ({"friction": -0.1}, "> 0"),
        ({"inertia": (1e-4, 1e-4, 3e-4)}, "sum of the other two"),
    ],
)
def test_invalid_numbers(fields: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        ObjectDescription(**fields)


BALL = trimesh.creation.icosphere(2, 0.05)
FLAT = BALL.copy().apply_transform(np.diag([1.0, 1.0, 0.0, 1.0]))
UNREAD = "is not a mesh of kind|no triangles"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", trimesh.Trimesh(BALL.vertices, BALL.faces[::3], process=False), "not closed: .*grasp object mend"),
        ("a.obj", FLAT, "encloses no volume"),
        ("a.obj", BALL.copy().apply_scale(1000.0), "millimetres"),
        ("a.obj", trimesh.creation.box((0.06, 0.05, 5e-4)), "allowed are 0.001 to 1"),
        ("a.pkl", b"", "file of type"),
        ("a.glb", b"", UNREAD),
        ("a.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", f"do not exist|{UNREAD}"),
        ("none.obj", None, "No such file"),
    ],
)
def test_invalid_meshes(tmp_path: Path, name: str, content: trimesh.Trimesh | bytes | None, message: str) -> None:
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        content.export(path)
    with pytest.raises(InvalidInputError, match=message):
        ObjectDescription("mesh", mesh=str(path))


@pytest.mark.parametrize(
    ("path", "settings", "message"),
    [
        (None, {}, "path must be a path"),
        ("a.stl", {"scale": "big"}, "scale must"),
        ("a.stl", {"density": 1000.0, "mass": 0.1}, "not both"),
    ],
)
def test_invalid_arguments_of_from_mesh(path: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ObjectDescription.from_mesh(path, **settings)
