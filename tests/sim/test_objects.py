"""Surfaces, inertia and descriptions of objects, against sums, samples and Bullet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from engines import Client, bullet, create_body, needs_bullet

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.sim.objects.description import SHAPES, SHAPES_WITHOUT_MESH, ObjectDescription

SIZES = {
    "cuboid": (0.1, 0.06, 0.08),
    "cylinder": (0.09, 0.07),
    "sphere": (0.08,),
    "capsule": (0.06, 0.11),
    "mesh": (1.0,),
}


@pytest.fixture(scope="module", params=[*SHAPES, "L"])
def item(request, tmp_path_factory):
    """Each shape; the meshes are a crooked rock and an L."""
    if request.param in SHAPES_WITHOUT_MESH:
        return ObjectDescription(request.param, SIZES[request.param])
    path = tmp_path_factory.mktemp("mesh") / "a.obj"
    rock = trimesh.convex.convex_hull(
        np.random.default_rng(0).normal(size=(30, 3)) * (0.03, 0.04, 0.025)
    )
    bars = [
        trimesh.creation.box(bounds=[(0, 0, 0), far])
        for far in ((0.03, 0.09, 0.05), (0.08, 0.03, 0.05))
    ]
    (rock if request.param == "mesh" else trimesh.boolean.union(bars)).export(path, digits=17)
    return ObjectDescription("mesh", mesh=str(path))


@pytest.fixture
def client():
    made = Client()
    yield made.number
    made.close()


def centers(count: int, low: float = 0.0, high: float = 0.09) -> np.ndarray:
    rng = np.random.default_rng(1)
    ways = rng.normal(size=(count, 3))
    return ways / np.linalg.norm(ways, axis=1)[:, None] * rng.uniform(low, high, (count, 1))


def inside(item: ObjectDescription, x: np.ndarray) -> np.ndarray:
    """A function of points (..., 3) that is >= 0 inside, by the definition of the shape."""
    size = np.array(item.size) / 2
    radius, along = (np.hypot(x[..., 0], x[..., 2]), np.abs(x[..., 1]))
    if item.shape == "cuboid":
        return (size - np.abs(x)).min(axis=-1)
    if item.shape == "cylinder":
        return np.minimum(size[0] - radius, size[1] - along)
    # a sphere is a short capsule
    return size[0] - np.hypot(radius, np.maximum(along - (size[-1] - size[0]), 0.0))


@pytest.mark.parametrize("shape", SHAPES_WITHOUT_MESH)
def test_nothing_is_nearer(shape):
    item = ObjectDescription(shape, SIZES[shape])
    sample = centers(200_000)
    within = inside(item, sample) >= 0.0
    for center in centers(12, 0.02):
        point, _, distance = item.surface.nearest(center)
        assert abs(inside(item, point)) < 1e-12
        assert (distance < 0.0) == (inside(item, center) > 0.0)
        other = sample[within] if distance > 0.0 else sample[~within]  # a point of the other side
        away = np.linalg.norm(other - center, axis=1).min()
        assert abs(distance) - 1e-12 <= away < abs(distance) + 0.004


SPECIAL = ((0, 0, 0), (0, 0.02, 0), (0, 1, 0), (0.05, 0, 0), (1e-300, 0, 0), (0, 1e-200, 0))


def test_nearest_points_are_consistent(item):
    """In the middle and on axes, too; points of the surface have its normal."""
    for center in (*np.array(SPECIAL, dtype=float), *centers(200)):
        point, normal, distance = item.surface.nearest(center)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(center + distance * normal, point, atol=1e-10)
        same, _, again = item.surface.nearest(point)
        assert abs(again) < 1e-12
        np.testing.assert_allclose(same, point, atol=1e-12)
        if 0.02 < np.linalg.norm(center) < 0.09:
            _, there, above = item.surface.nearest(point - 1e-6 * normal)
            assert above == pytest.approx(1e-6, abs=1e-9)
            assert np.abs(there - normal).max() < 1e-5
            assert item.surface.nearest(point + 1e-6 * normal)[2] < 0.0


@needs_bullet
def test_bullet_has_the_same_surface(item, client):
    exact = item.shape == "mesh" and len(item.pieces) > 1
    body = create_body(client, item, "faces" if exact else None)
    ball = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.01, physicsClientId=client)
    tip = bullet.createMultiBody(0.01, ball, physicsClientId=client)
    # Bullet's own search is coarse on the round side of a cylinder and on meshes, see create_body
    off, turned = {"cylinder": (4e-5, 0.04), "mesh": (2e-5, 0.01)}.get(item.shape, (1e-12, 1e-9))
    off = 1e-7 if exact else off  # corners as float32
    rough = []
    for center in centers(100, 0.03):
        point, normal, distance = item.surface.nearest(center)
        if distance < 1e-3:
            continue
        bullet.resetBasePositionAndOrientation(
            tip, center.tolist(), (0, 0, 0, 1), physicsClientId=client
        )
        row = min(
            bullet.getClosestPoints(body, tip, 0.2, physicsClientId=client), key=lambda row: row[8]
        )
        assert row[8] + 0.01 == pytest.approx(distance, abs=off)
        if not exact:  # at the hollow edge every direction is right
            assert np.abs(np.array(row[7]) - normal).max() < turned
            np.testing.assert_allclose(row[5], point, atol=4e-5 + 0.1 * turned)
        rough.append(abs(row[8] + 0.01 - distance))
    assert np.median(rough) < 1e-5


@pytest.mark.parametrize("shape", SHAPES_WITHOUT_MESH)
def test_inertia_by_slices(shape):
    item = ObjectDescription(shape, SIZES[shape], mass=0.3)
    across, half, deep = 0.5 * np.array(item.extent)
    y = ((np.arange(100_000) + 0.5) / 50_000 - 1.0) * half
    squared = across**2 - np.maximum(np.abs(y) - (half - across), 0.0) ** 2 * (
        shape in ("sphere", "capsule")
    )
    mass = 0.3 * squared / squared.sum()
    # mean squares over a slice: a rectangle or a disc
    x, z = (across**2 / 3.0, deep**2 / 3.0) if shape == "cuboid" else (squared / 4.0, squared / 4.0)
    wanted = [(mass * each).sum() for each in (y**2 + z, x + z, y**2 + x)]
    np.testing.assert_allclose(item.moments, wanted, rtol=1e-8)
    assert replace(item, inertia=(1e-4, 2e-4, 1e-4)).inertia_matrix[1, 1] == 2e-4


WRONG_NUMBERS = [
    ({"shape": "torus"}, "'cuboid', 'cylinder', 'sphere', 'capsule', 'mesh'"),
    ({"shape": "mesh"}, "needs the path"),
    ({"mesh": "a.obj"}, "mesh=None"),
    ({"size": (100.0, 100.0, 100.0)}, "in metres"),
    ({"shape": "sphere", "size": (1e-4,)}, "0.001 to 1"),
    ({"shape": "capsule", "size": (0.1, 0.05)}, "at least its diameter"),
    ({"mass": 0.0}, "> 0"),
    ({"inertia": (1e-4, 1e-4, 3e-4)}, "sum of the other two"),
]


@pytest.mark.parametrize(("fields", "message"), WRONG_NUMBERS)
def test_invalid_numbers(fields, message):
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        ObjectDescription(**fields)
    with pytest.raises(InvalidInputError, match="a sphere has no faces; only shape 'mesh' has"):
        _ = ObjectDescription("sphere").faces
    with pytest.raises(InvalidInputError, match="not both"):
        ObjectDescription.from_mesh("a.stl", density=1000.0, mass=0.1)


BALL = trimesh.creation.icosphere(2, 0.05)
FLAT = BALL.copy().apply_transform(np.diag([1.0, 1.0, 0.0, 1.0]))
UNREAD = "is not a mesh of kind|no triangles"


WRONG_MESHES = [
    (
        "a.obj",
        trimesh.Trimesh(BALL.vertices, BALL.faces[::3], process=False),
        "not closed: .*grasp object mend",
    ),
    ("a.obj", FLAT, "encloses no volume"),
    ("a.obj", BALL.copy().apply_scale(1000.0), "millimetres"),
    ("a.obj", trimesh.creation.box((0.06, 0.05, 5e-4)), "allowed are 0.001 to 1"),
    ("a.pkl", b"", "file of type"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", f"do not exist|{UNREAD}"),
    ("none.obj", None, "No such file"),
]


@pytest.mark.parametrize(("name", "content", "message"), WRONG_MESHES)
def test_invalid_meshes(tmp_path, name, content, message):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        content.export(path)
    with pytest.raises(InvalidInputError, match=message):
        ObjectDescription("mesh", mesh=str(path))
