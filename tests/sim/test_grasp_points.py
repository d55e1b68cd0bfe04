"""Planned grasps: reachable, clear, closed, and balanced by the optimiser; checks of given contacts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
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


def worst(item: ObjectDescription, points: np.ndarray, normals: np.ndarray) -> float:
    """Largest least normal force for weight with a push or turn [N]; raises if there is none."""
    grasp = Grasp.from_contacts(points, normals, FRICTION_MARGIN * item.friction)
    assert force_closure(grasp).closed
    optimizer = ForceOptimizer(grasp, method="conic")
    steps = np.diag([2.0, 2.0, 2.0, 0.06, 0.06, 0.06])
    weight = np.array([0.0, -9.81 * item.mass, 0.0, 0.0, 0.0, 0.0])
    return max(optimizer.solve(weight + sign * step).objective for step in steps for sign in (1.0, -1.0))


def check(item: ObjectDescription, kinematics: HandKinematics) -> float:
    points, normals = grasp_points(item, kinematics)
    on, inward = check_points(item, points, normals)
    np.testing.assert_allclose(points, on, atol=1e-9)
    np.testing.assert_allclose(normals, inward, atol=1e-6)
    half = 0.5 * np.array(item.extent)
    if item.shape == "cuboid":  # 3 mm from edges
        assert (np.sort(half - np.abs(points), axis=1)[:, 1] > 0.0029).all()
    if item.shape == "cylinder":
        side = np.hypot(points[:, 0], points[:, 2])
        on_side = np.abs(side - half[0]) < 1e-9
        assert (np.where(on_side, half[1] - np.abs(points[:, 1]), half[0] - side) > 0.0029).all()
    angles = kinematics.solve(points - kinematics.tip_radii[:, None] * normals)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
    away, apart = limbs.clearance(item.surface, angles)
    assert away > 4e-4
    assert apart > 1e-4
    return worst(item, points, normals)


FOUR = HANDS["four_finger"]()


@pytest.mark.parametrize(
    ("name", "shapes"),
    [*(("four_finger", (shape,)) for shape in SHAPES_WITHOUT_MESH), ("three_finger", SHAPES_WITHOUT_MESH), ("five_finger", SHAPES_WITHOUT_MESH)],
)  # fmt: skip
def test_random_objects_are_grasped(name: str, shapes: tuple[str, ...]) -> None:
    hand, rng = HandKinematics(HANDS[name]()), np.random.default_rng(5)
    forces = [check(random_object(rng, shapes=list(shapes)), hand) for _ in range(12)]
    assert np.median(forces) < 15.0 or name != "four_finger"
    assert max(forces) < 60.0


def test_the_reference_grasp_and_random_generators() -> None:
    hand = HandKinematics(FOUR)
    points, normals = grasp_points(ObjectDescription(), hand)
    np.testing.assert_array_equal(points, paper_cuboid().positions)
    np.testing.assert_array_equal(normals, paper_cuboid().normals)
    usual, again = (grasp_points(ObjectDescription("cylinder", (0.08, 0.1)), hand)[0] for _ in range(2))
    first, same = (grasp_points(ObjectDescription(), hand, np.random.default_rng(3))[0] for _ in range(2))
    np.testing.assert_array_equal(usual, again)
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, points)


@needs_bullet
def test_bullet_sees_no_other_contact() -> None:
    hand = HandKinematics(FOUR)
    for shape in SHAPES_WITHOUT_MESH:
        item = ObjectDescription(shape)
        points, normals = grasp_points(item, hand)
        # with gaps of 0.2 mm at the tips nothing touches
        angles = hand.solve(points - (hand.tip_radii[:, None] + 2e-4) * normals)
        client = Client()
        number = client.number
        body = load_hand(number, hand.hand)
        joints = joint_indices(number, body, hand.hand)
        for joint, angle in zip(joints, angles.tolist(), strict=True):
            bullet.resetJointState(body, joint, angle, physicsClientId=number)
        held = create_body(number, item)
        bullet.performCollisionDetection(physicsClientId=number)
        assert all(row[8] > 0.0 for row in bullet.getContactPoints(physicsClientId=number))
        near = {row[3] for row in bullet.getClosestPoints(body, held, 4e-4, physicsClientId=number)}
        assert near == {joints[link] for link in hand.tip_links}
        client.close()


@pytest.mark.parametrize(
    ("item", "hand", "message"),
    [
        (ObjectDescription("cuboid", (0.3, 0.3, 0.3)), FOUR, "into the palm"),
        (ObjectDescription("cuboid", (0.1, 0.002, 0.1)), FOUR, "cannot be grasped"),
        (ObjectDescription("cuboid", (0.08, 0.08, 0.08), friction=0.001), FOUR, "raise the friction"),
        (ObjectDescription("sphere"), replace(FOUR, fingertips=FOUR.fingertips[:2]), "more fingers"),
        (
            ObjectDescription("sphere", (0.05,)),
            FOUR.moved((0.0, 0.3, 0.0)),
            r"'thumb' finds no place on it.*\d+ out of reach",
        ),
    ],
    ids=["large", "thin", "slippery", "two fingers", "far"],
)
def test_objects_that_cannot_be_held(item: ObjectDescription, hand: HandDescription, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        grasp_points(item, HandKinematics(hand))


def test_given_points_are_moved_to_the_surface() -> None:
    box = ObjectDescription()
    points, normals = check_points(box, [[0.0, 0.01, 0.05005]])
    np.testing.assert_allclose(points, [[0.0, 0.01, 0.05]])
    np.testing.assert_allclose(normals, [[0.0, 0.0, -1.0]])
    for normal in ([-1.0, 0.0, -1.0], [0.0, 0.0, -1.0]):  # on an edge
        _, (unit,) = check_points(box, [[0.05, 0.01, 0.05]], [normal])
        np.testing.assert_allclose(unit, np.array(normal) / np.linalg.norm(normal))


@pytest.mark.parametrize(
    ("point", "normal", "message"),
    [
        ([0.0, 0.0, 0.06], None, "10.00 mm outside"),
        ([0.0, 0.0, 0.02], None, "30.00 mm inside"),
        ([0.0, 0.0, 0.05], [0.0, 0.0, 1.0], "inward normal"),
        ([0.0, 0.0, 0.05], [0.0, 0.1, -1.0], "inward normal"),
        ([0.0, 0.0, 0.05], [0.0, 0.0, 0.0], "must not be zero"),
        ([0.0, 0.0], None, "shape"),
    ],
)
def test_invalid_points(point: list[float], normal: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        check_points(ObjectDescription("sphere"), [point], None if normal is None else [normal])
