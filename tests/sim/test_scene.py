"""The physics of a scene, what it is built of, and its refusals."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from engines import Client, bullet, needs_bullet
from hands import numbers

from grasp_env.errors import InvalidInputError, SimulationError
from grasp_env.sim import BulletEngine, MujocoEngine, Scene, SceneConfig
from grasp_env.sim.engine import engine_of

FREE = {"clearance": 0.02}
"""The object falls between fingers that do not touch it."""


def _compensate(scene: Scene, steps: int, wrench: np.ndarray | None = None) -> None:
    """The hand stands still, whatever the object does."""
    for _ in range(steps):
        scene.step(scene.look().gravity_torques, wrench)


@needs_bullet
def test_changed_mass_and_friction(make_scene: Callable[..., Scene]) -> None:
    """Every part of the hand leaves the friction to the object: PyBullet forgets it where some other options are set in the same call."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), inertia=(2e-4, 3e-4, 4e-4), friction=0.55, **FREE)
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
    client, world = scene.simulator.client.number, scene.simulator.world
    for link in range(-1, bullet.getNumJoints(world.hand, physicsClientId=client)):
        assert bullet.getDynamicsInfo(world.hand, link, physicsClientId=client)[1] == 1.0
    for friction in (0.55, 0.7):
        assert bullet.getDynamicsInfo(world.object, -1, physicsClientId=client)[1] == friction
        scene.change_object(friction=0.7)
    assert (scene.config.object.friction, scene.config.object.mass) == (0.7, 0.5)
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


def test_joints_give_all_their_torque_and_no_more(make_scene: Callable[..., Scene]) -> None:
    """Also at 250 Hz, where Bullet's own limit of joint speeds would take a third of it: speed is linear in torque."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    speeds = []
    for torque in (0.12, 12.0, 1200.0):
        scene.reset()
        scene.step(np.array([0.0, torque, 0.0] + [0.0] * 9))
        speeds.append(scene.look().rates.copy())
    assert abs(speeds[1][1]) > 100.0
    np.testing.assert_allclose(speeds[1], 100.0 * speeds[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(speeds[2], speeds[1])  # cut at the limit


def test_bad_torques_are_refused(held: Scene) -> None:
    before = numbers(held)
    for torques in (np.zeros(11), np.full(12, np.nan), np.full((1, 12), 0.0), "torque", None):
        with pytest.raises(InvalidInputError, match="torques"):
            held.step(torques)  # type: ignore[arg-type]
    for wrench in (np.zeros(5), np.full(6, np.inf), "push"):
        with pytest.raises(InvalidInputError, match="external_wrench"):
            held.step(np.zeros(12), wrench)  # type: ignore[arg-type]
    np.testing.assert_array_equal(numbers(held), before)  # nothing moved


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


@pytest.mark.parametrize(
    "engine", [pytest.param(BulletEngine(), marks=needs_bullet), MujocoEngine()], ids=lambda engine: engine.name
)
def test_a_closed_scene_says_so(make_scene: Callable[..., Scene], engine: Any) -> None:
    pytest.importorskip(f"{'py' if engine.name == 'bullet' else ''}{engine.name}", reason="the engine is not installed")
    scene = make_scene(engine=engine)
    scene.look()
    scene.close()
    scene.close()
    calls: list[Callable[[], object]] = [
        scene.look, scene.reset, scene.keep, lambda: scene.step(np.zeros(12)), lambda: scene.change_object(mass=0.1),
        lambda: scene.set_gravity(np.zeros(3)), lambda: scene.load(SceneConfig(engine=engine)),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(SimulationError, match="closed"):
            call()
    for duplicate in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(SimulationError, match="copied"):
            duplicate(scene)


@needs_bullet
def test_window_without_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for display in (None, ":9876"):
        if display is None:
            monkeypatch.delenv("DISPLAY", raising=False)
        else:
            monkeypatch.setenv("DISPLAY", display)
        with pytest.raises(SimulationError, match="display"):
            Client(gui=True)


def test_nothing_is_printed() -> None:
    code = f"""
from grasp_env.sim import ENGINES, Scene, SceneConfig
Scene(SceneConfig(engine=ENGINES[{engine_of().name!r}]())).close()"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
