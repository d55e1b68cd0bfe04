"""Hands of the repository dexsuite/dex-urdf as they are: GRASP_HANDS is the folder that holds allegro_hand, leap_hand, ..."""

from __future__ import annotations

import os
import time
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from engines import Bullet, bullet, needs_bullet

from grasp_env.sim import HANDS, HandKinematics, ObjectDescription, SceneConfig, place_hand
from grasp_env.sim.grasping import plan_grasp
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.solids import outline

FOLDER = Path(os.environ.get("GRASP_HANDS", ""))
pytestmark = [
    needs_bullet,
    pytest.mark.skipif(
        "GRASP_HANDS" not in os.environ, reason="set GRASP_HANDS to the folder of hands of dexsuite/dex-urdf"
    ),
]

# joints, fingertips, coupled joints, what their one warning tells
FILES = {
    "allegro_hand/allegro_hand_right": (16, 4, 0, ("physically impossible inertias",)),
    "leap_hand/leap_hand_right": (16, 4, 0, ()),  # some copies lack meshes to look at
    "barrett_hand/bhand_model": (8, 3, 0, ("effort 0 of 'finger_1_prox_joint'",)),
    "dclaw_gripper/dclaw_gripper": (9, 3, 0, ()),
    "schunk_hand/schunk_svh_hand_right": (
        20,
        5,
        11,
        ("effort 1000 of", "without mass", "physically impossible inertias"),
    ),
    "shadow_hand/shadow_hand_right": (24, 5, 0, ()),
    "inspire_hand/inspire_hand_right": (12, 5, 6, ("are none of .obj, .stl, .dae",)),
    "ability_hand/ability_hand_right": (10, 5, 4, ()),
}


@cache
def read(name: str) -> tuple[HandDescription, str, float]:
    """The hand, what was repaired, and the time that reading took [s]."""
    begun = time.perf_counter()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        hand = HandDescription.from_urdf(FOLDER / f"{name}.urdf")
    assert len(told) <= 1
    return hand, str(told[0].message) if told else "", time.perf_counter() - begun


@pytest.mark.parametrize("name", FILES)
def test_public_hands_read_as_they_are(name: str) -> None:
    joints, fingers, coupled, repairs = FILES[name]
    hand, told, seconds = read(name)
    assert (hand.joint_count, hand.finger_count) == (joints, fingers)
    assert sum(link.mimic is not None for link in hand.links) == coupled
    assert all(repair in told for repair in repairs)
    assert not hand.placed
    assert all(1e-3 <= link.mass < 1.0 for link in hand.links)
    assert seconds < 20.0  # 0.1 to 2 s on one core that does nothing else
    kinematics = HandKinematics(hand)
    for tip, own in zip(hand.fingertips, kinematics.carries, strict=True):
        link = next(link for link in hand.links if link.name == tip.link)
        assert 0.004 <= tip.radius <= 0.015
        assert 0.01 < np.linalg.norm(tip.center) < 0.1
        direction = np.array(tip.center) / np.linalg.norm(tip.center)
        for shape in link.collision:  # nothing else of the link lies before its tip
            if shape.kind != "sphere":
                assert (outline(shape) @ direction).max() < np.linalg.norm(tip.center)
        assert own.any()


@pytest.mark.parametrize("name", FILES)
def test_public_hands_load_and_their_couplings_hold(name: str) -> None:
    """The motors swing their joints for a second by 0.05 rad about home, where some links touch others."""
    hand, _, _ = read(name)
    hand = hand.moved((0.0, 0.0, -1.0))
    config = SceneConfig(
        hand=hand, object=ObjectDescription("sphere", (0.06,)), contact_points=((0.0, 0.0, 0.03),) * hand.finger_count, gravity=(0, 0, 0)
    )  # fmt: skip
    simulator = Bullet(hand)
    begun = time.perf_counter()
    simulator.load(config, np.array(hand.home))
    assert time.perf_counter() - begun < 1.0
    kinematics, worst = HandKinematics(hand), 0.0
    drive = np.array([link.mimic is None for link in hand.links])
    home = angles = np.array(hand.home)
    for step in range(250):
        rows = bullet.getJointStates(simulator.world.hand, simulator.world.joints, simulator.client.number)
        angles, speeds = np.array([row[:2] for row in rows]).T
        target = home + 0.05 * np.sin(2.0 * np.pi * step / 125.0)
        wanted = np.where(drive, 400.0 * (target - angles) - 40.0 * speeds, 0.0)
        torques = np.where(drive, kinematics.mass_matrix(angles) @ wanted, 0.0)
        simulator.advance(np.clip(torques, -hand.torque_limits, hand.torque_limits).tolist(), None)
        rows = bullet.getJointStates(simulator.world.hand, simulator.world.joints, simulator.client.number)
        angles = np.array([row[0] for row in rows])
        for index, link in enumerate(hand.links):
            if link.mimic is not None:
                expected = link.mimic.ratio * angles[hand.drivers[index]] + link.mimic.offset
                worst = max(worst, abs(angles[index] - expected))
    assert np.isfinite(angles).all()
    assert np.abs(angles - home)[drive].max() < 0.5
    assert worst < 1e-4
    simulator.close()


@pytest.mark.parametrize(
    ("name", "preset"), [("allegro_hand/allegro_hand_right", "allegro"), ("leap_hand/leap_hand_right", "leap")]
)
def test_presets_move_as_the_files_do(name: str, preset: str) -> None:
    """Their palm frames differ by a shift; tips fitted to meshes of few corners lie within 1.5 mm."""
    theirs, ours = HandKinematics(read(name)[0]), HandKinematics(HANDS[preset]())
    np.testing.assert_allclose(ours.lower, theirs.lower, atol=1e-3)
    np.testing.assert_allclose(ours.upper, theirs.upper, atol=1e-3)
    np.testing.assert_allclose(
        [link.mass for link in ours.hand.links], [link.mass for link in theirs.hand.links], rtol=1e-6
    )
    rng = np.random.default_rng(0)
    off = np.array(
        [ours.tips(angles) - theirs.tips(angles) for angles in rng.uniform(ours.lower, ours.upper, (200, 16))]
    )
    off -= off.mean(axis=(0, 1))
    assert np.linalg.norm(off, axis=2).max() < 1.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_public_hands_are_placed(name: str) -> None:
    """With a grasp that `plan_grasp` finds."""
    ball = ObjectDescription("sphere", (0.06,), mass=0.15, friction=0.7)
    kinematics = HandKinematics(place_hand(read(name)[0], ball))
    assert len(plan_grasp(ball, kinematics).points) == kinematics.hand.finger_count >= 3
