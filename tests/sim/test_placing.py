"""Placing of hands around objects: the planned grasp is reachable, clear, closed and repeatable."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hands import gripper

from grasp_env import core
from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.grasp import Grasp
from grasp_env.quality import force_closure
from grasp_env.sim import HANDS, HandDescription, HandKinematics, ObjectDescription, place_hand
from grasp_env.sim.config import START_CLEARANCE
from grasp_env.sim.grasping.approach import DEVIATION, Approach, as_approach
from grasp_env.sim.grasping.pads import torsion_of
from grasp_env.sim.grasping.placing import _Candidate, _never_facing, _placed, _Trials, _wide_joints
from grasp_env.sim.grasping.points import FRICTION_MARGIN, GraspPlan, plan_grasp
from grasp_env.sim.hand.description import Geometry, Palm
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs

CUBE = ObjectDescription("cuboid", (0.05, 0.05, 0.05), mass=0.15, friction=0.7)
BALL = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)


def check(hand: HandDescription, item: ObjectDescription) -> GraspPlan:
    """The promises of a plan: tips touch, the start is clear, joints are within limits, nothing else touches."""
    kinematics = HandKinematics(hand)
    plan = plan_grasp(item, kinematics)
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(hand), kinematics.home, touching_pairs(hand))
    for angles, wanted in ((plan.angles, 0.0), (plan.start, START_CLEARANCE)):
        tips = kinematics.tips(angles)
        gaps = [item.surface.nearest(tip)[2] - radius for tip, radius in zip(tips, kinematics.tip_radii, strict=True)]
        np.testing.assert_allclose(gaps, wanted, atol=2e-5)  # bisection
        assert (angles >= kinematics.lower - 1e-9).all()
        assert (angles <= kinematics.upper + 1e-9).all()
        np.testing.assert_allclose(kinematics.coupled(angles), angles, atol=1e-12)
        assert min(limbs.clearance(item.surface, angles)) > 1e-4
    touch = kinematics.tips(plan.angles) + kinematics.tip_radii[:, None] * plan.normals
    np.testing.assert_allclose(touch, plan.points, atol=1e-6)
    if item.torsional_friction == 0.0:
        grasp = Grasp.from_contacts(plan.points, plan.normals, FRICTION_MARGIN * item.friction * hand.tip_friction)
        assert force_closure(grasp).closed
    return plan


@pytest.mark.parametrize(
    ("fingers", "joints", "coupled", "item"),
    [(3, 1, False, CUBE), (3, 2, False, BALL), (4, 2, True, BALL), (4, 3, True, CUBE)],
)
def test_planar_and_coupled_fingers(fingers: int, joints: int, coupled: bool, item: ObjectDescription) -> None:
    hand = gripper(fingers, joints, coupled)
    assert not any(core.HandLimbs.make(HandKinematics(hand).tree, [], np.array(hand.home)).free)
    check(place_hand(hand, item), item)


@pytest.mark.parametrize(
    ("name", "item"), [("four_finger_4dof", BALL), ("five_finger", CUBE), ("allegro", CUBE), ("allegro", BALL)]
)
def test_known_hands(name: str, item: ObjectDescription) -> None:
    placed = place_hand(replace(HANDS[name](), placed=False), item)
    assert placed.placed
    assert placed.finger_count >= (4 if name == "allegro" else 3)  # more fingers touch where they hold as well
    check(placed, item)


def test_two_fingers_pinch_with_soft_contacts() -> None:
    hand, soft = gripper(2, 2), replace(BALL, torsional_friction=0.004)
    plan = check(place_hand(hand, soft), soft)
    assert plan.normals[0] @ plan.normals[1] < -0.9
    message = r"no palm pose was found.* soft contacts only.* torsional_friction \[m\], 0.0056 "
    with pytest.raises(InvalidInputError, match=message):
        place_hand(hand, BALL)
    assert torsion_of(0.7) == pytest.approx(2.0 / 3.0 * 0.7 * 0.012)


def test_seeds_and_places() -> None:
    """The result depends on the seed, but a grasp is found wherever the hand was."""
    hand = gripper(3, 2)
    first = place_hand(hand, BALL, seed=2)
    _placed.cache_clear()
    assert place_hand(hand, replace(BALL), seed=2) == first
    moved = hand.moved((1.0, -2.0, 0.5), (0.3, 2.0, -1.0))
    check(place_hand(moved, BALL, seed=3), BALL)
    assert place_hand(hand, BALL, seed=3) != first


def test_fingers_that_find_no_contact_are_left_out() -> None:
    hand = gripper(4, 2)
    # the last finger stays open
    links = (*hand.links[:6], replace(hand.links[6], upper=-0.5), replace(hand.links[7], upper=0.1))
    hand = replace(hand, links=links, home=())
    placed = place_hand(hand, BALL)
    assert placed.finger_names == ("f0", "f1", "f2")
    assert placed.joint_count == 8
    check(placed, BALL)


def ranged(hand: HandDescription, lower: float, upper: float) -> HandDescription:
    """The hand with other ranges of its joints."""
    return replace(hand, home=(), links=tuple(replace(link, lower=lower, upper=upper) for link in hand.links))


def test_joints_with_ranges_wider_than_fingers_have() -> None:
    """Nearly all postures are folded: three joints of each finger turn by up to a turn."""
    check(place_hand(ranged(gripper(3, 3), -np.pi, np.pi), BALL), BALL)


GRIPPER, LARGE = gripper(3, 2), ObjectDescription("sphere", (0.4,))


@pytest.mark.parametrize(
    ("hand", "item", "options", "message"),
    [
        (GRIPPER, LARGE, {}, "surround it at 0 places.*none is left"),
        (GRIPPER, BALL, {"approach": (0.0, 0.0, 0.0)}, "must have a direction"),
        (GRIPPER, BALL, {"approach": "sideways"}, "choose one of .down., .up., .side."),
        (GRIPPER, BALL, {"least": 4}, "least must"),
    ],
)  # fmt: skip
def test_hands_that_cannot_be_placed(
    hand: HandDescription, item: ObjectDescription, options: dict, message: str
) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        place_hand(hand, item, **options)


def test_advice_on_fingers_and_joints() -> None:
    faced = ~np.eye(3, dtype=bool)
    assert (_never_facing(GRIPPER, faced), _wide_joints(GRIPPER)) == ("", "")
    faced[:, 2] = faced[2] = False
    assert "never face each other: f0 and f2; f1 and f2. " in _never_facing(GRIPPER, faced)
    assert "No two of its fingers (f0, f1, f2) face each other" in _never_facing(GRIPPER, faced & False)
    advice = r"more than 2.5 rad .*: f0_0_joint, f0_1_joint, .*f2_1_joint; .* joint_limits={"
    assert re.search(advice, _wide_joints(ranged(GRIPPER, -np.pi, np.pi)))


def test_directions_of_approach() -> None:
    rng = np.random.default_rng(0)
    for wanted, axis in (("down", (0.0, -1.0, 0.0)), ("up", (0.0, 1.0, 0.0)), ((3.0, 0.0, 4.0), (0.6, 0.0, 0.8))):
        approach = Approach(as_approach(wanted, "approach"))
        np.testing.assert_allclose(approach.draw(rng), axis, atol=1e-12)
        assert approach.allows(np.array(axis))
        assert not approach.allows(-np.array(axis))
    for height in (-1.0, -0.6, -0.4, 0.0, 0.4, 0.6, 1.0):
        direction = np.array([0.8 * np.sqrt(1.0 - height**2), height, 0.6 * np.sqrt(1.0 - height**2)])
        assert Approach("side").allows(direction) == (abs(np.arcsin(height)) <= DEVIATION)
    assert abs(Approach("side").draw(rng)[1]) == 0.0


def test_the_palm_is_on_the_wanted_side() -> None:
    placed = place_hand(GRIPPER, BALL, approach="up")
    root = HandKinematics(placed).roots.mean(axis=0)
    assert root[1] / np.linalg.norm(root) < -np.cos(DEVIATION + 0.1)  # the palm is not quite at the mean of the roots


def test_weak_joints_get_grasps_that_load_them_less() -> None:
    four = HandKinematics(HANDS["four_finger"]())
    weak = HandKinematics(replace(four.hand, links=tuple(replace(link, torque_limit=0.15) for link in four.hand.links)))

    def load(plan: GraspPlan) -> float:
        """Largest torque per newton along the normals."""
        levers = [four.jacobian(plan.angles, finger).T @ plan.normals[finger] for finger in range(4)]
        return float(np.abs(levers).max())

    rng, loads = np.random.default_rng(3), []
    for _ in range(6):
        item = ObjectDescription("cuboid", tuple(rng.uniform(0.06, 0.1, 3).tolist()), mass=0.1, friction=0.8)
        one, other = plan_grasp(item, four), plan_grasp(item, weak)
        assert other.force > one.force  # torques count, too
        loads.append((load(one), load(other)))
    assert np.diff(np.sum(loads, axis=0))[0] < 0.0


def test_a_finger_that_does_not_touch_makes_a_grasp_worse() -> None:
    hand = HANDS["four_finger"]()
    idle = replace(
        hand, fingertips=(*hand.fingertips, replace(hand.fingertips[0], name="idle", link=hand.links[0].name))
    )
    candidate = _Candidate((0, 1, 2, 3), np.array(hand.home), np.eye(3), np.zeros(3))
    one, other = (_Trials(each, ObjectDescription("sphere", (0.09,))).rating(candidate) for each in (hand, idle))
    assert other == pytest.approx(1.3 * one)


def test_links_that_always_touch() -> None:
    hand = gripper(3, 3)
    assert touching_pairs(hand, at_home=False) == ()
    thick = Geometry("box", (0.14, 0.02, 0.12), (0.0, 0.0, 0.05))  # over the next link and the one after it
    assert (0, 2) in touching_pairs(replace(hand, links=(replace(hand.links[0], collision=(thick,)), *hand.links[1:])))
    straight, bent = replace(hand, home=(0.0,) * 9), replace(hand, home=(0.3, 0.6, 0.6) * 3)
    assert touching_pairs(straight) == ()
    assert touching_pairs(bent) == ((2, 5), (2, 8), (5, 8))  # bent alike, the last links meet


def test_boxes_are_solid() -> None:
    """A ball in the middle of a box overlaps it."""
    box = Palm(collision=(Geometry("box", (0.3, 0.3, 0.3), (0.0, 0.0, 0.0)),))
    kinematics = HandKinematics(replace(GRIPPER, palm=box))
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
    away, apart = limbs.clearance(ObjectDescription("sphere", (0.02,)).surface, kinematics.home)
    assert away == pytest.approx(-0.16, abs=2e-6)  # the ball's centre is 150 mm deep, its radius is 10 mm
    assert apart < 0.0
