"""What a scene says about itself: geometry and forces against Bullet's own answers, and what is made of odd readings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from engines import bullet, needs_bullet
from hands import grasp_torques, scene_alone
from scipy.spatial.transform import Rotation

from grasp_env import core
from grasp_env.grasp import presets
from grasp_env.sim import BulletEngine, Scene, Snapshot

WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


@pytest.fixture
def moving(held: Scene, make_holder: Callable) -> Scene:
    """The reference grasp while an unknown wrench moves and turns it."""
    holder = make_holder()
    for _ in range(30):
        held.step(holder(held), np.array([0.3, 0.2, 0.0, 0.05, 0.05, 0.05]))
    s = held.look()
    assert np.abs(s.rates).max() > 0.02
    assert np.abs(Rotation.from_matrix(s.rotation).as_rotvec()).min() > 1e-3
    assert s.touching.all()
    return held


def test_rotation_of_a_quaternion() -> None:
    scene, views = scene_alone()
    row = np.zeros(core.reading_size(12, 0))
    for turn in Rotation.random(50, rng=np.random.default_rng(0)):
        row[27:31] = turn.as_quat()
        assert scene.read(row)
        np.testing.assert_allclose(views.rotation, turn.as_matrix(), atol=1e-14)


@needs_bullet
def test_hand_and_object_are_where_bullet_has_them(moving: Scene) -> None:
    s, client, world = moving.look(), moving.simulator.client.number, moving.simulator.world
    for joint, index in enumerate(world.joints):
        state = bullet.getLinkState(world.hand, index, 1, 1, physicsClientId=client)
        np.testing.assert_allclose(s.origins[joint], state[4], atol=1e-6)  # Bullet answers with single precision
        np.testing.assert_allclose(s.frames[joint], Rotation.from_quat(state[5]).as_matrix(), atol=1e-6)
    for finger, link in enumerate(moving.kinematics.tip_links.tolist()):
        tip = s.origins[link] + s.frames[link] @ moving.config.hand.fingertips[finger].center
        np.testing.assert_allclose(s.tips[finger], tip, atol=1e-12)
    torques = bullet.calculateInverseDynamics(
        world.hand, s.angles.tolist(), [0.0] * 12, [0.0] * 12, physicsClientId=client
    )
    np.testing.assert_allclose(s.gravity_torques, torques, atol=1e-9)
    position, quaternion = bullet.getBasePositionAndOrientation(world.object, client)
    np.testing.assert_array_equal(s.position, position)
    np.testing.assert_allclose(s.rotation, Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal([s.linear, s.angular], bullet.getBaseVelocity(world.object, client))


@needs_bullet
def test_contact_geometry_and_slip_match_bullet(moving: Scene) -> None:
    client, world = moving.simulator.client.number, moving.simulator.world
    s, links = moving.look(), [world.joints[link] for link in moving.kinematics.tip_links.tolist()]
    for finger, link in enumerate(links):
        rows = bullet.getClosestPoints(world.hand, world.object, 0.01, linkIndexA=link, physicsClientId=client)
        row = min(rows, key=lambda row: row[8])  # the tip's, among the shapes of its link
        np.testing.assert_allclose(s.points[finger], (np.array(row[6]) - s.position) @ s.rotation, atol=1e-6)
        np.testing.assert_allclose(s.normals[finger], -np.array(row[7]) @ s.rotation, atol=1e-5)
        np.testing.assert_allclose(s.gaps[finger], row[8], atol=1e-6)
        np.testing.assert_allclose(s.touch[finger], row[5], atol=1e-6)
    moving.step(np.zeros(12))  # the grasp opens: tips and object part and slide
    s = moving.look()
    normals = s.normals @ s.rotation.T
    for finger, link in enumerate(links):
        state = bullet.getLinkState(world.hand, link, 1, 1, physicsClientId=client)
        tip = np.array(state[6]) + np.cross(state[7], s.touch[finger] - state[0])
        relative = tip - s.linear - np.cross(s.angular, s.touch[finger] - s.position)
        sliding = relative - relative @ normals[finger] * normals[finger]
        assert s.slip[finger] == pytest.approx(np.linalg.norm(sliding), rel=1e-4, abs=1e-6)
    assert s.slip.max() > 1e-2


def test_open_fingers_keep_their_geometry_and_slip_by_what_falls(make_scene: Callable[..., Scene]) -> None:
    """Without clearance tips overlap the object as much as Bullet lets bodies in contact do; either way no step was made yet."""
    for clearance, gap in ((0.0, -1e-5), (0.02, 0.02)):
        scene = make_scene(clearance=clearance)
        s = scene.look()
        assert not s.touching.any()
        np.testing.assert_array_equal(s.forces, 0.0)
        np.testing.assert_allclose(s.gaps, gap, atol=1e-9)
        np.testing.assert_allclose(s.points, presets.paper_cuboid().positions, atol=1e-9)
        np.testing.assert_array_equal(s.normals, presets.paper_cuboid().normals)
    for _ in range(10):
        scene.step(scene.look().gravity_torques)
    assert scene.look() is s  # read once per step into the same buffer
    np.testing.assert_allclose(s.slip, 9.81 * 10 * scene.timestep, rtol=1e-3)


@needs_bullet  # MuJoCo's contacts are springs; tests/sim/test_mujoco.py asks as much of them as they give
def test_measured_forces_are_the_commanded_ones(held: Scene, make_holder: Callable) -> None:
    holder = make_holder(squeeze=12.0, wrench=WRENCH)
    for _ in range(200):
        held.step(holder(held), WRENCH)
    s = held.look()
    np.testing.assert_allclose(s.forces, holder.forces, atol=1e-6)
    np.testing.assert_allclose(s.forces.sum(axis=0), -(WRENCH[:3] + held.config.weight), atol=1e-6)
    moment = np.cross(s.points, s.forces).sum(axis=0)
    np.testing.assert_allclose(moment, -WRENCH[3:], atol=1e-6)
    assert np.abs(s.position).max() < 1e-6


def test_equilibrium_in_a_turned_object_frame(held: Scene, make_holder: Callable) -> None:
    wrench = np.array([1.0, -0.5, 0.4, 0.1, 0.1, -0.1])  # unknown to the controller: the pose yields
    holder = make_holder(squeeze=12.0)
    for _ in range(600):
        held.step(holder(held), wrench)
    s = held.look()
    assert (s.touching.all(), s.stray[0]) == (True, 0.0)
    assert (np.einsum("ni,ni->n", s.forces, s.normals) > 1.0).all()
    assert np.linalg.norm(Rotation.from_matrix(s.rotation).as_rotvec()) > 0.02
    # the wrench is given in the object frame, gravity in the world's
    total = s.forces.sum(axis=0) + wrench[:3] + held.config.weight @ s.rotation
    np.testing.assert_allclose(total, 0.0, atol=2e-3)
    moment = np.cross(s.points, s.forces).sum(axis=0) + wrench[3:]
    np.testing.assert_allclose(moment, 0.0, atol=2e-4)


@needs_bullet  # MuJoCo's contacts are springs; tests/sim/test_mujoco.py asks as much of them as they give
@pytest.mark.parametrize("angle", range(0, 360, 45))
def test_friction_cone_is_round_and_not_squared(
    make_scene: Callable[..., Scene], make_holder: Callable, angle: float
) -> None:
    """The object is pushed sideways out of a squeeze until all tips slide: tangential over normal force is then mu."""
    scene = make_scene(gravity=(0.0, 0.0, 0.0))
    make_holder(squeeze=6.0).settle(scene)
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0, 0.0, 0.0, 0.0])
    squeeze, start, ratios, push = scene.look().forces.copy(), scene.look().tips.copy(), [], 0.0
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
            tangential = np.linalg.norm(s.forces - normal[:, None] * s.normals, axis=1)
            ratios.append(tangential / normal)
    assert push > 4.6
    np.testing.assert_allclose(np.median(ratios, axis=0), 0.4, rtol=0.03)


class Reading:
    """A reading of a simulator made up by hand: the reference grasp at rest, with contacts of choice."""

    def __init__(self, scene: Scene) -> None:
        s = scene.look()
        self.scene, self.links = scene, scene.kinematics.tip_links.tolist()
        self.numbers = np.concatenate([s.angles, s.rates, np.zeros(6), [1.0], np.zeros(6)])
        self.touch = s.touch.copy()

    def read(self, *rows: np.ndarray) -> bool:
        """Whether it is valid."""
        return self.scene.core.read(np.concatenate([self.numbers, *rows]))

    def look(self, *rows: np.ndarray) -> Snapshot:
        assert self.read(*rows)
        return Snapshot(**self.scene.core.arrays())


def contact(link: int, point: np.ndarray, force: tuple[float, float, float]) -> np.ndarray:
    """The hand's link, where, and the force on the object."""
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
    np.testing.assert_allclose(s.forces[2], [-0.5, 0.25, -3.0])
    np.testing.assert_array_equal(s.forces[[0, 1, 3]], 0.0)
    np.testing.assert_array_equal(s.touching, [0.0, 0.0, 1.0, 0.0])
    assert s.stray[0] == 0.0
    beside = reading.touch[1] + np.array([0.0, 5.5e-3, 0.0])  # the tip's link, not its tip: more than 5 mm away
    other = next(link for link in range(12) if link not in reading.links)
    rows = [contact(reading.links[1], beside, (4.0, 0.0, 3.0)), contact(other, reading.touch[1], (1.0, 0.0, 0.0))]
    s = reading.look(*rows, contact(-1, reading.touch[1], (0.0, 0.0, 2.0)))  # -1 is the palm
    assert s.stray[0] == pytest.approx(5.0 + 1.0 + 2.0)
    np.testing.assert_array_equal(s.forces, 0.0)
    assert not s.touching.any()
    assert not reading.look(contact(reading.links[0], reading.touch[0], (0.0, 0.0, 0.0))).touching.any()  # no force


def test_numbers_that_are_none_are_not_valid(reading: Reading) -> None:
    assert reading.read()
    for place in range(len(reading.numbers)):
        for bad in (np.nan, np.inf, -np.inf):
            kept = reading.numbers[place]
            reading.numbers[place] = bad
            assert not reading.read(), place
            reading.numbers[place] = kept
    for place in range(1, 7):
        row = contact(reading.links[0], reading.touch[0], (1.0, 0.1, 0.1))
        row[place] = np.nan
        assert not reading.read(row), place
    reading.numbers[25] = 11.0  # [m]: far away
    assert not reading.read()


class TestAnswers:
    """Bullet's tuples as a reading; the answer of a contact has 14 items."""

    JOINTS = ((0.1, 1.0, (0.0,) * 6, 0.0), (0.2, 2.0, (0.0,) * 6, 0.0))
    POSE = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    VELOCITY = ((4.0, 5.0, 6.0), (7.0, 8.0, 9.0))

    @staticmethod
    def contact(link: int) -> tuple[object, ...]:
        away = (0.0, 0.0, 0.0)
        across = (0.5, (1.0, 0.0, 0.0), -0.25, (0.0, 1.0, 0.0))
        return (0, 1, 2, link, -1, away, (0.1, 0.2, 0.3), (0.0, 0.0, 1.0), -1e-5, 2.0, *across)

    @pytest.fixture
    def answers(self) -> core.Answers:
        links = [-1, -1, 1, 0]  # of Bullet's links -1, 0, 1, 2
        return core.Answers(link=3, place=6, forces=[(9, 7), (10, 11), (12, 13)], factor=-1.0, first=-1, links=links)

    def test_as_flat_numbers(self, answers: core.Answers) -> None:
        """Force on the object = -(normal force * normal + friction * direction), by the order in which bodies are loaded."""
        given = (self.JOINTS, self.POSE, self.VELOCITY, (self.contact(2), self.contact(-1)))
        numbers = answers.read(*given)
        assert len(numbers) == core.reading_size(2, 2)
        expected = [0.1, 0.2, 1.0, 2.0, *self.POSE[0], *self.POSE[1], *self.VELOCITY[0], *self.VELOCITY[1]]
        for link in (0.0, -1.0):
            expected += [link, 0.1, 0.2, 0.3, -0.5, 0.25, -2.0]
        np.testing.assert_array_equal(numbers, expected)

    @pytest.mark.parametrize("bad", [(), (1,), [(1, 2)], "ab", None])
    def test_other_things_are_refused(self, answers: core.Answers, bad: object) -> None:
        good: list[object] = [self.JOINTS, self.POSE, self.VELOCITY, (self.contact(2),)]
        for place in range(4):
            if place in (0, 3) and bad == ():
                continue  # a hand without joints, no contacts
            with pytest.raises((TypeError, IndexError, SystemError)):
                answers.read(*good[:place], bad, *good[place + 1 :])


def test_a_link_that_pushes_the_object_is_seen(make_scene: Callable[..., Scene]) -> None:
    """The straight thumb swings against a low box: its link arrives at the lower edge, its tip is further down."""
    points = ((0.0, 0.0, -0.05), (0.0, 0.02, 0.05), (-0.03, -0.01, 0.05), (0.03, -0.01, 0.05))
    free = {"clearance": 0.02, "gravity": (0.0, 0.0, 0.0), "engine": BulletEngine(rate=1000)}
    scene = make_scene(size=(0.1, 0.06, 0.1), contact_points=points, **free)
    first = scene.look().angles.copy()
    for step in range(600):
        s, wanted = scene.look(), first.copy()
        wanted[:3] = (0.0, -0.6 if step < 300 else 0.9, 0.06)
        scene.step(1.0 * (wanted - s.angles) - 0.02 * s.rates)
        if scene.look().stray[0] > 0.1:
            break
    assert s.stray[0] > 0.1
    assert not s.touching[0]
    np.testing.assert_array_equal(s.forces[0], 0.0)
