"""A hand holds objects that are not convex, in each engine; its contacts are those of the mesh in the file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import manifold3d
import numpy as np
import pytest
import trimesh
from engines import Client, bullet, create_body, needs_bullet
from episodes import ENV

from grasp_env.sim import BulletEngine, ObjectDescription
from grasp_env.sim.objects.mesh import _load, load_mesh

pytestmark = needs_bullet


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """No test reads or writes the user's cache."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        _load.cache_clear()
        yield
        _load.cache_clear()


def of_manifold(made: Any) -> trimesh.Trimesh:
    mesh = made.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False)


def block(x: float, y: float, z: float, at: tuple[float, float, float]) -> Any:
    return manifold3d.Manifold.cube((x, y, z), True).translate(at)


def l_shape() -> trimesh.Trimesh:
    return of_manifold(block(0.05, 0.09, 0.05, at=(0.0, 0.0, 0.0)) + block(0.09, 0.03, 0.05, at=(0.02, -0.03, 0.0)))


def mug() -> trimesh.Trimesh:
    """A square one with a square handle."""
    cup = block(0.06, 0.08, 0.06, at=(0.0, 0.0, 0.0)) - block(0.05, 0.08, 0.05, at=(0.0, 0.005, 0.0))
    handle = block(0.03, 0.05, 0.012, at=(0.04, 0.0, 0.0)) - block(0.02, 0.03, 0.02, at=(0.035, 0.0, 0.0))
    return of_manifold(cup + handle)


SOLIDS: dict[str, Callable[[], trimesh.Trimesh]] = {"L-shape": l_shape, "mug": mug}


@pytest.fixture(scope="module", params=SOLIDS)
def item(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ObjectDescription:
    path = str(tmp_path_factory.mktemp("mesh") / f"{request.param}.obj")
    SOLIDS[request.param]().export(path, digits=17)
    made = ObjectDescription.from_mesh(path, mass=0.12, friction=0.8)
    assert len(made.pieces) > 1
    return made


ENGINES = {
    "pieces": BulletEngine(mesh_contacts="pieces"), "faces": BulletEngine(mesh_contacts="faces"), "mujoco": "mujoco",
}  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
def test_a_hand_holds_it(item: ObjectDescription, engine: str) -> None:
    if engine == "mujoco":
        pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    file, mesh = load_mesh(str(item.mesh), 1.0), trimesh.load_mesh(str(item.mesh), process=False)
    corners = np.asarray(mesh.triangles)
    env = gym.make(ENV, hand="allegro", object=item, engine=ENGINES[engine])
    try:
        env.reset(seed=3)
        info: dict[str, Any] = {}
        seen = 0
        for _ in range(50):
            _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape or (), dtype=np.float32))
            assert not terminated, info
            scene = env.unwrapped.scene  # pyright: ignore
            look = scene.look()
            for point, normal in zip(
                look.points @ file.rotation + file.center, look.normals @ file.rotation, strict=True
            ):
                # in the frame of the file, against all of its faces
                around = np.repeat(point[None], len(corners), axis=0)
                away = np.linalg.norm(trimesh.triangles.closest_point(corners, around) - point, axis=1)
                assert away.min() < 1e-4
                near = away < 1e-4
                flat = mesh.face_normals[near]
                if (flat @ flat[0] > 1.0 - 1e-6).all():  # not at an edge
                    seen += 1
                    assert flat[0] @ -normal > np.cos(np.radians(2.0))
            if truncated:
                break
        assert info["is_success"], info
        assert seen > 50
    finally:
        env.close()


def test_faces_in_bullet_are_the_surface(item: ObjectDescription) -> None:
    """By a ball near the middles of faces, and above edges that stand out."""
    client = Client()
    try:
        body = create_body(client.number, item, (1.0, 1.0, 1.0), exact=True)
        ball = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.005, physicsClientId=client.number)
        tip = bullet.createMultiBody(0.01, ball, physicsClientId=client.number)
        rng, off = np.random.default_rng(0), []
        corners, faces = item.faces
        for _ in range(300):
            weights = rng.dirichlet((1.0, 1.0, 1.0))
            center = weights @ corners[faces[rng.integers(len(faces))]] + 0.012 * rng.normal(size=3)
            _, _, distance = item.surface.nearest(center)
            if distance < 0.006:
                continue
            bullet.resetBasePositionAndOrientation(tip, center.tolist(), (0, 0, 0, 1), physicsClientId=client.number)
            rows = bullet.getClosestPoints(body, tip, 0.1, physicsClientId=client.number)
            off.append(min(row[8] for row in rows) + 0.005 - distance)
        assert len(off) > 50
        assert np.abs(off).max() < 1e-7  # Bullet reads the file's corners as float32: 4e-9 of 0.05 m
    finally:
        client.close()


def test_the_geoms_of_mujoco_are_the_pieces(item: ObjectDescription) -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    env = gym.make(ENV, hand="allegro", object=item, engine="mujoco")
    try:
        env.reset(seed=0)
        simulator = env.unwrapped.scene.simulator  # pyright: ignore
        model, data = simulator.model, simulator.data
        geoms = [k for k in range(model.ngeom) if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_MESH]
        assert len(geoms) == len(item.pieces)
        for geom, piece in zip(geoms, item.pieces, strict=True):
            body, mesh = model.geom_bodyid[geom], model.geom_dataid[geom]
            begin = model.mesh_vertadr[mesh]
            points = model.mesh_vert[begin : begin + model.mesh_vertnum[mesh]].astype(float)
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            points = points @ turn.reshape(3, 3).T + model.geom_pos[geom]
            away = np.linalg.norm(points[:, None] - piece[None], axis=2)
            assert away.min(axis=0).max() < 1e-7  # float32
            assert away.min(axis=1).max() < 1e-7
            assert model.body_mass[body] == pytest.approx(item.mass)
        assert data.ncon >= 0
    finally:
        env.close()
