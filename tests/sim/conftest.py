"""A small controller that holds the reference grasp, and scenes that are closed after the test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from grasp_env.sim import Scene, SceneConfig

SQUEEZE = np.array([1.0, 0.4, 0.3, 0.3])  # normal forces of the reference grasp that balance


def grasp_matrix(points: np.ndarray) -> np.ndarray:
    """Forces (3N,) in object axes to their wrench (6,) about the object's centre."""
    columns = [np.vstack([np.eye(3), np.cross(np.eye(3), point).T * -1.0]) for point in points]
    return np.hstack(columns)


class Holder:
    """Squeezes, balances gravity and a given wrench, and springs the object to its nominal pose.

    Args:
        squeeze: Thumb force [N] added to what balances.
        wrench: Expected external wrench on the object, (6,), object frame, gravity not included.
    """

    def __init__(self, squeeze: float = 8.0, wrench: np.ndarray | None = None) -> None:
        self.squeeze = squeeze
        self.wrench = np.zeros(6) if wrench is None else np.asarray(wrench, dtype=float)
        self.forces = np.zeros((4, 3))

    def __call__(self, scene: Scene) -> np.ndarray:
        state, contacts = scene.state(), scene.contacts()
        mass = scene.config.object_mass
        turn = 2.0 * np.copysign(1.0, state.quaternion[3]) * state.quaternion[:3]
        pull = scene.config.weight + 200.0 * state.position
        pull += 2.0 * np.sqrt(200.0 * mass) * state.linear_velocity
        inertia = mass * 0.1**2 / 6.0
        twist = 2.0 * turn + 2.0 * np.sqrt(2.0 * inertia) * state.angular_velocity
        wanted = self.wrench + np.concatenate([pull, twist] @ state.rotation)
        inner = self.squeeze * SQUEEZE[:, None] * contacts.normals
        matrix = grasp_matrix(contacts.points)
        rest = -wanted - matrix @ inner.ravel()
        self.forces = inner + (np.linalg.pinv(matrix) @ rest).reshape(-1, 3)
        return scene.grasp_torques(self.forces)


@pytest.fixture
def make_holder() -> type[Holder]:
    """The controller's class; test modules cannot import this file."""
    return Holder


@pytest.fixture
def make_scene() -> Iterator[Callable[..., Scene]]:
    """Makes scenes from config fields and closes them."""
    scenes: list[Scene] = []

    def make(**fields: Any) -> Scene:
        scenes.append(Scene(SceneConfig(**fields)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


@pytest.fixture
def held(make_scene: Callable[..., Scene]) -> Scene:
    """The reference grasp, settled under gravity."""
    scene = make_scene()
    scene.settle(Holder())
    return scene
