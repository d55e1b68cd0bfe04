"""The snapshot of a scene: geometry and forces against Bullet's own answers, and unusual readings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from engines import bullet, needs_bullet
from hands import grasp_torques
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.sim import Scene
from grasp_env.sim.snapshot import Snapshot


@needs_bullet
def test_bodies_contacts_and_slip_are_those_of_bullet(held: Scene, make_holder: Callable) -> None:
    """While an unknown wrench moves and turns the object."""
    holder = make_holder()
    for _ in range(30):
        held.step(holder(held), np.array([0.3, 0.2, 0.0, 0.05, 0.05, 0.05]))
    s, client, world = held.look(), held.simulator.client.number, held.simulator.world
    assert np.abs(Rotation.from_matrix(s.rotation).as_rotvec()).min() > 1e-3
    assert s.touching.all()
    for joint, index in enumerate(world.joints):
        state = bullet.getLinkState(world.hand, index, 1, 1, physicsClientId=client)
        np.testing.assert_allclose(s.origins[joint], state[4], atol=1e-6)  # Bullet answers with single precision
        np.testing.assert_allclose(s.frames[joint], Rotation.from_quat(state[5]).as_matrix(), atol=1e-6)
    torques = bullet.calculateInverseDynamics(
        world.hand, s.angles.tolist(), [0.0] * 12, [0.0] * 12, physicsClientId=client
    )
    np.testing.assert_allclose(s.gravity_torques, torques, atol=1e-9)
    position, quaternion = bullet.getBasePositionAndOrientation(world.object, client)
    np.testing.assert_array_equal(s.position, position)
    np.testing.assert_allclose(s.rotation, Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal([s.linear, s.angular], bullet.getBaseVelocity(world.object, client))
    links = held.kinematics.tip_links.tolist()
    for finger, link in enumerate(links):
        tip = s.origins[link] + s.frames[link] @ held.config.hand.fingertips[finger].center
        np.testing.assert_allclose(s.tips[finger], tip, atol=1e-12)
        rows = bullet.getClosestPoints(
            world.hand, world.object, 0.01, linkIndexA=world.joints[link], physicsClientId=client
        )
        row = min(rows, key=lambda row: row[8])  # the tip's, among the shapes of its link
        np.testing.assert_allclose(s.points[finger], (np.array(row[6]) - s.position) @ s.rotation, atol=1e-6)
        np.testing.assert_allclose(s.normals[finger], -np.array(row[7]) @ s.rotation, atol=1e-5)
        np.testing.assert_allclose(s.gaps[finger], row[8], atol=1e-6)
        np.testing.assert_allclose(s.touch[finger], row[5], atol=1e-6)
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


@needs_bullet  # MuJoCo's contacts are springs
def test_measured_forces_are_the_commanded_ones(held: Scene, make_holder: Callable) -> None:
    wrench = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
    holder = make_holder(squeeze=12.0, wrench=wrench)
    for _ in range(200):
        held.step(holder(held), wrench)
    s = held.look()
    np.testing.assert_allclose(s.forces, holder.forces, atol=1e-6)
    np.testing.assert_allclose(np.cross(s.points, s.forces).sum(axis=0), -wrench[3:], atol=1e-6)
    assert np.abs(s.position).max() < 1e-6


def test_equilibrium_in_a_turned_object_frame(held: Scene, make_holder: Callable) -> None:
    wrench = np.array([1.0, -0.5, 0.4, 0.1, 0.1, -0.1])  # unknown to the controller: the pose yields
    holder = make_holder(squeeze=12.0)
    for _ in range(500):
        held.step(holder(held), wrench)
    s = held.look()
    assert (s.touching.all(), s.stray[0]) == (True, 0.0)
    assert (np.einsum("ni,ni->n", s.forces, s.normals) > 1.0).all()
    assert np.linalg.norm(Rotation.from_matrix(s.rotation).as_rotvec()) > 0.02
    # the wrench is given in the object frame, gravity in the world's
    total = s.forces.sum(axis=0) + wrench[:3] + held.config.weight @ s.rotation
    np.testing.assert_allclose(total, 0.0, atol=2e-3)
    np.testing.assert_allclose(np.cross(s.points, s.forces).sum(axis=0) + wrench[3:], 0.0, atol=2e-4)


@needs_bullet
@pytest.mark.parametrize("angle", [0.0, 45.0, 200.0])
def test_friction_cone_is_round(make_scene: Callable[..., Scene], make_holder: Callable, angle: float) -> None:
    """The object is pushed sideways out of a squeeze until all tips slide: tangential over normal force is then mu."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0))
    make_holder(squeeze=6.0).settle(scene)
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0, 0.0, 0.0, 0.0])
    squeeze, start, ratios, push = scene.look().forces.copy(), scene.look().tips.copy(), [], 3.0
    last = start.copy()
    while len(ratios) < 20:  # held back at their places, the tips slide once the push is large enough
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
    np.testing.assert_allclose(np.median(ratios, axis=0), 0.4, rtol=0.03)


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
def reading(make_scene: Callable[..., Scene]) -> Reading:
    made = Reading(make_scene())
    assert len(made.numbers) == core.reading_size(12, 0)
    assert len(contact(0, np.zeros(3), (0.0, 0.0, 0.0))) == core.reading_size(12, 1) - core.reading_size(12, 0)
    return made


def test_contacts_of_a_tip_add_up_and_others_are_stray(reading: Reading) -> None:
    link, at = reading.links[2], reading.touch[2]
    s = reading.look(contact(link, at, (-0.5, 0.0, -2.0)), contact(link, at + 1e-4, (0.0, 0.25, -1.0)))
    np.testing.assert_allclose(s.forces, [[0.0] * 3, [0.0] * 3, [-0.5, 0.25, -3.0], [0.0] * 3])
    np.testing.assert_array_equal(s.touching, [0.0, 0.0, 1.0, 0.0])
    assert s.stray[0] == 0.0
    beside = reading.touch[1] + np.array([0.0, 5.5e-3, 0.0])  # on the tip's link, more than 5 mm from the tip
    other = next(link for link in range(12) if link not in reading.links)
    rows = [contact(reading.links[1], beside, (4.0, 0.0, 3.0)), contact(other, reading.touch[1], (1.0, 0.0, 0.0))]
    s = reading.look(*rows, contact(-1, reading.touch[1], (0.0, 0.0, 2.0)))  # -1 is the palm
    assert s.stray[0] == pytest.approx(5.0 + 1.0 + 2.0)
    np.testing.assert_array_equal(s.forces, 0.0)
    assert not s.touching.any()
    assert not reading.look(contact(reading.links[0], reading.touch[0], (0.0, 0.0, 0.0))).touching.any()  # no force


def test_readings_that_are_not_finite_are_invalid(reading: Reading) -> None:
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


JOINTS = ((0.1, 1.0, (0.0,) * 6, 0.0), (0.2, 2.0, (0.0,) * 6, 0.0))
POSE, VELOCITY = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)), ((4.0, 5.0, 6.0), (7.0, 8.0, 9.0))


def test_answers_of_bullet_become_a_reading() -> None:
    """Force on the object = -(normal force * normal + friction * direction), as the hand is loaded first."""

    def answer(link: int) -> tuple[object, ...]:
        across = (0.5, (1.0, 0.0, 0.0), -0.25, (0.0, 1.0, 0.0))
        return (0, 1, 2, link, -1, (0.0,) * 3, (0.1, 0.2, 0.3), (0.0, 0.0, 1.0), -1e-5, 2.0, *across)

    links = [-1, -1, 1, 0]  # of Bullet's links -1, 0, 1, 2
    answers = core.Answers(link=3, place=6, forces=[(9, 7), (10, 11), (12, 13)], factor=-1.0, first=-1, links=links)
    good: list[object] = [JOINTS, POSE, VELOCITY, (answer(2), answer(-1))]
    expected = [0.1, 0.2, 1.0, 2.0, *POSE[0], *POSE[1], *VELOCITY[0], *VELOCITY[1]]
    for link in (0.0, -1.0):
        expected += [link, 0.1, 0.2, 0.3, -0.5, 0.25, -2.0]
    np.testing.assert_array_equal(answers.read(*good), expected)
    for place in range(4):
        for bad in ((1,), [(1, 2)], None):
            with pytest.raises((TypeError, IndexError, SystemError)):
                answers.read(*(bad if k == place else given for k, given in enumerate(good)))
