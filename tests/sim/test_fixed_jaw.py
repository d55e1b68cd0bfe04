"""Grippers with one moving jaw: the palm's own jaw is the second fingertip."""

from __future__ import annotations

from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
from engines import needs_bullet
from urdf_text import INERTIAL, read, robot, solid

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandKinematics
from grasp_env.sim.hand.files.fixed_jaw import ARM_FORCE, TRAVEL

# a housing with a jaw of 8 cm along z, and a jaw that turns about y beside it
PALM = solid('<box size="0.05 0.04 0.04"/>', "0.02 0 -0.02") + solid(
    '<box size="0.008 0.02 0.08"/>', "-0.004 0 0.04"
)
JAW = solid('<box size="0.008 0.02 0.08"/>', "0.004 0 0.04")
GRIPPER = robot(
    f'<link name="wrist">{INERTIAL}{PALM}</link><link name="jaw">{INERTIAL}{JAW}</link>'
    '<joint name="grip" type="revolute"><parent link="wrist"/><child link="jaw"/><origin xyz="0.002 0 0"/>'
    '<axis xyz="0 1 0"/><limit lower="0" upper="1.2" effort="1.5"/></joint>'
)
ARM = GRIPPER.replace(
    "</robot>",
    "".join(
        f'<link name="arm{k}">{INERTIAL}</link><joint name="turn{k}" type="revolute"><parent link="arm{k}"/>'
        f'<child link="{"wrist" if k == 3 else f"arm{k + 1}"}"/><origin xyz="0.1 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-2" upper="2" effort="3"/></joint>'
        for k in range(4)
    )
    + "</robot>",
)
CUBE = {"shape": "cuboid", "size": (0.03, 0.03, 0.03), "mass": 0.05, "friction": 0.8}


def test_the_palm_is_the_other_jaw(tmp_path):
    hand, told = read(tmp_path, GRIPPER)
    assert hand.finger_names == ("jaw", "fixed_jaw")
    assert "one jaw moves, and the palm 'wrist' is the other, with a fingertip at [" in told
    jaw = hand.links[-1]
    assert (jaw.parent, jaw.sliding, jaw.upper, jaw.torque_limit) == (
        "wrist",
        True,
        TRAVEL,
        ARM_FORCE,
    )
    kinematics = HandKinematics(hand)
    low, high = (kinematics.tips(np.array([0.0, way])) for way in (0.0, TRAVEL))
    # it slides out of the jaw's face, towards the other jaw, where that closes
    np.testing.assert_allclose(high[1] - low[1], (TRAVEL, 0.0, 0.0), atol=1e-9)
    assert low[1][0] + kinematics.tip_radii[1] == pytest.approx(0.004, abs=1e-9)
    assert abs(low[1][2] - low[0][2]) < 0.002
    assert abs(low[1][1]) < 1e-9


@pytest.mark.parametrize("engine", [pytest.param("bullet", marks=needs_bullet), "mujoco"])
def test_it_holds_a_cube(tmp_path, engine):
    if engine == "mujoco":
        pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    hand, _ = read(tmp_path, GRIPPER)
    item = {**CUBE, "torsional_friction": 0.006}
    settings = {"disturbance": "none", "duration": 1.0, "action_mode": "none"}
    with closing(
        gym.make("grasp_env:FourFingerGrasp-v0", hand=hand, object=item, engine=engine, **settings)
    ) as env:
        env.reset(seed=0)
        for _ in range(50):
            info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        assert info["is_success"], info["fault"]
        assert env.unwrapped.grasp.hand.finger_names == ("jaw", "fixed_jaw")


def test_an_arm_with_one_jaw_names_its_palm(tmp_path):
    with pytest.raises(
        InvalidInputError, match="moves a jaw against the link 'wrist', name palm='wrist'"
    ):
        read(tmp_path, ARM)
    assert read(tmp_path, ARM, palm="wrist")[0].finger_names == ("jaw", "fixed_jaw")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"-0.004 0 0.04"', '"-0.104 0 0.04"'),  # no palm where the jaw closes
        ('type="revolute"', 'type="continuous"'),
    ],
)
def test_other_single_fingers_stay_as_they_are(tmp_path, old, new):
    hand, told = read(tmp_path, GRIPPER.replace(old, new))
    assert hand.finger_names == ("jaw",)
    assert "one jaw moves" not in told


def test_a_hand_without_collision_shapes_touches_with_what_is_drawn(tmp_path):
    hand, told = read(tmp_path, GRIPPER.replace("collision", "visual"))
    assert "no link has a collision shape, so what is drawn touches instead" in told
    assert hand.finger_names == ("jaw", "fixed_jaw")
    assert len(hand.palm.collision) == 2


def test_joints_without_any_range_get_one(tmp_path):
    text = GRIPPER.replace('upper="1.2"', 'upper="0"')
    hand, told = read(tmp_path, text)
    assert "no joint has a range, all are 0 to 0: assumed is -1.57 to 1.57 rad" in told
    assert hand.links[0].lower == -hand.links[0].upper == pytest.approx(-0.5 * np.pi)
    assert read(tmp_path, text, joint_limits={"grip": (0.0, 1.0)})[0].links[0].upper == 1.0


def test_a_range_that_is_given_leaves_the_others_assumed(tmp_path):
    """Who follows the advice for one joint does not freeze the others."""
    text = GRIPPER.replace('upper="1.2"', 'upper="0"').replace(
        "</robot>",
        f'<link name="wheel">{INERTIAL}{JAW}</link><joint name="roll" type="revolute"><parent link="wrist"/>'
        '<child link="wheel"/><origin xyz="-0.05 0 0"/><axis xyz="0 1 0"/><limit lower="0" upper="0" effort="1"/>'
        "</joint></robot>",
    )
    hand, told = read(tmp_path, text, joint_limits={"grip": (0.0, 1.0)})
    assert {link.joint: link.upper for link in hand.links} == {
        "grip": 1.0,
        "roll": pytest.approx(0.5 * np.pi),
    }
    assert "of a sliding one, for 'roll'; give the true ranges" in told
