"""Sizes, inertia, meshes, random objects, and what is refused."""

from __future__ import annotations

import json
import pickle
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from episodes import random_object

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH, ObjectDescription
from grasp_env.sim.objects.mesh import principal_rotation


def export(folder: Path, mesh: trimesh.Trimesh, name: str = "object.obj") -> str:
    path = str(folder / name)
    mesh.export(path)
    return path


def test_inertia_of_the_capsule_by_slices() -> None:
    item = ObjectDescription("capsule", (0.06, 0.13), mass=0.3)
    y = (np.arange(100000) + 0.5) / 100000 * 0.13 - 0.065
    squared = np.where(np.abs(y) < 0.035, 0.03**2, 0.03**2 - (np.abs(y) - 0.035) ** 2)
    mass = 0.3 * squared / squared.sum()
    across = (mass * (0.25 * squared + y**2)).sum()
    np.testing.assert_allclose(item.moments, (across, (mass * 0.5 * squared).sum(), across), rtol=1e-8)


SOLIDS = {
    "cuboid": ((0.1, 0.05, 0.07), trimesh.creation.box((0.1, 0.05, 0.07))),
    "sphere": ((0.1,), trimesh.creation.icosphere(5, 0.05)),
    "cylinder": ((0.1, 0.07), trimesh.creation.cylinder(0.05, 0.07, sections=400)),
}


@pytest.mark.parametrize("shape", SOLIDS)
def test_inertia_of_the_solid(shape: str) -> None:
    size, solid = SOLIDS[shape]
    item = ObjectDescription(shape, size, mass=0.3)
    solid = solid.copy()
    if shape == "cylinder":  # trimesh's axis is z
        solid.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    solid.density = 0.3 / solid.volume
    np.testing.assert_allclose(item.inertia_matrix, solid.moment_inertia, rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(item.extent, solid.extents, rtol=1e-3)
    given = replace(item, inertia=(1e-4, 2e-4, 1e-4))
    assert given.inertia_matrix[1, 1] == 2e-4
    assert item.surface.nearest(np.zeros(3))[2] < 0.0  # is no part of a copy
    for made in (
        replace(item),
        pickle.loads(pickle.dumps(item)),
        ObjectDescription(**json.loads(json.dumps(asdict(item)))),
    ):
        assert (made, hash(made)) == (item, hash(item))


@pytest.mark.parametrize("name", ["egg.obj", "egg.stl", "egg.ply", "egg.off"])
def test_mesh_is_centred_and_measured(tmp_path: Path, name: str) -> None:
    egg = trimesh.creation.icosphere(2, 50.0)
    egg.apply_transform(np.diag([1.0, 1.4, 0.8, 1.0]))
    egg.apply_translation((30.0, -20.0, 5.0))
    item = ObjectDescription("mesh", (0.001,), mass=0.3, mesh=export(tmp_path, egg, name))
    np.testing.assert_allclose(item.extent, (0.1, 0.14, 0.08), rtol=1e-5)
    egg.apply_transform(np.diag([0.001, 0.001, 0.001, 1.0]))
    egg.density = 0.3 / egg.volume
    np.testing.assert_allclose(item.inertia_matrix, egg.moment_inertia, rtol=1e-4, atol=1e-8)
    vertices, faces = item.faces
    made = trimesh.Trimesh(vertices, faces)
    assert made.is_watertight
    assert made.volume == pytest.approx(egg.volume, rel=1e-5)
    np.testing.assert_allclose(made.center_mass, 0.0, atol=1e-9)


def test_a_changed_file_is_read_again_and_its_winding_mended(tmp_path: Path) -> None:
    path = export(tmp_path, trimesh.creation.box((0.06, 0.12, 0.09)))
    assert ObjectDescription("mesh", mesh=path).extent[1] == pytest.approx(0.12)
    box = trimesh.creation.box((0.06, 0.13, 0.0901))
    faces = box.faces.copy()
    faces[::3] = faces[::3, ::-1]
    export(tmp_path, trimesh.Trimesh(box.vertices, faces, process=False))
    item = ObjectDescription("mesh", mesh=path)
    assert item.extent[1] == pytest.approx(0.13)
    assert trimesh.Trimesh(*item.faces).volume == pytest.approx(0.06 * 0.13 * 0.0901, rel=1e-6)


def test_crooked_mesh_is_turned_to_its_principal_axes(tmp_path: Path) -> None:
    turn = trimesh.transformations.rotation_matrix(0.3, (1.0, 2.0, -1.0))
    box = trimesh.creation.box((0.06, 0.12, 0.09))
    box.apply_transform(turn)
    item = ObjectDescription("mesh", mesh=export(tmp_path, box))
    np.testing.assert_allclose(item.extent, (0.06, 0.12, 0.09), rtol=1e-6)
    np.testing.assert_allclose(
        item.inertia_matrix, ObjectDescription("cuboid", (0.06, 0.12, 0.09)).inertia_matrix, rtol=1e-6
    )


def test_axes_stay_where_they_may(tmp_path: Path) -> None:
    turn = trimesh.transformations.rotation_matrix(0.3, (1.0, 2.0, -1.0))[:3, :3]
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    cube.apply_transform(trimesh.transformations.rotation_matrix(0.3, (1.0, 2.0, -1.0)))
    vertices, _ = ObjectDescription("mesh", mesh=export(tmp_path, cube)).faces  # of a cube any axes are principal ones
    assert np.ptp(vertices, axis=0).min() > 0.11
    rod = turn @ np.diag([1.0, 2.0, 1.0]) @ turn.T  # its own axis must turn, and by no more than needed
    rotation = principal_rotation(rod)
    np.testing.assert_allclose(rotation @ rod @ rotation.T, np.diag([1.0, 2.0, 1.0]), atol=1e-9)
    angle = np.arccos(0.5 * (np.trace(rotation) - 1.0))
    assert angle == pytest.approx(np.arccos(turn[1, 1]), abs=1e-6)


BOX, BALL = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.icosphere(2, 0.05)
FLAT = trimesh.Trimesh(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], process=False
)
UNREAD = "is not a mesh of kind|no triangles"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "object.obj",
            trimesh.Trimesh(BALL.vertices, BALL.faces[::3], process=False),
            "not closed: .*grasp object mend",
        ),
        ("object.obj", trimesh.Trimesh(BOX.vertices, [[0, 1, 2], [0, 2, 1]], process=False), "encloses no volume"),
        (
            "object.stl",
            trimesh.creation.icosphere(7, 0.05),
            "327680 faces, allowed are up to 200000; simplify it: pip install",
        ),
        ("object.obj", BALL.copy().apply_scale(1000.0), "millimetres"),
        ("object.obj", FLAT, "encloses no volume"),
        ("object.pkl", b"", "file of type"),
        ("object.glb", b"", UNREAD),
        ("object.obj", b"", UNREAD),
        ("object.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("object.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", f"do not exist|{UNREAD}"),
        ("object.stl", b"solid of nothing", UNREAD),
        ("object.off", b"\x80\x04\x95", UNREAD),
        ("none.obj", None, "No such file"),
        (".", None, "file of type"),
        ("folder.obj", None, "it is a folder"),
    ],
)
def test_bad_meshes(tmp_path: Path, name: str, content: trimesh.Trimesh | bytes | None, message: str) -> None:
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        export(tmp_path, content, name)
    elif name == "folder.obj":
        path.mkdir()
    with pytest.raises(InvalidInputError, match=message):
        ObjectDescription("mesh", mesh=str(path))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"shape": "torus"}, "'cuboid', 'cylinder', 'sphere', 'capsule', 'mesh'"),
        ({"shape": "mesh"}, "needs the path"),
        ({"mesh": "a.obj"}, "mesh=None"),
        ({"size": (0.1, 0.1)}, "3 numbers"),
        ({"size": (0.1, -0.1, 0.1)}, "above 0"),
        ({"size": (0.1, float("nan"), 0.1)}, "finite"),
        ({"size": (100.0, 100.0, 100.0)}, "in metres"),
        ({"shape": "sphere", "size": (1e-4,)}, "0.001 to 1"),
        ({"shape": "capsule", "size": (0.1, 0.05)}, "at least its diameter"),
        ({"mass": 0.0}, "> 0"),
        ({"mass": 1e6}, "<= 1000"),
        ({"friction": -0.1}, "> 0"),
        ({"inertia": (1e-4, 1e-4, 3e-4)}, "sum of the other two"),
        ({"inertia": (1e-4, 1e-4)}, "3 numbers"),
    ],
)
def test_bad_numbers(fields: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        ObjectDescription(**fields)


def test_random_objects_are_within_and_repeat() -> None:
    drawn = [random_object(np.random.default_rng(seed)) for seed in range(200)]
    assert drawn == [random_object(np.random.default_rng(seed)) for seed in range(200)]
    assert {item.shape for item in drawn} == set(SHAPES_WITHOUT_MESH)
    for item in drawn:
        assert 0.07 <= min(item.size) <= max(item.size) <= 0.12
        assert 0.05 <= item.mass <= 0.5
        assert 0.3 <= item.friction <= 0.8
    states = set()
    for shape in SHAPES_WITHOUT_MESH:
        rng = np.random.default_rng(0)
        random_object(rng, shapes=[shape])
        states.add(rng.random())
    assert len(states) == 1
