"""Nearest points against scipy, trimesh and Bullet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from engines import UNDAMPED, Client, bullet, create_body, needs_bullet, set_dynamics
from scipy.optimize import minimize

from grasp_env.sim.objects.description import SHAPES, ObjectDescription

SIZES = {
    "cuboid": (0.1, 0.06, 0.08),
    "cylinder": (0.09, 0.07),
    "sphere": (0.08,),
    "capsule": (0.06, 0.11),
    "mesh": (1.0,),
}


def rock(folder: Path, corners: int = 30) -> str:
    """A crooked convex mesh in a file."""
    points = np.random.default_rng(0).normal(size=(corners, 3)) * (0.03, 0.04, 0.025)
    path = str(folder / f"rock{corners}.obj")
    trimesh.convex.convex_hull(points).export(path)
    return path


@pytest.fixture(params=SHAPES)
def item(request: pytest.FixtureRequest, tmp_path: Path) -> ObjectDescription:
    shape = request.param
    return ObjectDescription(shape, SIZES[shape], mesh=rock(tmp_path) if shape == "mesh" else None)


@pytest.fixture
def client() -> Iterator[int]:
    made = Client()
    yield made.number
    made.close()


def centers(count: int, low: float = 0.0, high: float = 0.09) -> np.ndarray:
    rng = np.random.default_rng(1)
    ways = rng.normal(size=(count, 3))
    return ways / np.linalg.norm(ways, axis=1)[:, None] * rng.uniform(low, high, (count, 1))


def found(item: ObjectDescription, center: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    point, normal, distance = item.surface.nearest(center)
    return distance, point, normal


def inside(item: ObjectDescription, x: np.ndarray) -> float:
    """>= 0 inside, by the definition of the shape."""
    size = np.array(item.size) / 2
    if item.shape == "cuboid":
        return float((size - np.abs(x)).min())
    if item.shape == "sphere":
        return float(size[0] - np.linalg.norm(x))
    if item.shape == "cylinder":
        return float(min(size[0] - np.hypot(x[0], x[2]), size[1] - abs(x[1])))
    straight = size[1] - size[0]
    return float(size[0] - np.linalg.norm(x - [0.0, np.clip(x[1], -straight, straight), 0.0]))


@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape != "mesh"])
def test_primitives_against_scipy(shape: str) -> None:
    item = ObjectDescription(shape, SIZES[shape])
    for center in centers(12, 0.02):
        distance, point, _ = found(item, center)
        assert abs(inside(item, point)) < 1e-12
        assert (distance < 0.0) == (inside(item, center) > 0.0)
        if distance > 0.0:
            best = minimize(
                lambda x, c=center: 1e4 * ((x - c) ** 2).sum(), 0.5 * point, method="SLSQP",
                constraints={"type": "ineq", "fun": lambda x: 100.0 * inside(item, x)}, options={"ftol": 1e-12},
            )  # fmt: skip
            assert distance <= np.linalg.norm(best.x - center) + 1e-7
        # nothing of a dense sample of the surface is nearer
        ways = centers(3000, 1.0, 1.0)
        away = [np.linalg.norm(found(item, 0.08 * way)[1] - center) for way in ways[:500]]
        assert abs(distance) <= min(away) + 1e-12


@pytest.mark.parametrize("corners", [4, 30, 150])
def test_mesh_against_trimesh(tmp_path: Path, corners: int) -> None:
    item = ObjectDescription("mesh", mesh=rock(tmp_path, corners))
    vertices, faces = item.faces
    for center in centers(60):
        distance, point, _ = found(item, center)
        around = np.repeat(center[None], len(faces), axis=0)
        each = trimesh.triangles.closest_point(vertices[faces], around)
        away = np.linalg.norm(each - center, axis=1)
        assert abs(distance) == pytest.approx(away.min(), abs=1e-12)
        np.testing.assert_allclose(point, each[away.argmin()], atol=1e-9)
        first, second, third = vertices[faces].transpose(1, 0, 2)
        heights = np.einsum("fk,fk->f", np.cross(second - first, third - first), center - first)
        assert (distance > 0.0) == bool(heights.max() > 0.0)


SPECIAL = ((0, 0, 0), (0, 0.02, 0), (0, 1, 0), (0.05, 0, 0), (1e-300, 0, 0), (0, 1e-200, 0))


def test_answer_is_consistent(item: ObjectDescription) -> None:
    """Also in the middle and on axes; points of the surface have its normal."""
    for center in (*np.array(SPECIAL, dtype=float), *centers(400)):
        distance, point, normal = found(item, center)
        assert np.isfinite([distance, *point]).all()
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(center + distance * normal, point, atol=1e-10)
        again, same, _ = found(item, point)
        assert abs(again) < 1e-12
        np.testing.assert_allclose(same, point, atol=1e-12)
    for center in centers(100, 0.02):
        _, point, normal = found(item, center)
        above, _, there = found(item, point - 1e-6 * normal)
        assert above == pytest.approx(1e-6, abs=1e-9)
        assert np.abs(there - normal).max() < 1e-5
        assert found(item, point + 1e-6 * normal)[0] < 0.0


@needs_bullet
def test_bullet_has_the_same_surface(item: ObjectDescription, client: int) -> None:
    body = create_body(client, item, (1.0, 1.0, 1.0))
    ball = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.01, physicsClientId=client)
    tip = bullet.createMultiBody(0.01, ball, physicsClientId=client)
    # Bullet's own search is coarse on the round side of a cylinder and on meshes, see create_body
    off, turned = {"cylinder": (4e-5, 0.04), "mesh": (2e-5, 0.01)}.get(item.shape, (1e-12, 1e-9))
    rough = []
    for center in centers(300, 0.03):
        distance, point, normal = found(item, center)
        if distance < 1e-3:
            continue
        bullet.resetBasePositionAndOrientation(tip, center.tolist(), (0, 0, 0, 1), physicsClientId=client)
        (row,) = bullet.getClosestPoints(body, tip, 0.2, physicsClientId=client)
        assert row[8] + 0.01 == pytest.approx(distance, abs=off)
        assert np.abs(np.array(row[7]) - normal).max() < turned
        np.testing.assert_allclose(row[5], point, atol=4e-5 + 0.1 * turned)
        rough.append(abs(row[8] + 0.01 - distance))
    assert np.median(rough) < 1e-5


@needs_bullet
def test_bullet_has_the_same_dynamics(item: ObjectDescription, client: int) -> None:
    body = create_body(client, item, (1.0, 1.0, 1.0))
    changed = ObjectDescription(item.shape, item.size, 0.35, 0.61, mesh=item.mesh)
    set_dynamics(client, body, changed)
    mass, friction, moments, *rest = bullet.getDynamicsInfo(body, -1, physicsClientId=client)[:8]
    assert (mass, friction, *rest) == (0.35, 0.61, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0.0, 0.0, 0.0)
    np.testing.assert_allclose(moments, np.diag(changed.inertia_matrix), rtol=1e-12)
    assert set(UNDAMPED.values()) == {0.0}
    if item.shape == "capsule":  # one that is as long as it is thick is a ball
        ball = ObjectDescription("capsule", (0.08, 0.08))
        create_body(client, ball, (1.0, 1.0, 1.0))
        np.testing.assert_allclose(ball.moments, ObjectDescription("sphere", (0.08,)).moments)
        assert found(ball, np.array([0.0, 0.0, 0.05]))[0] == pytest.approx(0.01)
