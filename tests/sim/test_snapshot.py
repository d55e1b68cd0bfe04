"""What a scene says about itself: geometry and forces against Bullet's own answers, and what is made of odd readings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grasp_env.sim import HANDS, HandKinematics, ObjectDescription, Scene
from grasp_env.sim.client import bullet
from grasp_env.sim.snapshot import (
    BODY,
    ROW,
    STRAY_DISTANCE,
    Snapshot,
    observe,
    pack_tree,
    snapshot_size,
    split,
    unpack_tree,
    write_rotation,
)

WRENCH = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


def _tip_links(scene: Scene) -> list[int]:
    """Bullet's numbers of the links with a tip."""
    return [scene.bodies.joints[link] for link in scene.kinematics.tree.tip_links.tolist()]


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


def test_the_views_fill_the_buffer_and_share_nothing() -> None:
    for tips, joints in ((4, 12), (3, 9), (1, 7)):
        buffer = np.zeros(snapshot_size(tips, joints))
        views = split(buffer, tips, joints)
        assert isinstance(views, Snapshot)
        for mark, view in enumerate(views, start=1):
            assert (view == 0.0).all()
            view[...] = mark
        assert (buffer > 0.0).all()
        for mark, view in enumerate(views, start=1):
            assert (view == mark).all()
        assert views.points.shape == views.normals.shape == views.touch.shape == views.forces.shape == (tips, 3)
        assert views.frames.shape == (joints, 3, 3)


@pytest.mark.parametrize("name", sorted(HANDS))
def test_a_packed_tree_comes_back(name: str) -> None:
    tree = HandKinematics(HANDS[name]()).tree
    again = unpack_tree(*pack_tree(tree))
    for before, after in zip(tree, again, strict=True):
        np.testing.assert_array_equal(before, after)
        assert before.shape == after.shape


def test_rotation_of_a_quaternion() -> None:
    rotation = np.empty((3, 3))
    for turn in Rotation.random(50, rng=np.random.default_rng(0)):
        write_rotation(turn.as_quat(), rotation)
        np.testing.assert_allclose(rotation, turn.as_matrix(), atol=1e-14)


def test_the_hand_is_where_bullet_has_it(moving: Scene) -> None:
    s, client, tree = moving.look(), moving.client.number, moving.kinematics.tree
    for joint, index in enumerate(moving.bodies.joints):
        state = bullet.getLinkState(
            moving.bodies.hand, index, computeLinkVelocity=1, computeForwardKinematics=1, physicsClientId=client
        )
        np.testing.assert_allclose(s.origins[joint], state[4], atol=1e-6)  # Bullet answers with single precision
        turned = Rotation.from_quat(state[5]).as_matrix()
        np.testing.assert_allclose(s.frames[joint], turned, atol=1e-6)
    for finger, link in enumerate(tree.tip_links.tolist()):
        tip = s.origins[link] + s.frames[link] @ tree.tip_centers[finger]
        np.testing.assert_allclose(s.tips[finger], tip, atol=1e-12)
    torques = bullet.calculateInverseDynamics(
        moving.bodies.hand, s.angles.tolist(), [0.0] * 12, [0.0] * 12, physicsClientId=client
    )
    np.testing.assert_allclose(s.gravity_torques, torques, atol=1e-9)


def test_the_object_is_where_bullet_has_it(moving: Scene) -> None:
    s, client = moving.look(), moving.client.number
    position, quaternion = bullet.getBasePositionAndOrientation(moving.bodies.object, client)
    linear, angular = bullet.getBaseVelocity(moving.bodies.object, client)
    np.testing.assert_array_equal(s.position, position)
    np.testing.assert_allclose(s.rotation, Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(s.linear, linear)
    np.testing.assert_array_equal(s.angular, angular)


def test_contact_geometry_matches_bullet(moving: Scene) -> None:
    s, client = moving.look(), moving.client.number
    for finger, link in enumerate(_tip_links(moving)):
        rows = bullet.getClosestPoints(
            moving.bodies.hand, moving.bodies.object, 0.01, linkIndexA=link, physicsClientId=client
        )
        row = min(rows, key=lambda row: row[8])  # the tip's, among the shapes of its link
        np.testing.assert_allclose(s.points[finger], (np.array(row[6]) - s.position) @ s.rotation, atol=1e-6)
        np.testing.assert_allclose(s.normals[finger], -np.array(row[7]) @ s.rotation, atol=1e-5)
        np.testing.assert_allclose(s.gaps[finger], row[8], atol=1e-6)
        np.testing.assert_allclose(s.touch[finger], row[5], atol=1e-6)


def test_slip_is_the_sliding_speed_of_tip_and_surface(moving: Scene) -> None:
    client, normals = moving.client.number, np.empty((4, 3))
    moving.step(np.zeros(12))  # the grasp opens: tips and object part and slide
    s = moving.look()
    normals[:] = s.normals @ s.rotation.T
    for finger, link in enumerate(_tip_links(moving)):
        state = bullet.getLinkState(moving.bodies.hand, link, 1, 1, physicsClientId=client)
        tip = np.array(state[6]) + np.cross(state[7], s.touch[finger] - state[0])
        surface = s.linear + np.cross(s.angular, s.touch[finger] - s.position)
        relative = tip - surface
        sliding = relative - relative @ normals[finger] * normals[finger]
        assert s.slip[finger] == pytest.approx(np.linalg.norm(sliding), rel=1e-4, abs=1e-6)
    assert s.slip.max() > 1e-2


def test_slip_of_a_falling_object(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(clearance=0.02)
    for _ in range(10):
        scene.step(scene.look().gravity_torques)
    np.testing.assert_allclose(scene.look().slip, 9.81 * 10 * scene.timestep, rtol=1e-3)


def test_open_fingers_keep_their_geometry(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene(clearance=0.02)
    s = scene.look()
    assert not s.touching.any()
    assert s.mask[0] == 0.0
    np.testing.assert_array_equal(s.forces, 0.0)
    np.testing.assert_allclose(s.gaps, 0.02, atol=1e-9)
    np.testing.assert_allclose(s.points, scene.config.contact_points, atol=1e-9)
    np.testing.assert_array_equal(s.normals, scene.config.contact_normals)


def test_read_once_per_step_into_the_same_buffer(held: Scene) -> None:
    s = held.look()
    assert held.look() is s
    before = s.position.copy()
    held.step(np.zeros(12))
    held.step(np.zeros(12))
    assert held.look() is s
    assert (s.position != before).any()


def test_forces_carry_the_weight(held: Scene) -> None:
    s, weight = held.look(), held.config.weight
    total = s.rotation @ s.forces.sum(axis=0)
    np.testing.assert_allclose(total, -weight, atol=0.01 * np.linalg.norm(weight))
    assert s.touching.all()
    assert s.mask[0] == 0b1111
    assert s.stray[0] == 0.0
    assert (np.einsum("ni,ni->n", s.forces, s.normals) > 1.0).all()


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
    assert np.linalg.norm(Rotation.from_matrix(s.rotation).as_rotvec()) > 0.02
    # the wrench is given in the object frame, gravity in the world's
    total = s.forces.sum(axis=0) + wrench[:3] + held.config.weight @ s.rotation
    np.testing.assert_allclose(total, 0.0, atol=2e-3)
    moment = np.cross(s.points, s.forces).sum(axis=0) + wrench[3:]
    np.testing.assert_allclose(moment, 0.0, atol=2e-4)


@pytest.mark.parametrize("angle", range(0, 360, 45))
def test_friction_cone_is_round_and_not_squared(
    make_scene: Callable[..., Scene], make_holder: Callable, to_torques: Callable, angle: float
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
        scene.step(to_torques(scene, squeeze + spring), push * direction)
        s = scene.look()
        if s.slip.min() > 1e-3:
            normal = np.einsum("ni,ni->n", s.forces, s.normals)
            tangential = np.linalg.norm(s.forces - normal[:, None] * s.normals, axis=1)
            ratios.append(tangential / normal)
    assert push > 4.6
    np.testing.assert_allclose(np.median(ratios, axis=0), 0.4, rtol=0.03)


class Reading:
    """A reading of the server made up by hand: the reference grasp at rest, with contact rows of choice."""

    def __init__(self, scene: Scene) -> None:
        s = scene.look()
        self.scene, self.links = scene, _tip_links(scene)
        self.numbers = np.concatenate([s.angles, s.rates, np.zeros(6), [1.0], np.zeros(6)])
        self.surface = ObjectDescription().surface
        self.fingers = scene.finger_of_link
        self.touch = s.touch.copy()

    def row(
        self, link: int, point: np.ndarray, normal: float, friction: tuple[float, float] = (0.0, 0.0)
    ) -> np.ndarray:
        """Bullet's normal +z (on the object), friction directions x and y."""
        return np.array(
            [link, *point, normal, 0.0, 0.0, 1.0, friction[0], 1.0, 0.0, 0.0, friction[1], 0.0, 1.0, 0.0], dtype=float
        )

    def look(self, *rows: np.ndarray) -> Snapshot:
        buffer = np.full(snapshot_size(4, 12), 7.0)
        observe(
            self.scene.tree_numbers, self.scene.tree_indices, *self.surface, np.array([0.0, -9.81, 0.0]),
            np.concatenate([self.numbers, *rows]), self.fingers, buffer,
        )  # fmt: skip
        return split(buffer, 4, 12)


@pytest.fixture
def reading(make_scene: Callable[..., Scene]) -> Reading:
    made = Reading(make_scene())
    assert len(made.numbers) == 24 + BODY
    assert len(made.row(0, np.zeros(3), 0.0)) == ROW
    return made


def test_contacts_of_a_tip_add_up(reading: Reading) -> None:
    """Force on the object = -(normal force * normal + friction * direction), by the order in which bodies are loaded."""
    link, at = reading.links[2], reading.touch[2]
    s = reading.look(reading.row(link, at, 2.0, (0.5, 0.0)), reading.row(link, at + 1e-4, 1.0, (0.0, -0.25)))
    np.testing.assert_allclose(s.forces[2], [-0.5, 0.25, -3.0])
    np.testing.assert_array_equal(s.forces[[0, 1, 3]], 0.0)
    np.testing.assert_array_equal(s.touching, [0.0, 0.0, 1.0, 0.0])
    assert s.mask[0] == 0b0100
    assert s.stray[0] == 0.0
    assert s.valid[0] == 1.0


def test_other_parts_of_the_hand_are_stray(reading: Reading) -> None:
    beside = reading.touch[1] + np.array([0.0, 1.1 * STRAY_DISTANCE, 0.0])  # the tip's link, not its tip
    other = next(link for link in range(12) if link not in reading.links)
    rows = [reading.row(reading.links[1], beside, 3.0, (4.0, 0.0)), reading.row(other, reading.touch[1], 1.0)]
    s = reading.look(*rows, reading.row(-1, reading.touch[1], 2.0))  # -1 is the palm
    assert s.stray[0] == pytest.approx(5.0 + 1.0 + 2.0)
    np.testing.assert_array_equal(s.forces, 0.0)
    assert not s.touching.any()


def test_a_contact_without_force_does_not_touch(reading: Reading) -> None:
    s = reading.look(reading.row(reading.links[0], reading.touch[0], 0.0))
    assert not s.touching.any()
    assert s.valid[0] == 1.0


def test_numbers_that_are_none_are_not_valid(reading: Reading) -> None:
    assert reading.look().valid[0] == 1.0
    for place in range(len(reading.numbers)):
        for bad in (np.nan, np.inf, -np.inf):
            kept = reading.numbers[place]
            reading.numbers[place] = bad
            assert reading.look().valid[0] == 0.0, place
            reading.numbers[place] = kept
    for place in range(4, ROW):
        row = reading.row(reading.links[0], reading.touch[0], 1.0, (0.1, 0.1))
        row[place] = np.nan
        assert reading.look(row).valid[0] == 0.0, place
    reading.numbers[25] = 11.0  # [m]: far away
    assert reading.look().valid[0] == 0.0


def test_a_link_that_pushes_the_object_is_seen(make_scene: Callable[..., Scene]) -> None:
    """The straight thumb swings against a low box: its link arrives at the lower edge, its tip is further down."""
    points = ((0.0, 0.0, -0.05), (0.0, 0.02, 0.05), (-0.03, -0.01, 0.05), (0.03, -0.01, 0.05))
    scene = make_scene(
        size=(0.1, 0.06, 0.1), contact_points=points, clearance=0.02, gravity=(0.0, 0.0, 0.0), physics_rate=1000.0
    )
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
