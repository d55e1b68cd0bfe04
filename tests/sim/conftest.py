"""A controller that holds the reference grasp, engines, and scenes that are closed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hands import grasp_torques

from grasp_env.sim import BulletEngine, MujocoEngine, ObjectDescription, Scene
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.grasping import placing
from grasp_env.sim.objects import mesh


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """An empty cache of meshes and grasps, in memory and on disk."""
    kept = (mesh._load, placing._placed)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for each in kept:
        each.cache_clear()
    yield
    for each in kept:
        each.cache_clear()


SQUEEZE = np.array([1.0, 0.4, 0.3, 0.3])  # normal forces of the reference grasp that balance
OBJECT = ("shape", "size", "mass", "friction", "inertia", "mesh")


def grasp_matrix(points: np.ndarray) -> np.ndarray:
    """Map from forces (3N,), object frame, to their wrench (6,) about the object's centre."""
    columns = [np.vstack([np.eye(3), np.cross(np.eye(3), point).T * -1.0]) for point in points]
    return np.hstack(columns)


class Holder:
    """A controller that squeezes, balances gravity and a given wrench, and pulls the object to its
    nominal pose.

    Args:
        squeeze: Thumb force [N] added to what balances.
        wrench: Expected external wrench on the object, (6,), object frame, gravity not included.
    """

    def __init__(self, squeeze: float = 8.0, wrench: np.ndarray | None = None) -> None:
        self.squeeze = squeeze
        self.wrench = np.zeros(6) if wrench is None else np.asarray(wrench, dtype=float)
        self.forces = np.zeros((4, 3))

    def __call__(self, scene: Scene) -> np.ndarray:
        s = scene.look()
        mass = scene.config.object.mass
        skew = 0.5 * (s.rotation - s.rotation.T)
        turn = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        pull = mass * scene.gravity + 200.0 * s.position
        pull += 2.0 * np.sqrt(200.0 * mass) * s.linear
        inertia = mass * 0.1**2 / 6.0
        twist = 2.0 * turn + 2.0 * np.sqrt(2.0 * inertia) * s.angular
        wanted = self.wrench + np.concatenate([pull @ s.rotation, twist @ s.rotation])
        inner = self.squeeze * SQUEEZE[:, None] * s.normals
        matrix = grasp_matrix(s.points)
        rest = -wanted - matrix @ inner.ravel()
        self.forces = inner + (np.linalg.pinv(matrix) @ rest).reshape(-1, 3)
        return grasp_torques(scene, self.forces)

    def settle(self, scene: Scene) -> None:
        """Hold for half a second and save the state as "settled"."""
        for _ in range(round(0.5 / scene.timestep)):
            scene.step(self(scene))
        scene.keep("settled")


@pytest.fixture(params=[BulletEngine(), MujocoEngine()], ids=lambda engine: engine.name)
def engine(request):
    """Each engine that is installed."""
    module = {"bullet": "pybullet", "mujoco": "mujoco"}[request.param.name]
    pytest.importorskip(module, reason="the engine is not installed")
    return request.param


@pytest.fixture
def make_holder():
    """Return the controller's class, as test modules cannot import this file."""
    return Holder


@pytest.fixture
def make_scene():
    """Return a function that makes scenes from fields of the config and of its object; close them
    afterwards."""
    scenes: list[Scene] = []

    def make(visuals: bool = False, **fields: Any) -> Scene:
        item = {name: fields.pop(name) for name in OBJECT if name in fields}
        scenes.append(
            Scene(SceneConfig(object=ObjectDescription(**item), **fields), visuals=visuals)
        )
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


@pytest.fixture
def held(make_scene):
    """The reference grasp, settled under gravity."""
    scene = make_scene()
    Holder().settle(scene)
    return scene
