"""Hands are placed around objects: fingers of few joints, coupled ones, pinches; what is chosen is reachable, clear and repeatable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hands import gripper

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.grasp import Grasp
from grasp_env.quality import force_closure
from grasp_env.sim import HANDS, HandDescription, HandKinematics, ObjectDescription, place_hand
from grasp_env.sim.config import START_CLEARANCE
from grasp_env.sim.grasping.placing import _placed
from grasp_env.sim.grasping.points import FRICTION_MARGIN, GraspPlan, plan_grasp
from grasp_env.sim.hand.description import Geometry, Palm
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs

CUBE = ObjectDescription("cuboid", (0.05, 0.05, 0.05), mass=0.15, friction=0.7)
BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)


def check(hand: HandDescription, item: ObjectDescription) -> GraspPlan:
    """What a plan promises: tips touch, start clear, within the joints' limits, nothing else touches."""
    kinematics = HandKinematics(hand)
    plan = plan_grasp(item, kinematics)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(hand), kinematics.home, touching_pairs(hand))
    for angles, wanted in ((plan.angles, 0.0), (plan.start, START_CLEARANCE)):
        tips = kinematics.tips(angles)
        gaps = [item.surface.nearest(tip)[2] - radius for tip, radius in zip(tips, kinematics.tip_radii, strict=True)]
        np.testing.assert_allclose(gaps, wanted, atol=2e-5)  # bisection; backed off along a curve, 3 mm are 3 mm
        assert (angles >= kinematics.lower - 1e-9).all()
        assert (angles <= kinematics.upper + 1e-9).all()
        np.testing.assert_allclose(kinematics.coupled(angles), angles, atol=1e-12)
        away, apart = limbs.clearance(item.surface, angles)
        assert away > 1e-4
        assert apart > 1e-4
    touch = kinematics.tips(plan.angles) + kinematics.tip_radii[:, None] * plan.normals
    np.testing.assert_allclose(touch, plan.points, atol=1e-6)
    if item.torsional_friction == 0.0:
        grasp = Grasp.from_contacts(plan.points, plan.normals, FRICTION_MARGIN * item.friction * hand.tip_friction)
        assert force_closure(grasp).closed
    return plan


@pytest.mark.parametrize("item", [CUBE, BALL], ids=["cube", "ball"])
@pytest.mark.parametrize(
    ("fingers", "joints", "coupled"), [(3, 1, False), (3, 2, False), (4, 2, True), (3, 3, False), (4, 3, True)]
)
def test_planar_and_coupled_fingers(fingers: int, joints: int, coupled: bool, item: ObjectDescription) -> None:
    hand = gripper(fingers, joints, coupled)
    assert not any(core.HandLimbs.make(HandKinematics(hand).tree, [], np.array(hand.home)).free)
    check(place_hand(hand, item), item)


@pytest.mark.parametrize("name", HANDS)
def test_hands_that_are_known(name: str) -> None:
    hand = replace(HANDS[name](), placed=False)
    for item in (CUBE, BALL):
        placed = place_hand(hand, item)
        assert placed.placed
        check(placed, item)


def test_two_fingers_pinch_with_soft_contacts() -> None:
    hand = gripper(2, 2)
    soft = replace(BALL, torsional_friction=0.004)
    plan = check(place_hand(hand, soft), soft)
    assert plan.normals[0] @ plan.normals[1] < -0.9
    for least in (None, 2):
        with pytest.raises(
            InvalidInputError, match=r"no palm pose was found.* soft contacts only.* torsional_friction \[m\], 0.0056 "
        ):
            place_hand(hand, BALL, least=least)


def test_seeds() -> None:
    """The result does not depend on where the hand was."""
    hand = gripper(3, 2)
    moved = hand.moved((1.0, -2.0, 0.5), (0.3, 2.0, -1.0))
    assert place_hand(hand, BALL, seed=1) == place_hand(hand, replace(BALL), seed=1)
    check(place_hand(moved, BALL), BALL)
    first = place_hand(hand, CUBE, seed=2)
    _placed.cache_clear()
    assert place_hand(hand, CUBE, seed=2) == first
    assert place_hand(hand, CUBE, seed=3) != first


def test_fingers_that_find_no_place_are_left_out() -> None:
    hand = gripper(4, 2)
    # the last finger stays open
    links = (*hand.links[:6], replace(hand.links[6], upper=-0.5), replace(hand.links[7], upper=0.1))
    placed = place_hand(replace(hand, links=links, home=()), BALL)
    assert placed.finger_names == ("f0", "f1", "f2")
    assert placed.joint_count == 8
    check(placed, BALL)
    with pytest.raises(InvalidInputError, match="no palm pose was found"):
        place_hand(replace(hand, links=links, home=()), BALL, least=4)


def widened(hand: HandDescription, lower: float, upper: float) -> HandDescription:
    """The hand with other ranges of all joints."""
    return replace(hand, home=(), links=tuple(replace(link, lower=lower, upper=upper) for link in hand.links))


@pytest.mark.parametrize("item", [CUBE, BALL], ids=["cube", "ball"])
@pytest.mark.parametrize(("lower", "upper"), [(0.0, np.pi), (-np.pi, np.pi)])
def test_joints_that_turn_farther_than_fingers_do(lower: float, upper: float, item: ObjectDescription) -> None:
    """Nearly all postures are folded ones: three joints of each finger turn by up to a turn."""
    check(place_hand(widened(gripper(3, 3), lower, upper), item), item)


def test_more_fingers_touch_where_they_hold_as_well() -> None:
    hand = replace(HANDS["allegro"](), placed=False)
    assert [place_hand(hand, item).finger_count for item in (CUBE, BALL)] == [4, 4]


def test_fingers_that_never_face_each_other_are_named() -> None:
    hand = gripper(3, 2)
    aside = replace(hand, links=tuple(replace(link, lower=-0.6, upper=-0.5) for link in hand.links), home=())
    with pytest.raises(InvalidInputError, match=r"No two of its fingers \(f0, f1, f2\) face each other"):
        place_hand(aside, BALL)
    # the third one bends outwards
    away = replace(
        hand, home=(), links=(*hand.links[:4], *(replace(link, lower=-0.6, upper=-0.5) for link in hand.links[4:]))
    )
    with pytest.raises(InvalidInputError, match=r"these fingers never face each other: f0 and f2; f1 and f2. Use"):
        place_hand(away, BALL, least=3)


def test_wide_ranges_are_named_where_nothing_is_found() -> None:
    large = ObjectDescription("sphere", (0.4,))
    with pytest.raises(
        InvalidInputError, match=r"more than 2.5 rad .*: f0_0_joint, f0_1_joint, .*f2_1_joint; .* joint_limits={joint: "
    ):
        place_hand(widened(gripper(3, 2), -np.pi, np.pi), large)


def test_weak_joints_are_asked_for_less() -> None:
    """With torque limits that count, the choice takes less of them than the choice that only forces decide."""
    four = HANDS["four_finger"]()
    weak = replace(four, links=tuple(replace(link, torque_limit=0.15) for link in four.links))

    def torque(plan: GraspPlan) -> float:
        """Largest torque per newton along the normals, the lever that grasps differ by."""
        kinematics = HandKinematics(four)
        levers = [kinematics.jacobian(plan.angles, finger).T @ plan.normals[finger] for finger in range(4)]
        return float(np.abs(levers).max())

    rng = np.random.default_rng(3)
    strong_sum = weak_sum = 0.0
    for _ in range(6):
        item = ObjectDescription("cuboid", tuple(rng.uniform(0.06, 0.1, 3).tolist()), mass=0.1, friction=0.8)
        strong_sum += torque(plan_grasp(item, HandKinematics(four)))
        plan = plan_grasp(item, HandKinematics(weak))
        weak_sum += torque(plan)
        assert plan.force > plan_grasp(item, HandKinematics(four)).force  # torques count on top
    assert weak_sum < strong_sum


@pytest.mark.parametrize(
    ("hand", "item", "message"),
    [
        (gripper(3, 2), ObjectDescription("sphere", (0.4,)), "surround it at 0 places.*none is left"),
        (gripper(3, 2), ObjectDescription("sphere", (0.06,), friction=0.002), "without force closure"),
        (gripper(2, 1), BALL, "no palm pose was found in which the hand 'gripper' grasps the sphere"),
    ],
)
def test_what_cannot_be_held_is_said(hand: HandDescription, item: ObjectDescription, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        place_hand(hand, item)
    away = gripper(3, 2).moved((0.0, 0.5, 0.0))
    with pytest.raises(InvalidInputError, match=r"finds no place on it; of all places tried .*\d+ out of reach"):
        plan_grasp(BALL, HandKinematics(away))


def test_links_that_always_touch() -> None:
    hand = gripper(3, 3)
    assert touching_pairs(hand, at_home=False) == ()
    thick = Geometry("box", (0.14, 0.02, 0.12), (0.0, 0.0, 0.05))  # over the next link and the one after it
    links = (replace(hand.links[0], collision=(thick,)), *hand.links[1:])
    assert (0, 2) in touching_pairs(replace(hand, links=links))
    straight, bent = replace(hand, home=(0.0,) * 9), replace(hand, home=(0.3, 0.6, 0.6) * 3)
    assert touching_pairs(straight) == ()
    assert touching_pairs(bent) == ((2, 5), (2, 8), (5, 8))  # bent alike, the last links meet


def test_boxes_are_solid() -> None:
    """A tip in the middle of a box, between what were its lines, overlaps it."""
    hand = gripper(3, 2)
    box = Palm(collision=(Geometry("box", (0.3, 0.3, 0.3), (0.0, 0.0, 0.0)),))
    kinematics = HandKinematics(replace(hand, palm=box))
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
    item = ObjectDescription("sphere", (0.02,))
    away, apart = limbs.clearance(item.surface, kinematics.home)
    assert away == pytest.approx(-0.16, abs=2e-6)  # the ball's centre is 150 mm deep, its radius 10 mm more
    assert apart < 0.0
