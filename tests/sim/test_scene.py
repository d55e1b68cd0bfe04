"""The physics of a scene, its snapshot, unusual readings, and invalid use."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
from engines import Client, bullet, needs_bullet
from hands import grasp_torques, numbers
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.errors import InvalidInputError, SimulationError
from grasp_env.sim import BulletEngine, MujocoEngine, Scene
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.engine import engine_of
from grasp_env.sim.snapshot import Snapshot

FREE = {"clearance": 0.02}
"""The object falls between fingers that do not touch it."""


def hold_still(scene: Scene, steps: int, wrench: np.ndarray | None = None) -> None:
    """Carry the weight of the hand, whatever the object does."""
    for _ in range(steps):
        scene.step(scene.look().gravity_torques, wrench)


def test_joint_friction_opposes_motion(make_scene, engine):
    """Torques below the friction move nothing; above it, what is left accelerates the joint.

    Engines treat friction as stiff, not rigid: a joint at rest may creep by a thousandth of what it
    would move without friction.
    """
    scene = make_scene(gravity=(0.0, 0.0, 0.0), engine=engine, **FREE)
    kinematics = scene.kinematics
    mass = kinematics.mass_matrix(scene.look().angles)
    steps = 10
    pushed = np.zeros(12)
    pushed[3] = 0.05
    speeds = []
    for friction in (0.0, 0.06, 0.03):
        scene.reset()
        scene.set_joint_friction(friction)
        for _ in range(steps):
            scene.step(pushed)
        speeds.append(scene.look().rates[3])
    free, stuck, slowed = speeds
    assert free == pytest.approx(
        np.linalg.inv(mass)[3, 3] * 0.05 * steps * scene.timestep, rel=0.05
    )
    assert abs(stuck) < 1e-3 * free
    still = np.flatnonzero(np.abs(pushed) == 0.0)
    assert np.abs(scene.look().rates[still]).max() < 1e-3 * free  # they are held, too
    assert slowed == pytest.approx(0.02 / mass[3, 3] * steps * scene.timestep, rel=0.1)


@needs_bullet
def test_changed_mass_and_friction(make_scene):
    """The hand's friction must stay 1: PyBullet resets it if some other options are set in the same
    call."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), inertia=(2e-4, 3e-4, 4e-4), friction=0.55, **FREE)
    push = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.001])
    gained = []
    for mass in (0.2, 0.5):
        scene.change_object(mass=mass)
        scene.reset()  # does not undo it
        hold_still(scene, 1, push)
        gained.append(np.append(scene.look().linear, scene.look().angular))
        assert scene.config.object.mass == mass
    assert_allclose(
        gained[0][[1, 5]], np.array([0.1 / 0.2, 0.001 / 4e-4]) * scene.timestep, rtol=1e-12
    )
    # the inertia grows with the mass
    assert_allclose(gained[1], 0.4 * gained[0], rtol=1e-12)
    client = scene.simulator.client.number
    world = scene.simulator.world
    scene.reset()
    # wrenches are in the object's frame, whose z is now the world's -y
    turned = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    bullet.resetBasePositionAndOrientation(world.object, (0.0, 0.0, 0.0), turned, client)
    scene.step(np.zeros(12), np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.001]))
    down = -np.array([0.1 / 0.5, 0.001 / 1e-3]) * scene.timestep
    assert_allclose(
        [scene.look().linear, scene.look().angular], np.outer(down, (0.0, 1.0, 0.0)), atol=1e-9
    )
    for link in range(-1, bullet.getNumJoints(world.hand, physicsClientId=client)):
        assert bullet.getDynamicsInfo(world.hand, link, physicsClientId=client)[1] == 1.0
    for friction in (0.55, 0.7):
        assert bullet.getDynamicsInfo(world.object, -1, physicsClientId=client)[1] == friction
        scene.change_object(friction=0.7)
    assert (scene.config.object.friction, scene.config.object.mass) == (0.7, 0.5)


def test_free_fall_and_changed_gravity(make_scene):
    """Bullet's Euler is semi-implicit: v_k = -g k dt and y_k = -g k (k + 1) dt^2 / 2, both exact
    here."""
    scene = make_scene(engine=BulletEngine(rate=2000), **FREE)
    steps = 400
    angles = scene.look().angles.copy()
    hold_still(scene, steps)
    s = scene.look()
    dt = scene.timestep
    assert_allclose(s.linear, [0.0, -9.81 * steps * dt, 0.0], rtol=1e-9, atol=1e-12)
    assert_allclose(s.position[1], -0.5 * 9.81 * steps * (steps + 1) * dt**2, rtol=1e-9)
    assert_array_equal(s.angular, 0.0)
    assert_allclose(s.rates, 0.0, atol=1e-9)  # gravity compensation holds the hand
    assert_allclose(s.angles, angles, atol=1e-9)
    gravity = np.array([3.0, 1.0, -2.0])
    scene.set_gravity(gravity)
    scene.reset()  # does not undo it
    hold_still(scene, 10)
    assert_allclose(scene.look().linear, 10 * dt * gravity, rtol=1e-9)
    assert_allclose(scene.look().rates, 0.0, atol=1e-9)


def test_nothing_is_damped(make_scene):
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    scene.step(np.full(12, 1e-4), np.array([0.0, 1.0, 0.0, 0.0, 0.002, 0.0]))
    first = np.append(scene.look().linear, scene.look().angular)
    hold_still(scene, 20)
    assert_allclose(
        np.append(scene.look().linear, scene.look().angular), first, rtol=1e-9, atol=1e-12
    )
    assert first[[1, 4]].min() > 0.0


def test_joints_give_all_their_torque_and_no_more(make_scene):
    """Even at 250 Hz, where Bullet's default limit of joint speeds would take a third of it: speed
    is linear in torque."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0), **FREE)
    speeds = []
    for torque in (0.12, 12.0, 1200.0):
        scene.reset()
        scene.step(np.array([0.0, torque, 0.0] + [0.0] * 9))
        speeds.append(scene.look().rates.copy())
    assert abs(speeds[1][1]) > 100.0
    assert_allclose(speeds[1], 100.0 * speeds[0], rtol=1e-6, atol=1e-9)
    assert_array_equal(speeds[2], speeds[1])  # clipped


def test_forces_and_momentum_balance(make_scene, make_holder, engine):
    """Mean contact force + weight + wrench over a step is the change of momentum, although stiff
    contacts ring."""
    scene = make_scene(engine=dataclasses.replace(engine, rate=1000), substeps=4)
    holder = make_holder()
    holder.settle(scene)
    missed = []
    for k in range(20):
        push = np.array([0.5 * math.sin(k), 0.0, 0.3, 0.0, 0.0, 0.0])
        before = scene.look().linear.copy()
        scene.step(holder(scene), push)
        s = scene.look()
        acts = (
            s.rotation @ (s.forces.sum(axis=0) + push[:3])
            + scene.config.object.mass * scene.gravity
        )
        missed.append(0.2 * (s.linear - before) / scene.timestep - acts)
    assert_allclose(missed, 0.0, atol=1e-3)  # [N]; it turns a little within the step


CONFIG = SceneConfig()


INVALID = [
    (lambda scene: scene.step(np.zeros(11)), "torques"),
    (lambda scene: scene.step(np.zeros(12), np.zeros(5)), "external_wrench"),
    (lambda scene: scene.change_object(mass=-1.0), "mass"),
    (lambda _: dataclasses.replace(CONFIG, engine="bullet"), "engine"),
    (lambda _: dataclasses.replace(CONFIG, contact_points=((0.0, 0.0, 0.05),)), "contact_points"),
    (lambda _: dataclasses.replace(CONFIG, contact_points=((0.0, 0.0, 0.02),) * 4), "surface"),
    (lambda _: dataclasses.replace(CONFIG, start_angles=(0.0,)), "start_angles"),
    (
        lambda _: Scene(
            dataclasses.replace(
                CONFIG,
                engine=type("Other", (MujocoEngine,), {"simulator": BulletEngine.simulator})(),
            )
        ),
        "engine must be a BulletEngine|needs pybullet",
    ),
]


@pytest.mark.parametrize(("call", "message"), INVALID)
def test_invalid_arguments(make_scene, call, message):
    scene = make_scene()
    before = numbers(scene)
    with pytest.raises((InvalidInputError, SimulationError), match=message):
        call(scene)
    assert_array_equal(numbers(scene), before)


def test_closed_scenes_and_copies(make_scene, engine):
    scene = make_scene(engine=engine)
    scene.look()
    server = scene.simulator.client.number if engine.name == "bullet" else None
    scene.close()
    scene.close()
    assert server is None or not bullet.isConnected(server)
    calls: list[Callable[[], object]] = [
        scene.look,
        scene.reset,
        scene.keep,
        lambda: scene.step(np.zeros(12)),
        lambda: scene.change_object(mass=0.1),
        lambda: scene.set_gravity(np.zeros(3)),
        lambda: scene.load(SceneConfig(engine=engine)),
    ]
    for call in calls:
        with pytest.raises(SimulationError, match="closed"):
            call()
    for duplicate in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(SimulationError, match="copied"):
            duplicate(scene)


@needs_bullet
@pytest.mark.parametrize("display", ["", ":9876"])
def test_window_without_display(monkeypatch, display):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(SimulationError, match="display"):
        Client(gui=True)


def test_nothing_is_printed():
    code = f"""
from grasp_env.sim import Scene
from grasp_env.sim.engine import ENGINES
from grasp_env.sim.config import SceneConfig
Scene(SceneConfig(engine=ENGINES[{engine_of().name!r}]())).close()"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


@needs_bullet
def test_snapshots_are_those_of_bullet(held, make_holder):
    """While an unknown wrench moves and turns the object."""
    holder = make_holder()
    for _ in range(30):
        held.step(holder(held), np.array([0.3, 0.2, 0.0, 0.05, 0.05, 0.05]))
    s = held.look()
    client = held.simulator.client.number
    world = held.simulator.world
    assert np.abs(Rotation.from_matrix(s.rotation).as_rotvec()).min() > 1e-3
    assert s.touching.all()
    for joint, index in enumerate(world.joints):
        state = bullet.getLinkState(world.hand, index, 1, 1, physicsClientId=client)
        # Bullet answers with single precision
        assert_allclose(s.origins[joint], state[4], atol=1e-6)
        assert_allclose(s.frames[joint], Rotation.from_quat(state[5]).as_matrix(), atol=1e-6)
    torques = bullet.calculateInverseDynamics(
        world.hand, s.angles.tolist(), [0.0] * 12, [0.0] * 12, physicsClientId=client
    )
    assert_allclose(s.gravity_torques, torques, atol=1e-9)
    position, quaternion = bullet.getBasePositionAndOrientation(world.object, client)
    assert_array_equal(s.position, position)
    assert_allclose(s.rotation, Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    assert_array_equal([s.linear, s.angular], bullet.getBaseVelocity(world.object, client))
    links = held.kinematics.tip_links.tolist()
    for finger, link in enumerate(links):
        tip = s.origins[link] + s.frames[link] @ held.config.hand.fingertips[finger].center
        assert_allclose(s.tips[finger], tip, atol=1e-12)
        rows = bullet.getClosestPoints(
            world.hand, world.object, 0.01, linkIndexA=world.joints[link], physicsClientId=client
        )
        row = min(rows, key=lambda row: row[8])  # the tip's, among the shapes of its link
        assert_allclose(s.points[finger], (np.array(row[6]) - s.position) @ s.rotation, atol=1e-6)
        assert_allclose(s.normals[finger], -np.array(row[7]) @ s.rotation, atol=1e-5)
        assert_allclose(s.gaps[finger], row[8], atol=1e-6)
        assert_allclose(s.touch[finger], row[5], atol=1e-6)
    held.step(np.zeros(12))  # the grasp opens: tips and object part and slide
    s = held.look()
    for finger, link in enumerate(links):
        state = bullet.getLinkState(world.hand, world.joints[link], 1, 1, physicsClientId=client)
        tip = np.array(state[6]) + np.cross(state[7], s.touch[finger] - state[0])
        relative = tip - s.linear - np.cross(s.angular, s.touch[finger] - s.position)
        normal = s.rotation @ s.normals[finger]
        sliding = np.linalg.norm(relative - relative @ normal * normal)
        assert s.slip[finger] == pytest.approx(sliding, rel=1e-4, abs=1e-6)
    assert s.slip.max() > 1e-2


@needs_bullet
@pytest.mark.parametrize("angle", [0.0, 200.0])
def test_friction_cone_is_round(make_scene, make_holder, angle):
    """The object is pushed sideways out of a squeeze until all tips slide: tangential over normal
    force is then mu."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0))
    make_holder(squeeze=6.0).settle(scene)
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0, 0.0, 0.0, 0.0])
    squeeze = scene.look().forces.copy()
    start = scene.look().tips.copy()
    ratios = []
    push = 3.0
    last = start.copy()
    # held back at their places, the tips slide once the push is large enough
    while len(ratios) < 20:
        push += 5.0 * scene.timestep
        assert push < 6.0, "the object should slide at 2 * 0.4 * 6 N = 4.8 N"
        speed = (scene.look().tips - last) / scene.timestep
        last = scene.look().tips.copy()
        spring = -1000.0 * (last - start) - 4.0 * speed
        spring[:, 2] = 0.0
        scene.step(grasp_torques(scene, squeeze + spring), push * direction)
        s = scene.look()
        if s.slip.min() > 1e-3:
            normal = np.einsum("ni,ni->n", s.forces, s.normals)
            ratios.append(np.linalg.norm(s.forces - normal[:, None] * s.normals, axis=1) / normal)
    assert push > 4.6
    assert_allclose(np.median(ratios, axis=0), 0.4, rtol=0.03)


class Reading:
    """A reading without a simulator: the reference grasp at rest, with any contacts."""

    def __init__(self, scene: Scene) -> None:
        s = scene.look()
        self.scene, self.links = scene, scene.kinematics.tip_links.tolist()
        self.numbers = np.concatenate([s.angles, s.rates, np.zeros(6), [1.0], np.zeros(6)])
        self.touch = s.touch.copy()

    def read(self, *rows: np.ndarray) -> bool:
        return self.scene.core.read(np.concatenate([self.numbers, *rows]))

    def look(self, *rows: np.ndarray) -> Snapshot:
        assert self.read(*rows)
        return Snapshot(**self.scene.core.arrays())


def contact(link: int, point: np.ndarray, force: tuple[float, float, float]) -> np.ndarray:
    """The hand's link, the point, and the force on the object."""
    return np.array([link, *point, *force], dtype=float)


@pytest.fixture
def reading(make_scene):
    made = Reading(make_scene())
    assert len(made.numbers) == core.reading_size(12, 0)
    assert len(contact(0, np.zeros(3), (0.0, 0.0, 0.0))) == core.reading_size(
        12, 1
    ) - core.reading_size(12, 0)
    return made


def test_contacts_add_up_and_others_are_stray(reading):
    link = reading.links[2]
    at = reading.touch[2]
    s = reading.look(
        contact(link, at, (-0.5, 0.0, -2.0)), contact(link, at + 1e-4, (0.0, 0.25, -1.0))
    )
    assert_allclose(s.forces, [[0.0] * 3, [0.0] * 3, [-0.5, 0.25, -3.0], [0.0] * 3])
    assert_array_equal(s.touching, [0.0, 0.0, 1.0, 0.0])
    assert s.stray[0] == 0.0
    # on the tip's link, more than 5 mm from the tip
    beside = reading.touch[1] + np.array([0.0, 5.5e-3, 0.0])
    other = next(link for link in range(12) if link not in reading.links)
    rows = [
        contact(reading.links[1], beside, (4.0, 0.0, 3.0)),
        contact(other, reading.touch[1], (1.0, 0.0, 0.0)),
    ]
    s = reading.look(*rows, contact(-1, reading.touch[1], (0.0, 0.0, 2.0)))  # -1 is the palm
    assert s.stray[0] == pytest.approx(5.0 + 1.0 + 2.0)
    assert_array_equal(s.forces, 0.0)
    assert not s.touching.any()
    # no force
    assert not reading.look(
        contact(reading.links[0], reading.touch[0], (0.0, 0.0, 0.0))
    ).touching.any()


def test_readings_that_are_not_finite_are_invalid(reading):
    assert reading.read()
    for place, before in enumerate(reading.numbers.tolist()):
        reading.numbers[place] = np.nan if place % 2 else np.inf
        assert not reading.read(), place
        reading.numbers[place] = before
    for place in range(1, 7):
        row = contact(reading.links[0], reading.touch[0], (1.0, 0.1, 0.1))
        row[place] = np.nan
        assert not reading.read(row), place
    reading.numbers[25] = 11.0  # [m]: far away
    assert not reading.read()
