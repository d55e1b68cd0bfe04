"""Grasps that are found: reachable, clear, closed, as good as claimed; and points that users give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from engines import Client, bullet, create_body, joint_indices, needs_bullet
from episodes import random_object
from hands import load_hand

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.grasp.presets import paper_cuboid
from grasp_env.quality import force_closure
from grasp_env.sim import HANDS, HandDescription, HandKinematics
from grasp_env.sim.grasping.points import FRICTION_MARGIN, check_points, grasp_points
from grasp_env.sim.hand.limbs import hand_limbs
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH, ObjectDescription


@pytest.fixture(scope="module")
def hand() -> HandKinematics:
    return HandKinematics(HANDS["four_finger"]())


def worst(item: ObjectDescription, points: np.ndarray, normals: np.ndarray) -> float:
    """Largest least normal force for weight with a push or turn [N]; raises where there is none."""
    grasp = Grasp.from_contacts(points, normals, FRICTION_MARGIN * item.friction)
    assert force_closure(grasp).closed
    optimizer = ForceOptimizer(grasp, method="conic")
    steps = np.diag([2.0, 2.0, 2.0, 0.06, 0.06, 0.06])
    weight = np.array([0.0, -9.81 * item.mass, 0.0, 0.0, 0.0, 0.0])
    return max(optimizer.solve(weight + sign * step).objective for step in steps for sign in (1.0, -1.0))


def check(item: ObjectDescription, kinematics: HandKinematics, points: np.ndarray, normals: np.ndarray) -> float:
    on, inward = check_points(item, points, normals)
    np.testing.assert_allclose(points, on, atol=1e-9)
    np.testing.assert_allclose(normals, inward, atol=1e-6)
    angles = kinematics.solve(points - kinematics.tip_radii[:, None] * normals)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
    away, apart = limbs.clearance(item.surface, angles)
    assert away > 4e-4
    assert apart > 1e-4
    return worst(item, points, normals)


def test_reference_grasp_is_kept_and_a_generator_gives_its_own(hand: HandKinematics) -> None:
    points, normals = grasp_points(ObjectDescription(), hand)
    np.testing.assert_array_equal(points, paper_cuboid().positions)
    np.testing.assert_array_equal(normals, paper_cuboid().normals)
    for item in (ObjectDescription(), ObjectDescription("cylinder", (0.08, 0.1))):
        usual, again = (grasp_points(item, hand)[0] for _ in range(2))
        first, same = (grasp_points(item, hand, np.random.default_rng(3))[0] for _ in range(2))
        np.testing.assert_array_equal(usual, again)
        np.testing.assert_array_equal(first, same)
        assert not np.array_equal(first, usual)


@pytest.mark.parametrize("shape", SHAPES_WITHOUT_MESH)
def test_random_objects_are_grasped(shape: str, hand: HandKinematics) -> None:
    rng = np.random.default_rng(5)
    forces = []
    for _ in range(50):
        item = random_object(rng, shapes=[shape])
        forces.append(check(item, hand, *grasp_points(item, hand)))
    assert np.median(forces) < 15.0
    assert max(forces) < 60.0


@pytest.mark.parametrize("name", ["three_finger", "five_finger", "four_finger_4dof"])
def test_other_hands(name: str) -> None:
    kinematics, rng = HandKinematics(HANDS[name]()), np.random.default_rng(2)
    for _ in range(12):
        item = random_object(rng)
        assert check(item, kinematics, *grasp_points(item, kinematics)) < 60.0


def test_mesh_is_grasped(tmp_path: Path, hand: HandKinematics) -> None:
    path = str(tmp_path / "egg.stl")
    egg = trimesh.creation.icosphere(2, 0.045)
    egg.apply_transform(np.diag([1.0, 1.3, 0.9, 1.0]))
    egg.export(path)
    item = ObjectDescription("mesh", mesh=path)
    assert check(item, hand, *grasp_points(item, hand)) < 20.0


def test_contacts_keep_away_from_edges(hand: HandKinematics) -> None:
    rng = np.random.default_rng(8)
    for _ in range(20):
        item = random_object(rng, shapes=["cuboid", "cylinder"])
        points, _ = grasp_points(item, hand)
        half = 0.5 * np.array(item.extent)
        if item.shape == "cuboid":
            assert (np.sort(half - np.abs(points), axis=1)[:, 1] > 0.0029).all()
        else:
            side = np.hypot(points[:, 0], points[:, 2])
            on_side = np.abs(side - half[0]) < 1e-9
            assert (np.where(on_side, half[1] - np.abs(points[:, 1]), half[0] - side) > 0.0029).all()


@needs_bullet
def test_bullet_sees_no_other_contact(hand: HandKinematics) -> None:
    for shape in SHAPES_WITHOUT_MESH:
        item = ObjectDescription(shape)
        points, normals = grasp_points(item, hand)
        # with gaps of 0.2 mm at the tips nothing at all touches
        angles = hand.solve(points - (hand.tip_radii[:, None] + 2e-4) * normals)
        client = Client()
        number = client.number
        body = load_hand(number, hand.hand)
        joints = joint_indices(number, body, hand.hand)
        for joint, angle in zip(joints, angles.tolist(), strict=True):
            bullet.resetJointState(body, joint, angle, physicsClientId=number)
        held = create_body(number, item, (1.0, 1.0, 1.0))
        bullet.performCollisionDetection(physicsClientId=number)
        rows = bullet.getContactPoints(physicsClientId=number)
        assert all(row[8] > 0.0 for row in rows)
        near = {row[3] for row in bullet.getClosestPoints(body, held, 4e-4, physicsClientId=number)}
        assert near == {joints[link] for link in hand.tip_links}
        client.close()


FOUR = HANDS["four_finger"]()


@pytest.mark.parametrize(
    ("item", "hand", "message"),
    [
        (ObjectDescription("cuboid", (0.3, 0.3, 0.3)), FOUR, "into the palm"),
        (ObjectDescription("cuboid", (0.1, 0.002, 0.1)), FOUR, "cannot be grasped"),
        (ObjectDescription("cuboid", (0.08, 0.08, 0.08), friction=0.001), FOUR, "raise the friction"),
        (ObjectDescription("sphere"), replace(FOUR, fingertips=FOUR.fingertips[:2]), "more fingers"),
        (ObjectDescription("sphere", (0.05,)), FOUR.moved((0.0, 0.3, 0.0)), "'thumb' finds no place on it"),
    ],
    ids=["large", "thin", "slippery", "two fingers", "far"],
)
def test_objects_that_cannot_be_held(item: ObjectDescription, hand: HandDescription, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        grasp_points(item, HandKinematics(hand))


def test_given_points_are_checked() -> None:
    box, ball = ObjectDescription(), ObjectDescription("sphere")
    points, normals = check_points(box, [[0.0, 0.01, 0.05005]])
    np.testing.assert_allclose(points, [[0.0, 0.01, 0.05]])
    np.testing.assert_allclose(normals, [[0.0, 0.0, -1.0]])
    check_points(box, [[0.05, 0.01, 0.05]], [[-1.0, 0.0, -1.0]])  # on an edge
    check_points(box, [[0.05, 0.01, 0.05]], [[0.0, 0.0, -1.0]])
    for points, normals, message in (
        ([[0.0, 0.0, 0.06]], None, "10.00 mm outside"),
        ([[0.0, 0.0, 0.02]], None, "30.00 mm inside"),
        ([[0.0, 0.0, 0.05]], [[0.0, 0.0, 1.0]], "inward normal"),
        ([[0.0, 0.0, 0.05]], [[0.0, 0.1, -1.0]], "inward normal"),
        ([[0.0, 0.0, 0.05]], [[0.0, 0.0, 0.0]], "must not be zero"),
        ([[0.0, 0.0]], None, "shape"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            check_points(ball, points, normals)
