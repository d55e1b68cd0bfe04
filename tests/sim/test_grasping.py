"""Placed hands, planned grasps, and checks of given contacts."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from engines import Client, bullet, create_body, joint_indices, needs_bullet
from episodes import random_object
from hands import gripper, load_hand
from numpy.testing import assert_allclose, assert_array_equal

from grasp_env import core
from grasp_env.errors import InfeasibleWrenchError, InvalidInputError
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.grasp.presets import paper_cuboid
from grasp_env.quality import force_closure
from grasp_env.sim import HANDS, HandDescription, HandKinematics, ObjectDescription, place_hand
from grasp_env.sim.config import START_CLEARANCE
from grasp_env.sim.grasping.approach import DEVIATION, Approach, as_approach
from grasp_env.sim.grasping.placing import _never_facing, _placed, _wide_joints
from grasp_env.sim.grasping.points import (
    FRICTION_MARGIN,
    GraspPlan,
    check_points,
    grasp_points,
    plan_grasp,
)
from grasp_env.sim.grasping.trials import Candidate, Trials
from grasp_env.sim.hand.description import Geometry
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH

FOUR = HANDS["four_finger"]()
GRIPPER = gripper(3, 2)
CUBE = ObjectDescription("cuboid", (0.05, 0.05, 0.05), mass=0.15, friction=0.7)
BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)


def check(hand: HandDescription, item: ObjectDescription) -> GraspPlan:
    """The promises of a plan: tips touch far from edges, the start is clear, joints are within
    limits, nothing else touches."""
    kinematics = HandKinematics(hand)
    plan = plan_grasp(item, kinematics)
    points, normals = grasp_points(item, kinematics)
    assert_array_equal([points, normals], [plan.points, plan.normals])
    on, inward = check_points(item, points, normals)
    assert_allclose(points, on, atol=1e-9)
    assert_allclose(normals, inward, atol=1e-6)
    half = 0.5 * np.array(item.extent)
    edge = {0.003: 0.005, 0.0015: 0.003, 0.0005: 0.001}[plan.clearance]
    if item.shape == "cuboid":
        assert (np.sort(half - np.abs(points), axis=1)[:, 1] > 0.97 * edge).all()
    if item.shape == "cylinder":
        side = np.hypot(points[:, 0], points[:, 2])
        on_side = np.abs(side - half[0]) < 1e-9
        assert (
            np.where(on_side, half[1] - np.abs(points[:, 1]), half[0] - side) > 0.97 * edge
        ).all()
    limbs = core.HandLimbs.make(
        kinematics.tree, hand_limbs(hand), kinematics.home, touching_pairs(hand)
    )
    for angles, wanted in ((plan.angles, 0.0), (plan.start, START_CLEARANCE)):
        tips = kinematics.tips(angles)
        gaps = [
            item.surface.nearest(tip)[2] - radius
            for tip, radius in zip(tips, kinematics.tip_radii, strict=True)
        ]
        assert_allclose(gaps, wanted, atol=2e-5)  # bisection
        assert (angles >= kinematics.lower - 1e-9).all()
        assert (angles <= kinematics.upper + 1e-9).all()
        assert_allclose(kinematics.coupled(angles), angles, atol=1e-12)
        assert min(limbs.clearance(item.surface, angles)) > 1e-4
    touch = kinematics.tips(plan.angles) + kinematics.tip_radii[:, None] * plan.normals
    assert_allclose(touch, plan.points, atol=1e-6)
    if item.torsional_friction == 0.0:
        grasp = Grasp.from_contacts(
            plan.points, plan.normals, FRICTION_MARGIN * item.friction * hand.tip_friction
        )
        assert force_closure(grasp).closed
    return plan


def worst(
    item: ObjectDescription, plan: GraspPlan, friction_margin: float = FRICTION_MARGIN
) -> float:
    """Largest least normal force for weight with a push or turn [N]; infinite if there is none."""
    grasp = Grasp.from_contacts(plan.points, plan.normals, friction_margin * item.friction)
    optimizer = ForceOptimizer(grasp, method="conic")
    steps = np.diag([2.0, 2.0, 2.0, 0.06, 0.06, 0.06])
    weight = np.array([0.0, -9.81 * item.mass, 0.0, 0.0, 0.0, 0.0])
    try:
        return max(
            optimizer.solve(weight + sign * step).objective
            for step in steps
            for sign in (1.0, -1.0)
        )
    except InfeasibleWrenchError:
        return np.inf


def test_contacts_planned_for_a_narrow_margin_hold_within_it():
    """Those planned for the default share of the friction often do not, or need more force."""
    hand = HandKinematics(HandDescription.four_finger())
    rng = np.random.default_rng(7)
    forces = []
    for diameter in rng.uniform(0.06, 0.11, 12):
        item = ObjectDescription("sphere", (diameter,), friction=0.4)
        default, narrow = plan_grasp(item, hand), plan_grasp(item, hand, friction_margin=0.4)
        forces.append([worst(item, plan, 0.4) for plan in (default, narrow)])
    of_default, of_narrow = np.array(forces).T
    assert np.isinf(of_default).sum() >= 2
    assert (of_narrow < 25.0).all()


@pytest.mark.parametrize("margin", [0.0, 1.01, np.nan, "half"])
def test_a_margin_is_a_share(margin):
    item, hand = ObjectDescription("sphere"), HandDescription.four_finger()
    with pytest.raises(InvalidInputError, match="friction_margin"):
        plan_grasp(item, HandKinematics(hand), friction_margin=margin)
    with pytest.raises(InvalidInputError, match="friction_margin"):
        place_hand(hand, item, friction_margin=margin)


def test_the_error_names_the_margin():
    item = ObjectDescription("sphere", (0.08,), friction=0.001)
    with pytest.raises(InvalidInputError, match=r"with 0\.5 of its friction 0\.001"):
        plan_grasp(item, HandKinematics(HandDescription.four_finger()), friction_margin=0.5)


@pytest.mark.parametrize("name", ["four_finger", "three_finger", "five_finger"])
def test_random_objects_are_grasped(name):
    rng = np.random.default_rng(5)
    forces = []
    for shape in 4 * SHAPES_WITHOUT_MESH:
        item = random_object(rng, shapes=[shape])
        forces.append(worst(item, check(HANDS[name](), item)))
    assert np.median(forces) < 15.0 or name != "four_finger"
    assert max(forces) < 60.0


def test_the_reference_grasp_and_random_generators():
    hand = HandKinematics(FOUR)
    points, normals = grasp_points(ObjectDescription(), hand)
    assert_array_equal(points, paper_cuboid().positions)
    assert_array_equal(normals, paper_cuboid().normals)
    usual, again = (
        grasp_points(ObjectDescription("cylinder", (0.08, 0.1)), hand)[0] for _ in range(2)
    )
    first, same = (
        grasp_points(ObjectDescription(), hand, np.random.default_rng(3))[0] for _ in range(2)
    )
    assert_array_equal(usual, again)
    assert_array_equal(first, same)
    assert not np.array_equal(first, points)


@needs_bullet
def test_bullet_sees_no_other_contact():
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


NOT_HELD = [
    (ObjectDescription("cuboid", (0.3, 0.3, 0.3)), FOUR, "into the palm"),
    (ObjectDescription("cuboid", (0.08, 0.08, 0.08), friction=0.001), FOUR, "raise the friction"),
    (ObjectDescription("sphere"), replace(FOUR, fingertips=FOUR.fingertips[:2]), "more fingers"),
    (
        ObjectDescription("sphere", (0.05,)),
        FOUR.moved((0.0, 0.3, 0.0)),
        r"'thumb' finds no contact on it.*\d+ out of reach",
    ),
]


@pytest.mark.parametrize(
    ("item", "hand", "message"), NOT_HELD, ids=["large", "slippery", "two fingers", "far"]
)
def test_objects_that_cannot_be_held(item, hand, message):
    with pytest.raises(InvalidInputError, match=message):
        grasp_points(item, HandKinematics(hand))


def test_given_points_are_moved_to_the_surface():
    box = ObjectDescription()
    points, normals = check_points(box, [[0.0, 0.01, 0.05005]])
    assert_allclose(points, [[0.0, 0.01, 0.05]])
    assert_allclose(normals, [[0.0, 0.0, -1.0]])
    for normal in ([-1.0, 0.0, -1.0], [0.0, 0.0, -1.0]):  # on an edge
        _, (unit,) = check_points(box, [[0.05, 0.01, 0.05]], [normal])
        assert_allclose(unit, np.array(normal) / np.linalg.norm(normal))


@pytest.mark.parametrize(
    ("point", "normal", "message"),
    [
        ([0.0, 0.0, 0.02], None, "30.00 mm inside"),
        ([0.0, 0.0, 0.06], None, "10.00 mm outside"),
        ([0.0, 0.0, 0.05], [0.0, 0.0, 1.0], "inward normal"),
        ([0.0, 0.0, 0.05], [0.0, 0.1, -1.0], "inward normal"),
        ([0.0, 0.0, 0.05], [0.0, 0.0, 0.0], "must not be zero"),
    ],
)
def test_invalid_points(point, normal, message):
    with pytest.raises(InvalidInputError, match=message):
        check_points(ObjectDescription("sphere"), [point], None if normal is None else [normal])


@pytest.mark.parametrize(
    ("fingers", "joints", "coupled", "item"),
    [(3, 1, False, CUBE), (3, 2, False, BALL), (4, 2, True, BALL), (4, 3, True, CUBE)],
)
def test_planar_and_coupled_fingers(fingers, joints, coupled, item):
    hand = gripper(fingers, joints, coupled)
    assert not any(core.HandLimbs.make(HandKinematics(hand).tree, [], np.array(hand.home)).free)
    check(place_hand(hand, item).hand, item)


@pytest.mark.parametrize(
    ("name", "item"), [("four_finger_4dof", BALL), ("five_finger", CUBE), ("allegro", CUBE)]
)
def test_known_hands(name, item):
    placed = place_hand(replace(HANDS[name](), placed=False), item).hand
    assert placed.placed
    # more fingers touch where they hold as well
    assert placed.finger_count >= (4 if name == "allegro" else 3)
    check(placed, item)


def test_seeds_and_places():
    """The result depends on the seed, but a grasp is found wherever the hand was."""
    hand = gripper(3, 2)
    first = place_hand(hand, BALL, seed=2).hand
    _placed.cache_clear()
    assert place_hand(hand, replace(BALL), seed=2).hand == first
    moved = hand.moved((1.0, -2.0, 0.5), (0.3, 2.0, -1.0))
    check(place_hand(moved, BALL, seed=3).hand, BALL)
    assert place_hand(hand, BALL, seed=3).hand != first


def test_fingers_that_find_no_contact_are_left_out():
    hand = gripper(4, 2)
    # the last finger stays open
    links = (*hand.links[:6], replace(hand.links[6], upper=-0.5), replace(hand.links[7], upper=0.1))
    hand = replace(hand, links=links, home=())
    placed = place_hand(hand, BALL).hand
    assert placed.finger_names == ("f0", "f1", "f2")
    assert placed.joint_count == 8
    check(placed, BALL)


def ranged(hand: HandDescription, lower: float, upper: float) -> HandDescription:
    """The hand with other ranges of its joints."""
    return replace(
        hand, home=(), links=tuple(replace(link, lower=lower, upper=upper) for link in hand.links)
    )


def test_joints_with_wide_ranges():
    """Nearly all postures are folded: three joints of each finger turn by up to a turn."""
    check(place_hand(ranged(gripper(3, 3), -np.pi, np.pi), BALL).hand, BALL)


def test_advice_on_fingers_and_joints():
    with pytest.raises(InvalidInputError, match="least must"):
        place_hand(GRIPPER, BALL, least=4)
    faced = ~np.eye(3, dtype=bool)
    assert (_never_facing(GRIPPER, faced), _wide_joints(GRIPPER)) == ("", "")
    faced[:, 2] = faced[2] = False
    assert "never face each other: f0 and f2; f1 and f2. " in _never_facing(GRIPPER, faced)
    assert "No two of its fingers (f0, f1, f2) face each other" in _never_facing(
        GRIPPER, faced & False
    )
    advice = r"more than 2.5 rad .*: f0_0_joint, f0_1_joint, .*f2_1_joint; .* joint_limits={"
    assert re.search(advice, _wide_joints(ranged(GRIPPER, -np.pi, np.pi)))


def test_directions_of_approach():
    rng = np.random.default_rng(0)
    for wanted, axis in (
        ("down", (0.0, -1.0, 0.0)),
        ("up", (0.0, 1.0, 0.0)),
        ((3.0, 0.0, 4.0), (0.6, 0.0, 0.8)),
    ):
        approach = Approach(as_approach(wanted, "approach"))
        assert_allclose(approach.draw(rng), axis, atol=1e-12)
        assert approach.allows(np.array(axis))
        assert not approach.allows(-np.array(axis))
    for height in (-1.0, -0.6, -0.4, 0.0, 0.4, 0.6, 1.0):
        direction = np.array(
            [0.8 * np.sqrt(1.0 - height**2), height, 0.6 * np.sqrt(1.0 - height**2)]
        )
        assert Approach("side").allows(direction) == (abs(np.arcsin(height)) <= DEVIATION)
    assert abs(Approach("side").draw(rng)[1]) == 0.0


def test_idle_fingers_make_a_grasp_worse():
    hand = HANDS["four_finger"]()
    more = replace(hand.fingertips[0], name="idle", link=hand.links[0].name)
    idle = replace(hand, fingertips=(*hand.fingertips, more))
    candidate = Candidate((0, 1, 2, 3), np.array(hand.home), np.eye(3), np.zeros(3))
    one, other = (
        Trials(each, ObjectDescription("sphere", (0.09,)), FRICTION_MARGIN).rating(candidate)
        for each in (hand, idle)
    )
    assert other == pytest.approx(1.3 * one)


def test_links_that_always_touch():
    hand = gripper(3, 3)
    assert touching_pairs(hand, at_home=False) == ()
    # over the next link and the one after it
    thick = Geometry("box", (0.14, 0.02, 0.12), (0.0, 0.0, 0.05))
    assert (0, 2) in touching_pairs(
        replace(hand, links=(replace(hand.links[0], collision=(thick,)), *hand.links[1:]))
    )
    straight = replace(hand, home=(0.0,) * 9)
    bent = replace(hand, home=(0.3, 0.6, 0.6) * 3)
    assert touching_pairs(straight) == ()
    assert touching_pairs(bent) == ((2, 5), (2, 8), (5, 8))  # bent alike, the last links meet
