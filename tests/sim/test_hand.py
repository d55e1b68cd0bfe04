"""Descriptions of hands, and the built-in hands."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hands import make_link
from scipy.integrate import trapezoid

from grasp_env import core
from grasp_env.errors import GraspError
from grasp_env.sim.hand.description import (
    HANDS,
    FingerDescription,
    Fingertip,
    Geometry,
    HandDescription,
    Palm,
)
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs

# where the fingers press on the faces of a cuboid at z = -side / 2 (the thumb) and z = side / 2 [m]
FRONT = {
    "three_finger": [(-0.025, 0.0), (0.025, 0.0)],
    "four_finger": [(0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)],
    "four_finger_4dof": [(0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)],
    "five_finger": [(-0.0125, 0.025), (0.0125, 0.025), (-0.028, -0.01), (0.028, -0.01)],
}


@pytest.mark.parametrize(
    ("name", "tip"), [("allegro", (0.0, 0.0, 0.1362)), ("leap", (0.0019, -0.0149, 0.1284))]
)
def test_real_hands_have_their_published_measures(name, tip):
    """Straight middle fingers along z; the links of a finger overlap only their neighbours."""
    hand = HANDS[name]()
    assert (hand.name, hand.placed, hand.joint_count) == (name, False, 16)
    assert hand.finger_names == ("index", "middle", "ring", "thumb")
    assert set(hand.torque_limits) == {{"allegro": 0.7, "leap": 0.95}[name]}
    np.testing.assert_allclose(HandKinematics(hand).tips(np.zeros(16))[1], tip, atol=1e-9)
    assert touching_pairs(hand, at_home=False) == ()
    assert 0.04 < max(link.mass for link in hand.links) < 0.07
    assert 0.45 < sum(link.mass for link in hand.links) < 0.65


def test_links_have_the_inertia_of_rods():
    """Compare with numerical integrals along the rods; the tip is a solid ball."""
    finger = FingerDescription("f", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    grid = np.linspace(0.0, 1.0, 501)
    for link, length, mass in zip(
        finger.links("palm"), finger.link_lengths, finger.link_masses, strict=True
    ):
        across = (
            trapezoid((length * (grid - 0.5)) ** 2, grid) * mass
            + 0.25 * mass * finger.link_radius**2
        )
        if link.name == "f_distal":
            ball = finger.tip_mass
            arm = 0.5 * length
            across += mass * ball / (mass + ball) * arm**2 + 0.4 * ball * finger.tip_radius**2
            assert link.center[0] == pytest.approx((mass * arm + ball * length) / (mass + ball))
        assert link.inertia[5] == pytest.approx(across, rel=1e-4)


@pytest.mark.parametrize("name", FRONT)
def test_hands_do_not_touch_themselves(name):
    """The postures are far from the joint limits."""
    kinematics = HandKinematics(HANDS[name]())
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
    for side in (0.07, 0.12):
        away = 0.5 * side + 0.01
        angles = kinematics.solve([(0.0, 0.0, -away), *((x, y, away) for x, y in FRONT[name])])
        assert np.minimum(angles - kinematics.lower, kinematics.upper - angles).min() > 0.4
        assert all(gap > 0.004 for _, _, gap in limbs.link_gaps(angles, 0.02))
    rng = np.random.default_rng(5)
    # a finger never meets itself, and the palm only with its folded tip
    for own in 25 * list(kinematics.carries):
        angles = np.where(own, rng.uniform(kinematics.lower, kinematics.upper), kinematics.home)
        for first, second, gap in limbs.link_gaps(angles, 0.0):
            if gap < 0.0 and own[second]:
                assert second in kinematics.tip_links if first < 0 else not own[first]


def test_a_moved_hand_moves_as_a_whole():
    hand = HandDescription.five_finger()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = hand.moved((0.1, 0.2, 0.3), (0.0, 0.0, np.pi / 2))
    expected = HandKinematics(hand).tips(hand.home) @ turn.T + (0.1, 0.2, 0.3)
    np.testing.assert_allclose(HandKinematics(moved).tips(hand.home), expected, atol=1e-15)
    np.testing.assert_allclose(moved.palm.collision[0].origin, (0.1 - 0.145, 0.2, 0.3), atol=1e-15)
    assert hand.moved((0.0, 0.0, 0.0)) == hand


TIP = Fingertip("a", "a", (0, 0, 0), 0.01)


def hand(links: Any, tips: Any = (TIP,), **fields: Any) -> HandDescription:
    return HandDescription("test", Palm(), links, tips, **fields)


def of_thumb(**fields: Any) -> HandDescription:
    return HandDescription.of_fingers([replace(THUMB, **fields)])


GOOD = make_link()
NEXT = make_link("b", "a")
THUMB = FingerDescription("good", (0.0, 0.1, 0.0), press=(0.0, 0.0, 1.0))


IMPOSSIBLE = [
    (partial(make_link, mass=0.0), r"link 'a': mass \[kg\] must be a number > 0"),
    (partial(make_link, axis=(0, 0, 2)), "axis=.* must have length 1, not 2; normalise it"),
    (partial(make_link, lower=1.0, upper=-1.0), "lower=1.0 must be below upper=-1.0"),
    (partial(make_link, inertia=(1e-5, 2e-5, 0, 1e-5, 0, 1e-5)), "all must be above 0"),
    (
        partial(make_link, inertia=(1e-5, 0, 0, 1e-5, 0, 3e-5)),
        "the largest is below the sum of the other two",
    ),
    (partial(hand, 3), "must be a list of Links"),
    (partial(hand, [3]), "got 3 in it"),
    (partial(hand, [GOOD], ()), "fingertips=.. is empty"),
    (partial(hand, [NEXT, GOOD]), "parent 'a' of link 'b' stands after it"),
    (
        partial(hand, [GOOD, make_link("b", "c")]),
        "parent 'c' of link 'b' is not a link; known are palm, a",
    ),
    (partial(hand, [GOOD, GOOD]), "two links are called 'a'"),
    (partial(hand, [GOOD, make_link("b", joint="a_joint")]), "two joints are called 'a_joint'"),
    (partial(hand, [GOOD], (TIP, TIP)), "two fingertips are called 'a'"),
    (
        partial(hand, [GOOD], (replace(TIP, link="palm"),)),
        "is on link 'palm', which does not move .*moving links are a",
    ),
    (
        partial(hand, [GOOD], home=(2.0,)),
        "home=2.0 rad of joint 'a_joint' must be within its limits",
    ),
    (partial(Geometry, "cone", (1.0,)), "unknown kind of geometry 'cone': choose one of 'sphere'"),
    (partial(Geometry, "capsule", (1.0,)), r"size \(radius, length\).* must have shape \(2,\)"),
    (partial(Geometry, "box", (1.0, 0.0, 1.0)), "m must be above 0"),
    (partial(of_thumb, press=(0.0, -1.0, 0.0)), "must be orthogonal"),
    (partial(of_thumb, link_lengths=(0.1, 0.1)), "link_lengths"),
    (partial(of_thumb, joint_lower=(2.0, 0.0, 0.0)), "joint_lower"),
    (partial(of_thumb, joint_upper=(1.0, 1.0, 1.0, 1.0)), "joint_upper"),
    (partial(HandDescription.of_fingers, []), "is empty"),
]


@pytest.mark.parametrize(
    ("make", "message"), IMPOSSIBLE, ids=lambda value: value if isinstance(value, str) else ""
)
def test_impossible_parts_and_hands_are_refused(make, message):
    assert hand([GOOD, NEXT]).joint_count == 2
    with pytest.raises(GraspError, match=message):
        make()
