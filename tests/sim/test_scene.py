"""The physics of a scene, what it is built of, and its refusals."""

from __future__ import annotations

import dataclasses
import gc
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from engines import bullet, needs_bullet
from hands import numbers

from grasp_env.errors import GraspError, InvalidInputError, SimulationError
from grasp_env.grasp import presets
from grasp_env.sim import BulletEngine, Camera, CameraConfig, MujocoEngine, ObjectDescription, Scene, SceneConfig

FREE = {"clearance": 0.02}
"""The object falls between fingers that do not touch it."""


def _compensate(scene: Scene, steps: int, wrench: np.ndarray | None = None) -> None:
    """The hand stands still, whatever the object does."""
    for _ in range(steps):
        scene.step(scene.look().gravity_torques, wrench)


def test_default_contacts_are_the_preset() -> None:
    config, grasp = SceneConfig(), presets.paper_cuboid()
    np.testing.assert_array_equal(config.contact_points, grasp.positions)
    np.testing.assert_array_equal(config.contact_normals, grasp.normals)


def test_starts_at_the_nominal_contacts(make_scene: Callable[..., Scene]) -> None:
    s = make_scene().look()
    np.testing.assert_allclose(s.gaps, -1e-5, atol=1e-9)  # overlapping as much as Bullet lets bodies in contact do
    np.testing.assert_allclose(s.points, SceneConfig().contact_points, atol=1e-9)
    np.testing.assert_array_equal(s.position, 0.0)
    np.testing.assert_array_equal(s.rotation, np.eye(3))
    assert not s.touching.any()  # no step was made yet


@needs_bullet
def test_changed_mass_and_friction(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(gravity=(0.0, 0.0, 0.0), inertia=(2e-4, 3e-4, 4e-4), **FREE)
    push = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.001])
    gained = []
    for mass in (0.2, 0.5):
        scene.change_object(mass=mass)
        scene.reset()  # does not undo it
        _compensate(scene, 1, push)
        gained.append(np.append(scene.look().linear, scene.look().angular))
        assert scene.config.object.mass == mass
    np.testing.assert_allclose(gained[0][1], 0.1 / 0.2 * scene.timestep, rtol=1e-12)
    np.testing.assert_allclose(gained[0][5], 0.001 / 4e-4 * scene.timestep, rtol=1e-12)
    np.testing.assert_allclose(gained[1], 0.4 * gained[0], rtol=1e-12)  # the inertia grows with the mass
    scene.change_object(friction=0.7)
    assert (scene.config.object.friction, scene.config.object.mass) == (0.7, 0.5)
    info = bullet.getDynamicsInfo(scene.simulator.world.object, -1, physicsClientId=scene.simulator.client.number)
    assert info[1] == 0.7
    with pytest.raises(InvalidInputError, match="mass"):
        scene.change_object(mass=-1.0)


def test_free_fall(make_scene: Callable[..., Scene]) -> None:
    """Bullet's Euler is semi-implicit: v_k = -g k dt and y_k = -g k (k + 1) dt^2 / 2, both exact here.

    The continuous -g t^2 / 2 is then missed by the share dt / t, below 1e-3 after 0.6 s at 2 kHz.
    """
    scene, steps = make_scene(engine=BulletEngine(rate=2000), **FREE), 1200
    angles = scene.look().angles.copy()
    _compensate(scene, steps)
    s, dt = scene.look(), scene.timestep
    time = steps * dt
    np.testing.assert_allclose(s.linear, [0.0, -9.81 * time, 0.0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(s.position[1], -0.5 * 9.81 * time * (time + dt), rtol=1e-9)
    np.testing.assert_allclose(s.position[1], -0.5 * 9.81 * time**2, rtol=1e-3)
    np.testing.assert_array_equal(s.angular, 0.0)
    np.testing.assert_allclose(s.rates, 0.0, atol=1e-9)  # gravity compensation holds the hand
    np.testing.assert_allclose(s.angles, angles, atol=1e-9)


def test_another_gravity(make_scene: Callable[..., Scene]) -> None:
    scene, gravity = make_scene(**FREE), np.array([3.0, 1.0, -2.0])
    scene.set_gravity(gravity)
    _compensate(scene, 10)
    np.testing.assert_allclose(scene.look().linear, 10 * scene.timestep * gravity, rtol=1e-9)
    np.testing.assert_allclose(scene.look().rates, 0.0, atol=1e-9)
    scene.reset()
    _compensate(scene, 10)  # a reset does not undo it
    np.testing.assert_allclose(scene.look().linear, 10 * scene.timestep * gravity, rtol=1e-9)


def test_nothing_is_damped(make_scene: Callable[..., Scene]) -> None:
    """Bullet's defaults would take 8 % of a free body's speed in these 2 s."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    scene.step(np.full(12, 1e-4), np.array([0.0, 1.0, 0.0, 0.0, 0.002, 0.0]))
    first = np.concatenate([scene.look().linear, scene.look().angular])
    for _ in range(500):
        scene.step(np.zeros(12))
    s = scene.look()
    np.testing.assert_allclose(np.concatenate([s.linear, s.angular]), first, rtol=1e-9, atol=1e-12)
    assert first[1] > 0.0
    assert first[4] > 0.0


@needs_bullet
def test_every_part_of_the_hand_leaves_the_friction_to_the_object(make_scene: Callable[..., Scene]) -> None:
    """PyBullet forgets the friction of links where some other options are set in the same call."""
    scene = make_scene(friction=0.55)
    client, world = scene.simulator.client.number, scene.simulator.world
    for link in range(-1, bullet.getNumJoints(world.hand, physicsClientId=client)):
        assert bullet.getDynamicsInfo(world.hand, link, physicsClientId=client)[1] == 1.0
    assert bullet.getDynamicsInfo(world.object, -1, physicsClientId=client)[1] == 0.55


def test_joints_give_all_their_torque(make_scene: Callable[..., Scene]) -> None:
    """Also at 250 Hz, where Bullet's own limit of joint speeds would take a third of it: speed is linear in torque."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    speeds = []
    for torque in (0.12, 12.0):
        scene.reset()
        scene.step(np.array([0.0, torque, 0.0] + [0.0] * 9))
        speeds.append(scene.look().rates.copy())
    assert abs(speeds[1][1]) > 100.0
    np.testing.assert_allclose(speeds[1], 100.0 * speeds[0], rtol=1e-6, atol=1e-9)


def test_wrench_acts_in_the_object_frame(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    spin = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    while scene.look().rotation[1, 0] < 0.999:  # a quarter turn about z
        scene.step(np.zeros(12), spin)
    before, expected = scene.look().linear.copy(), scene.look().rotation[:, 0] * scene.timestep / 0.2
    scene.step(np.zeros(12), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(scene.look().linear - before, expected, atol=1e-12)
    assert expected[1] > 0.9 * np.linalg.norm(expected)


def test_torques_are_cut_at_the_limit(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(**FREE)
    limits = scene.kinematics.hand.torque_limits
    speeds = []
    for torques in (limits, 100.0 * limits):
        scene.reset()
        scene.step(torques)
        speeds.append(scene.look().rates.copy())
    np.testing.assert_array_equal(*speeds)
    assert (speeds[0] != 0.0).any()


@pytest.mark.parametrize("torques", [np.zeros(11), np.full(12, np.nan), np.full((1, 12), 0.0), "torque", None])
def test_bad_torques_are_refused(held: Scene, torques: Any) -> None:
    before = numbers(held)
    with pytest.raises(InvalidInputError, match="torques"):
        held.step(torques)
    for wrench in (np.zeros(5), np.full(6, np.inf), "push"):
        with pytest.raises(InvalidInputError, match="external_wrench"):
            held.step(np.zeros(12), wrench)
    np.testing.assert_array_equal(numbers(held), before)  # nothing moved


@pytest.mark.parametrize("rate", [500, 1000])
def test_other_rates_hold(make_scene: Callable[..., Scene], make_holder: Callable, rate: int) -> None:
    scene = make_scene(engine=BulletEngine(rate=rate))
    make_holder().settle(scene)
    np.testing.assert_allclose(scene.look().position, 0.0, atol=2e-6)
    total = scene.look().rotation @ scene.look().forces.sum(axis=0)
    np.testing.assert_allclose(total, -scene.config.weight, atol=0.01 * 0.2 * 9.81)


@pytest.mark.parametrize("engine", [BulletEngine(rate=1000), MujocoEngine()], ids=lambda engine: engine.name)
def test_momentum_is_what_forces_leave(make_scene: Callable[..., Scene], make_holder: Callable, engine: Any) -> None:
    """Mean contact force + weight + wrench over a step is the change of momentum in it, though stiff contacts ring."""
    pytest.importorskip("pybullet" if engine.name == "bullet" else "mujoco", reason="the engine is not installed")
    scene, holder = make_scene(engine=engine, substeps=4), make_holder()
    holder.settle(scene)
    missed = []
    for k in range(20):
        push = np.array([0.5 * math.sin(k), 0.0, 0.3, 0.0, 0.0, 0.0])
        before = scene.look().linear.copy()
        scene.step(holder(scene), push)
        s = scene.look()
        acts = s.rotation @ (s.forces.sum(axis=0) + push[:3]) + scene.config.weight
        missed.append(0.2 * (s.linear - before) / scene.timestep - acts)
    np.testing.assert_allclose(missed, 0.0, atol=1e-3)  # [N]; it turns a little within the step


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("substeps", 0, "substeps"),
        ("engine", "bullet", "engine"),
        ("gravity", (0.0, float("inf"), 0.0), "gravity"),
        ("gravity", (0.0, -9.81), "gravity"),
        ("clearance", float("nan"), "clearance"),
        ("contact_points", ((0.0, 0.0, 0.05),), "contact_points"),
        ("contact_points", ((0.0, 0.0, 0.02),) * 4, "surface"),
        ("contact_points", ((0.0, 0.0, float("nan")),) * 4, "contact_points"),
    ],
)
def test_config_refuses_nonsense(field: str, value: object, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(SceneConfig(), **{field: value})


def test_picture(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(visuals=True)
    state = numbers(scene)
    camera = Camera(scene, CameraConfig(width=64, height=48, supersampling=2))
    image = camera.capture()
    assert image.shape == (48, 64, 3)
    assert image.dtype == np.uint8
    assert image.std() > 10.0
    np.testing.assert_array_equal(camera.capture(), image)
    with camera.painter.object_hidden():
        assert (camera.capture() != image).any()
    np.testing.assert_array_equal(camera.capture(), image)
    np.testing.assert_array_equal(numbers(scene), state)
    scene.close()
    with pytest.raises(SimulationError, match="closed"):
        camera.capture()


def test_a_closed_scene_says_so(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene()
    scene.look()
    scene.close()
    scene.close()
    calls: list[Callable[[], object]] = [
        scene.look, scene.reset, scene.keep, lambda: scene.step(np.zeros(12)), lambda: scene.change_object(mass=0.1),
        lambda: scene.set_gravity(np.zeros(3)), lambda: scene.load(SceneConfig()),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(SimulationError, match="closed"):
            call()


@needs_bullet
def test_a_scene_that_cannot_be_leaves_no_connection() -> None:
    used = sum(bullet.isConnected(number) for number in range(64))
    far = SceneConfig(
        object=ObjectDescription(size=(0.1, 0.1, 0.8)),
        contact_points=tuple((x, y, 8.0 * z) for x, y, z in SceneConfig().contact_points),
    )
    with pytest.raises(GraspError, match="cannot reach"):
        Scene(far)
    gc.collect()
    assert sum(bullet.isConnected(number) for number in range(64)) == used
