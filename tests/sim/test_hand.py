"""Descriptions of hands, the built-in hands, and public hands of dexsuite/dex-urdf."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hands import make_link
from urdf_text import read_file

from grasp_env import core
from grasp_env.errors import GraspError
from grasp_env.sim import ObjectDescription, place_hand
from grasp_env.sim.grasping import plan_grasp
from grasp_env.sim.hand.description import HANDS, FingerDescription, Fingertip, Geometry, HandDescription, Palm
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.limbs import hand_limbs, touching_pairs
from grasp_env.sim.hand.solids import outline

# where the fingers press on the faces of a cuboid at z = -side / 2 (the thumb) and z = side / 2 [m]
FRONT = {
    "three_finger": [(-0.025, 0.0), (0.025, 0.0)],
    "four_finger": [(0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)],
    "four_finger_4dof": [(0.0, 0.03), (-0.03, -0.02), (0.03, -0.02)],
    "five_finger": [(-0.0125, 0.025), (0.0125, 0.025), (-0.028, -0.01), (0.028, -0.01)],
}


@pytest.mark.parametrize(("name", "tip"), [("allegro", (0.0, 0.0, 0.1362)), ("leap", (0.0019, -0.0149, 0.1284))])
def test_real_hands_have_their_published_measures(name: str, tip: tuple[float, ...]) -> None:
    """Straight middle fingers along z; the links of a finger overlap only their neighbours."""
    hand = HANDS[name]()
    assert (hand.name, hand.placed, hand.joint_count) == (name, False, 16)
    assert hand.finger_names == ("index", "middle", "ring", "thumb")
    assert set(hand.torque_limits) == {{"allegro": 0.7, "leap": 0.95}[name]}
    np.testing.assert_allclose(HandKinematics(hand).tips(np.zeros(16))[1], tip, atol=1e-9)
    assert touching_pairs(hand, at_home=False) == ()
    assert 0.04 < max(link.mass for link in hand.links) < 0.07
    assert 0.45 < sum(link.mass for link in hand.links) < 0.65


def test_links_of_fingers_have_the_inertia_of_solid_rods() -> None:
    """Compare with numerical integrals along the rods; the tip is a solid ball."""
    finger, grid = FingerDescription("f", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), np.linspace(0.0, 1.0, 501)
    for link, length, mass in zip(finger.links("palm"), finger.link_lengths, finger.link_masses, strict=True):
        across = np.trapezoid((length * (grid - 0.5)) ** 2, grid) * mass + 0.25 * mass * finger.link_radius**2
        if link.name == "f_distal":
            ball, arm = finger.tip_mass, 0.5 * length
            across += mass * ball / (mass + ball) * arm**2 + 0.4 * ball * finger.tip_radius**2
            assert link.center[0] == pytest.approx((mass * arm + ball * length) / (mass + ball))
        assert link.inertia[5] == pytest.approx(across, rel=1e-4)


@pytest.mark.parametrize("name", FRONT)
def test_built_in_hands_reach_around_cuboids_without_touching_themselves(name: str) -> None:
    """The postures are far from the joint limits."""
    kinematics = HandKinematics(HANDS[name]())
    limbs = core.HandLimbs.make(kinematics.tree, hand_limbs(kinematics.hand), kinematics.home)
    for side in (0.07, 0.12):
        away = 0.5 * side + 0.01
        angles = kinematics.solve([(0.0, 0.0, -away), *((x, y, away) for x, y in FRONT[name])])
        assert np.minimum(angles - kinematics.lower, kinematics.upper - angles).min() > 0.4
        assert all(gap > 0.004 for _, _, gap in limbs.link_gaps(angles, 0.02))
    rng = np.random.default_rng(5)
    for own in 25 * list(kinematics.carries):  # a finger never meets itself, and the palm only with its folded tip
        angles = np.where(own, rng.uniform(kinematics.lower, kinematics.upper), kinematics.home)
        for first, second, gap in limbs.link_gaps(angles, 0.0):
            if gap < 0.0 and own[second]:
                assert second in kinematics.tip_links if first < 0 else not own[first]


def test_a_moved_hand_moves_as_a_whole() -> None:
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


GOOD, NEXT = make_link(), make_link("b", "a")
THUMB = FingerDescription("good", (0.0, 0.1, 0.0), press=(0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(make_link, mass=0.0), r"link 'a': mass \[kg\] must be finite and > 0"),
        (partial(make_link, axis=(0, 0, 2)), "axis=.* must have length 1, not 2; normalise it"),
        (partial(make_link, axis=(0, 1)), r"must have shape \(3,\), got \(2,\)"),
        (partial(make_link, lower=1.0, upper=-1.0), "lower=1.0 must be below upper=-1.0"),
        (partial(make_link, lower=-np.inf), "must be finite"),
        (partial(make_link, inertia=(1e-5, 2e-5, 0, 1e-5, 0, 1e-5)), "all must be above 0"),
        (partial(make_link, inertia=(1e-5, 0, 0, 1e-5, 0, 3e-5)), "the largest is below the sum of the other two"),
        (partial(make_link, name=""), "must be a name"),
        (partial(hand, []), "links=.. is empty"),
        (partial(hand, [GOOD], ()), "fingertips=.. is empty"),
        (partial(hand, [NEXT, GOOD]), "parent 'a' of link 'b' stands after it"),
        (partial(hand, [GOOD, make_link("b", "c")]), "parent 'c' of link 'b' is not a link; known are palm, a"),
        (partial(hand, [GOOD, GOOD]), "two links are called 'a'"),
        (partial(hand, [GOOD, make_link("b", joint="a_joint")]), "two joints are called 'a_joint'"),
        (partial(hand, [GOOD], (TIP, TIP)), "two fingertips are called 'a'"),
        (partial(hand, [GOOD], (replace(TIP, link="palm"),)), "is on link 'palm', which does not move .*moving links are a"),
        (partial(hand, [GOOD], home=(2.0,)), "home=2.0 rad of joint 'a_joint' must be within its limits"),
        (partial(hand, [GOOD], tip_friction=0.0), "tip_friction must be finite and > 0"),
        (partial(Geometry, "cone", (1.0,)), "unknown kind of geometry 'cone': choose one of 'sphere'"),
        (partial(Geometry, "capsule", (1.0,)), r"size \(radius, length\).* must have shape \(2,\)"),
        (partial(Geometry, "box", (1.0, 0.0, 1.0)), "m must be above 0"),
        (partial(of_thumb, press=(0.0, -1.0, 0.1)), r"press=.* must have length 1"),
        (partial(of_thumb, press=(0.0, -1.0, 0.0)), "must be orthogonal"),
        (partial(of_thumb, link_lengths=(0.1, 0.1)), "link_lengths"),
        (partial(of_thumb, joint_lower=(2.0, 0.0, 0.0)), "joint_lower"),
        (partial(of_thumb, joint_upper=(1.0, 1.0, 1.0, 1.0)), "joint_upper"),
        (partial(of_thumb, home=(0.0, 5.0, 0.1)), "home"),
        (partial(HandDescription.of_fingers, []), "is empty"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_impossible_parts_and_hands_are_refused(make: Callable[[], object], message: str) -> None:
    assert hand([GOOD, NEXT]).joint_count == 2
    with pytest.raises(GraspError, match=message):
        make()


needs_files = pytest.mark.skipif(
    "GRASP_HANDS" not in os.environ, reason="set GRASP_HANDS to the folder of hands of dexsuite/dex-urdf"
)
# joints, fingertips, coupled joints, words of the one warning
FILES = {
    "allegro_hand/allegro_hand_right": (16, 4, 0, ("physically impossible inertias",)),
    "leap_hand/leap_hand_right": (16, 4, 0, ()),  # some copies lack meshes to look at
    "barrett_hand/bhand_model": (8, 3, 0, ("effort 0 of 'finger_1_prox_joint'",)),
    "dclaw_gripper/dclaw_gripper": (9, 3, 0, ()),
    "schunk_hand/schunk_svh_hand_right": (20, 5, 11, ("effort 1000 of", "without mass", "physically impossible inertias")),
    "shadow_hand/shadow_hand_right": (24, 5, 0, ()),
    "inspire_hand/inspire_hand_right": (12, 5, 6, ("are not one of .obj, .stl, .dae",)),
    "ability_hand/ability_hand_right": (10, 5, 4, ()),
}  # fmt: skip


def read(name: str) -> tuple[HandDescription, str]:
    return read_file(Path(os.environ["GRASP_HANDS"], f"{name}.urdf"))


@needs_files
@pytest.mark.parametrize("name", FILES)
def test_public_hands_read_as_they_are(name: str) -> None:
    joints, fingers, coupled, repairs = FILES[name]
    hand, told = read(name)
    assert (hand.joint_count, hand.finger_count) == (joints, fingers)
    assert sum(link.mimic is not None for link in hand.links) == coupled
    assert all(repair in told for repair in repairs)
    assert all(1e-3 <= link.mass < 1.0 for link in hand.links)
    assert HandKinematics(hand).carries.any(axis=1).all()
    for tip in hand.fingertips:
        link = next(link for link in hand.links if link.name == tip.link)
        away = float(np.linalg.norm(tip.center))
        assert 0.004 <= tip.radius <= 0.015
        assert 0.01 < away < 0.1
        for shape in link.collision:  # nothing else of the link lies before its tip
            assert shape.kind == "sphere" or (outline(shape) @ tip.center).max() < away**2


@needs_files
@pytest.mark.parametrize("name", ["allegro", "leap"])
def test_presets_move_as_the_files_do(name: str) -> None:
    """Their palm frames differ by a shift; tips fitted to meshes of few corners lie within 1.5 mm."""
    theirs, ours = HandKinematics(read(f"{name}_hand/{name}_hand_right")[0]), HandKinematics(HANDS[name]())
    np.testing.assert_allclose((ours.lower, ours.upper), (theirs.lower, theirs.upper), atol=1e-3)
    masses = [[link.mass for link in each.hand.links] for each in (ours, theirs)]
    np.testing.assert_allclose(masses[0], masses[1], rtol=1e-6)
    postures = np.random.default_rng(0).uniform(ours.lower, ours.upper, (200, 16))
    off = np.array([ours.tips(angles) - theirs.tips(angles) for angles in postures])
    assert np.linalg.norm(off - off.mean(axis=(0, 1)), axis=2).max() < 1.5e-3


@needs_files
@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_public_hands_are_placed(name: str) -> None:
    """`plan_grasp` finds a grasp in the chosen place."""
    ball = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
    kinematics = HandKinematics(place_hand(read(name)[0], ball))
    assert len(plan_grasp(ball, kinematics).points) == kinematics.hand.finger_count >= 3
