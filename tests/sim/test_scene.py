"""The physics of a scene, and invalid use of it."""

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
from grasp_env.sim import BulletEngine, MujocoEngine, Scene
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.engine import engine_of

FREE = {"clearance": 0.02}
"""The object falls between fingers that do not touch it."""


def hold_still(scene: Scene, steps: int, wrench: np.ndarray | None = None) -> None:
    """Carry the weight of the hand, whatever the object does."""
    for _ in range(steps):
        scene.step(scene.look().gravity_torques, wrench)


@needs_bullet
def test_changed_mass_and_friction(make_scene: Callable[..., Scene]) -> None:
    """The hand's friction must stay 1: PyBullet resets it if some other options are set in the same call."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), inertia=(2e-4, 3e-4, 4e-4), friction=0.55, **FREE)
    push = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.001])
    gained = []
    for mass in (0.2, 0.5):
        scene.change_object(mass=mass)
        scene.reset()  # does not undo it
        hold_still(scene, 1, push)
        gained.append(np.append(scene.look().linear, scene.look().angular))
        assert scene.config.object.mass == mass
    np.testing.assert_allclose(gained[0][[1, 5]], np.array([0.1 / 0.2, 0.001 / 4e-4]) * scene.timestep, rtol=1e-12)
    np.testing.assert_allclose(gained[1], 0.4 * gained[0], rtol=1e-12)  # the inertia grows with the mass
    client, world = scene.simulator.client.number, scene.simulator.world
    for link in range(-1, bullet.getNumJoints(world.hand, physicsClientId=client)):
        assert bullet.getDynamicsInfo(world.hand, link, physicsClientId=client)[1] == 1.0
    for friction in (0.55, 0.7):
        assert bullet.getDynamicsInfo(world.object, -1, physicsClientId=client)[1] == friction
        scene.change_object(friction=0.7)
    assert (scene.config.object.friction, scene.config.object.mass) == (0.7, 0.5)


def test_free_fall_and_changed_gravity(make_scene: Callable[..., Scene]) -> None:
    """Bullet's Euler is semi-implicit: v_k = -g k dt and y_k = -g k (k + 1) dt^2 / 2, both exact here."""
    scene, steps = make_scene(engine=BulletEngine(rate=2000), **FREE), 400
    angles = scene.look().angles.copy()
    hold_still(scene, steps)
    s, dt = scene.look(), scene.timestep
    np.testing.assert_allclose(s.linear, [0.0, -9.81 * steps * dt, 0.0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(s.position[1], -0.5 * 9.81 * steps * (steps + 1) * dt**2, rtol=1e-9)
    np.testing.assert_array_equal(s.angular, 0.0)
    np.testing.assert_allclose(s.rates, 0.0, atol=1e-9)  # gravity compensation holds the hand
    np.testing.assert_allclose(s.angles, angles, atol=1e-9)
    gravity = np.array([3.0, 1.0, -2.0])
    scene.set_gravity(gravity)
    scene.reset()  # does not undo it
    hold_still(scene, 10)
    np.testing.assert_allclose(scene.look().linear, 10 * dt * gravity, rtol=1e-9)
    np.testing.assert_allclose(scene.look().rates, 0.0, atol=1e-9)


def test_nothing_is_damped(make_scene: Callable[..., Scene]) -> None:
    """Bullet's defaults would take 2 % of a free body's speed in half a second."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    scene.step(np.full(12, 1e-4), np.array([0.0, 1.0, 0.0, 0.0, 0.002, 0.0]))
    first = np.concatenate([scene.look().linear, scene.look().angular])
    for _ in range(125):
        scene.step(np.zeros(12))
    np.testing.assert_allclose(np.append(scene.look().linear, scene.look().angular), first, rtol=1e-9, atol=1e-12)
    assert first[[1, 4]].min() > 0.0


def test_joints_give_all_their_torque_and_no_more(make_scene: Callable[..., Scene]) -> None:
    """Even at 250 Hz, where Bullet's default limit of joint speeds would take a third of it: speed is linear in torque."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    speeds = []
    for torque in (0.12, 12.0, 1200.0):
        scene.reset()
        scene.step(np.array([0.0, torque, 0.0] + [0.0] * 9))
        speeds.append(scene.look().rates.copy())
    assert abs(speeds[1][1]) > 100.0
    np.testing.assert_allclose(speeds[1], 100.0 * speeds[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(speeds[2], speeds[1])  # clipped


@pytest.mark.parametrize("engine", [BulletEngine(rate=1000), MujocoEngine()], ids=lambda engine: engine.name)
def test_forces_and_momentum_balance(make_scene: Callable[..., Scene], make_holder: Callable, engine: Any) -> None:
    """Mean contact force + weight + wrench over a step is the change of momentum, although stiff contacts ring."""
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


CONFIG = SceneConfig()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene: scene.step(np.zeros(11)), "torques"),
        (lambda scene: scene.step(np.full(12, np.nan)), "torques"),
        (lambda scene: scene.step(np.zeros(12), np.zeros(5)), "external_wrench"),
        (lambda scene: scene.change_object(mass=-1.0), "mass"),
        (lambda _: dataclasses.replace(CONFIG, substeps=0), "substeps"),
        (lambda _: dataclasses.replace(CONFIG, engine="bullet"), "engine"),  # type: ignore[arg-type]
        (lambda _: dataclasses.replace(CONFIG, gravity=(0.0, math.inf, 0.0)), "gravity"),
        (lambda _: dataclasses.replace(CONFIG, clearance=math.nan), "clearance"),
        (lambda _: dataclasses.replace(CONFIG, contact_points=((0.0, 0.0, 0.05),)), "contact_points"),
        (lambda _: dataclasses.replace(CONFIG, contact_points=((0.0, 0.0, 0.02),) * 4), "surface"),
        (lambda _: dataclasses.replace(CONFIG, start_angles=(0.0,)), "start_angles"),
        (lambda _: Scene(dataclasses.replace(CONFIG, engine=type("Other", (MujocoEngine,), {"simulator": BulletEngine.simulator})())),
         "engine must be a BulletEngine|needs pybullet"),
    ],
)  # fmt: skip
def test_invalid_arguments(make_scene: Callable[..., Scene], call: Callable[[Scene], object], message: str) -> None:
    scene = make_scene()
    before = numbers(scene)
    with pytest.raises((InvalidInputError, SimulationError), match=message):
        call(scene)
    np.testing.assert_array_equal(numbers(scene), before)


@pytest.mark.parametrize(
    "engine", [pytest.param(BulletEngine(), marks=needs_bullet), MujocoEngine()], ids=lambda engine: engine.name
)
def test_closed_scenes_and_copies(make_scene: Callable[..., Scene], engine: Any) -> None:
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
@pytest.mark.parametrize("display", ["", ":9876"])
def test_window_without_display(monkeypatch: pytest.MonkeyPatch, display: str) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(SimulationError, match="display"):
        Client(gui=True)


def test_nothing_is_printed() -> None:
    code = f"""
from grasp_env.sim import Scene
from grasp_env.sim.engine import ENGINES
from grasp_env.sim.config import SceneConfig
Scene(SceneConfig(engine=ENGINES[{engine_of().name!r}]())).close()"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
