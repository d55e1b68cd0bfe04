"""Hands whose links are coupled: rods are no fingertips, and limits that nobody checked do not stop a motor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics

INERTIAL = (
    '<inertial><mass value="0.02"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def link(name: str, *ends: tuple[float, float]) -> str:
    """A link with rods of 6 x 6 mm from its origin to points (x, z) [m]."""
    shapes = ""
    for x, z in ends:
        length, angle = np.hypot(x, z), np.arctan2(x, z)
        shapes += (f'<collision><origin xyz="{x / 2} 0 {z / 2}" rpy="0 {angle} 0"/><geometry><box size="0.006 0.006 {length}"/></geometry>'
                   "</collision>")  # fmt: skip
    return f'<link name="{name}">{INERTIAL}{shapes}</link>'


def joint(
    parent: str, child: str, x: float, z: float, ratio: float = 0.0, limits: str = 'lower="-0.5" upper="0.5"'
) -> str:
    mimic = f'<mimic joint="left_crank_joint" multiplier="{ratio}"/>' if ratio else ""
    return (f'<joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 {z}"/>'
            f'<axis xyz="0 1 0"/><limit {limits} effort="1" velocity="1"/>{mimic}</joint>')  # fmt: skip


def gripper(finger_limits: str) -> str:
    """Two fingers, each a parallelogram of a crank, a rod and a fingertip that keeps its direction."""
    text = '<link name="palm"><collision><geometry><box size="0.1 0.02 0.01"/></geometry></collision></link>'
    for side, x, sign in (("left", -0.04, 1.0), ("right", 0.04, -1.0)):
        drive = sign if side == "right" else 0.0
        text += joint("palm", f"{side}_crank", x, 0.01, drive) + link(f"{side}_crank", (0.0, 0.04))
        text += joint("palm", f"{side}_rod", x + 0.015 * sign, 0.01, sign) + link(f"{side}_rod", (0.0, 0.04))
        text += joint(f"{side}_crank", f"{side}_tip", 0.0, 0.04, -sign, finger_limits)
        text += link(f"{side}_tip", (0.015 * sign, 0.0), (0.0, 0.05))
    return f'<robot name="gripper">{text}</robot>'


def read(folder: Path, text: str) -> tuple[HandDescription, str]:
    path = folder / "gripper.urdf"
    path.write_text(text)
    with pytest.warns(UserWarning, match=r"gripper\.urdf") as told:
        hand = HandDescription.from_urdf(path)
    return hand, str(told[0].message)


def test_rods_are_no_fingertips(tmp_path: Path) -> None:
    hand, told = read(tmp_path, gripper('lower="-0.5" upper="0.5"'))
    assert hand.finger_names == ("left_tip", "right_tip")
    assert "rods that only move a finger are not fingertips: 'left_rod', 'right_rod'" in told


def test_jaws_that_meet_are_no_rods(tmp_path: Path) -> None:
    text = '<link name="palm"><collision><geometry><box size="0.1 0.02 0.01"/></geometry></collision></link>'
    text += joint("palm", "left_crank", -0.012, 0.01) + link("left_crank", (0.0, 0.05))
    text += joint("palm", "short_jaw", 0.012, 0.01, -1.0) + link("short_jaw", (0.0, 0.035))
    (tmp_path / "jaws.urdf").write_text(f'<robot name="jaws">{text}</robot>')
    hand = HandDescription.from_urdf(tmp_path / "jaws.urdf")
    assert hand.finger_names == ("left_crank", "short_jaw")


@pytest.mark.parametrize("limits", ['lower="0" upper="0.5"', 'lower="0.4" upper="0.5"'])
def test_limits_of_coupled_joints_that_stop_their_motor_do_not_count(tmp_path: Path, limits: str) -> None:
    hand, told = read(tmp_path, gripper(limits))
    assert "leave their motor hardly any range and are ignored" in told
    assert "'left_tip_joint', 'right_crank_joint', 'right_rod_joint', 'right_tip_joint'" in told
    kinematics = HandKinematics(hand)
    assert (kinematics.lower[0], kinematics.upper[0]) == pytest.approx((-0.5, 0.5))


def test_limits_of_coupled_joints_count_otherwise(tmp_path: Path) -> None:
    text = gripper('lower="-0.5" upper="0.5"').replace('lower="-0.5" upper="0.5"', 'lower="-0.3" upper="0.5"')
    hand, told = read(tmp_path, text)
    assert "hardly any range" not in told
    assert (HandKinematics(hand).lower[0], HandKinematics(hand).upper[0]) == pytest.approx((-0.3, 0.3))


def test_what_a_caller_says_of_coupled_joints(tmp_path: Path) -> None:
    path = tmp_path / "gripper.urdf"
    path.write_text(gripper('lower="-0.5" upper="0.5"'))
    with pytest.warns(UserWarning, match="rods"):
        hand = HandDescription.from_urdf(path, joint_limits={"left_tip_joint": (0.0, 0.1)})
    assert HandKinematics(hand).lower[0] == pytest.approx(-0.1)
    with pytest.raises(
        InvalidInputError, match="'left_tip_joint' have no motor of their own; give that of 'left_crank_joint'"
    ):
        HandDescription.from_urdf(path, torque_limit={"left_tip_joint": 2.0})
