"""The physics of a scene, its exact resets, its refusals and its memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError, SimulationError
from grasp_env.grasp import presets
from grasp_env.sim import Camera, CameraConfig, Scene, SceneConfig

PUSH = np.array([0.4, -0.3, 0.2, 0.02, -0.03, 0.01])


def _record(scene: Scene, holder: Callable[[Scene], np.ndarray], steps: int = 60) -> np.ndarray:
    """Everything that can be read, over some steps in which the object is pushed about."""
    rows = []
    for k in range(steps):
        scene.step(holder(scene), PUSH * np.sin(0.2 * k))
        state, contacts = scene.state(), scene.contacts()
        parts = [scene.joints(), *dataclasses.astuple(state), *dataclasses.astuple(contacts)]
        rows.append(np.concatenate([np.ravel(part) for part in parts]))
    return np.array(rows)


def test_default_contacts_are_the_preset() -> None:
    config, grasp = SceneConfig(), presets.paper_cuboid()
    np.testing.assert_array_equal(config.contact_points, grasp.positions)
    np.testing.assert_array_equal(config.contact_normals, grasp.normals)


def test_reset_is_exact(held: Scene, make_holder: Callable) -> None:
    first = _record(held, make_holder())
    for _ in range(3):
        held.reset()
        np.testing.assert_array_equal(_record(held, make_holder()), first)


def test_reset_is_exact_after_losing_the_object(held: Scene, make_holder: Callable) -> None:
    first = _record(held, make_holder())
    for _ in range(200):
        held.step(np.zeros(12))
    assert held.state().position[1] < -0.3
    held.reset()
    np.testing.assert_array_equal(_record(held, make_holder()), first)


def test_reset_returns_the_settled_contacts(held: Scene, make_holder: Callable) -> None:
    held.reset()
    before = held.contacts()
    _record(held, make_holder(), 5)
    held.reset()
    np.testing.assert_array_equal(held.contacts().forces, before.forces)
    assert before.touching.all()


def test_two_scenes_are_equal_bit_by_bit(make_scene: Callable[..., Scene], make_holder: Callable) -> None:
    records = []
    for _ in range(2):
        scene = make_scene()
        scene.settle(make_holder(), duration=0.1)
        records.append(_record(scene, make_holder()))
    np.testing.assert_array_equal(*records)


def test_free_fall(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(clearance=0.02, physics_rate=1000.0)
    for _ in range(300):
        scene.step(scene.gravity_torques())
    state, time = scene.state(), 0.3
    np.testing.assert_allclose(state.linear_velocity[1], -9.81 * time, rtol=1e-9)
    np.testing.assert_allclose(state.position[1], -0.5 * 9.81 * time * (time + 1e-3), rtol=1e-9)
    np.testing.assert_allclose(state.position[1], -0.5 * 9.81 * time**2, rtol=4e-3)
    np.testing.assert_allclose(scene.joints()[1], 0.0, atol=1e-9)  # gravity compensation holds the hand


def test_wrench_acts_in_the_object_frame(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(gravity=(0.0, 0.0, 0.0), clearance=0.02)
    spin = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    while scene.state().quaternion[2] < np.sqrt(0.5):  # a quarter turn about z
        scene.step(np.zeros(12), spin)
    before = scene.state()
    scene.step(np.zeros(12), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    gained = scene.state().linear_velocity - before.linear_velocity
    expected = before.rotation[:, 0] * scene.timestep / scene.config.object_mass
    np.testing.assert_allclose(gained, expected, atol=1e-12)
    assert expected[1] > 0.9 * np.linalg.norm(expected)


def test_torques_are_cut_at_the_limit(make_scene: Callable[..., Scene]) -> None:
    scene, limit = make_scene(clearance=0.02), SceneConfig().hand.torque_limit
    speeds = []
    for torque in (limit, 100.0 * limit):
        scene.reset()
        scene.step(np.full(12, torque))
        speeds.append(scene.joints()[1])
    np.testing.assert_array_equal(*speeds)


@pytest.mark.parametrize("torques", [np.zeros(11), np.full(12, np.nan), np.full((1, 12), 0.0), "torque"])
def test_bad_torques_are_refused(held: Scene, torques: Any) -> None:
    with pytest.raises(InvalidInputError, match="torques"):
        held.step(torques)
    with pytest.raises(InvalidInputError, match="external_wrench"):
        held.step(np.zeros(12), np.zeros(5))


def _throw(scene: Scene, wrench: np.ndarray) -> None:
    for _ in range(80):
        scene.step(np.zeros(12), wrench)
        scene.contacts()


def test_divergence_is_an_error_and_reset_mends_it(held: Scene, make_holder: Callable) -> None:
    first = _record(held, make_holder())
    for push in (1e6, 1e308):  # Bullet cuts speeds at 100 m/s; the second makes NaN
        held.reset()
        with pytest.raises(SimulationError, match="diverged"):
            _throw(held, np.full(6, push))
        held.reset()
        np.testing.assert_array_equal(_record(held, make_holder()), first)


def test_a_controller_that_does_not_hold_is_refused(make_scene: Callable[..., Scene]) -> None:
    with pytest.raises(SimulationError, match="did not settle"):
        make_scene().settle(lambda scene: scene.gravity_torques(), duration=0.1)


def test_settling_again_replaces_the_saved_state(held: Scene, make_holder: Callable) -> None:
    held.settle(make_holder(squeeze=14.0))
    held.reset()
    assert held.contacts().forces[0, 2] == pytest.approx(14.0, abs=0.1)


@pytest.mark.parametrize("rate", [250.0, 1000.0])
def test_other_rates_hold(make_scene: Callable[..., Scene], make_holder: Callable, rate: float) -> None:
    scene = make_scene(physics_rate=rate)
    scene.settle(make_holder())
    np.testing.assert_allclose(scene.state().position, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("friction", 0.0, "friction"),
        ("physics_rate", float("nan"), "physics_rate"),
        ("half_extents", (0.05, 0.0, 0.05), "half_extents"),
        ("contact_points", ((0.0, 0.0, 0.05),), "shape"),
        ("contact_points", ((0.0, 0.0, 0.02),) * 4, "surface"),
        ("contact_normals", ((0.0, 0.0, 2.0),) * 4, "length 1"),
    ],
)
def test_config_refuses_nonsense(field: str, value: object, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(SceneConfig(), **{field: value})


def test_picture(held: Scene) -> None:
    state = held.joints().copy()
    camera = Camera(held, CameraConfig(width=64, height=48, supersampling=2))
    image = camera.capture()
    assert image.shape == (48, 64, 3)
    assert image.dtype == np.uint8
    assert image.std() > 10.0
    np.testing.assert_array_equal(camera.capture(), image)
    opaque = Camera(held, CameraConfig(width=64, height=48, supersampling=2, object_opacity=1.0))
    assert (opaque.capture() != image).any()
    np.testing.assert_array_equal(held.joints(), state)
    held.close()
    with pytest.raises(SimulationError, match="closed"):
        camera.capture()


def _resident() -> int:
    """Memory of this process [bytes]; 0 where the system does not tell."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * 4096 if status.exists() else 0


def test_memory_is_flat_over_resets(held: Scene, make_holder: Callable) -> None:
    holder, sizes = make_holder(), []
    for k in range(500):
        held.reset()
        held.step(holder(held))
        held.contacts()
        if k in (99, 499):
            sizes.append(_resident())
    assert sizes[1] - sizes[0] < 1_000_000
