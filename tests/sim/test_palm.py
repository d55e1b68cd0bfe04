"""Arms and whole robots are read by naming the palm: what carries it holds still, other limbs are left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from urdf_text import finger, hand, joint, link, read

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.kinematics import HandKinematics


def chain(name: str, start: str, count: int, kind: str = "revolute") -> str:
    """A chain of links `name`1, ... on the joints `name`_1, ...; its shapes are meshes that do not exist."""
    text, parent = "", start
    for number in range(1, count + 1):
        child = f"{name}{number}"
        text += joint(f"{name}_{number}", parent, child, "0.2 0 0", kind=kind)
        text += f'<link name="{child}"><collision><geometry><mesh filename="none.stl"/></geometry></collision></link>'
        parent = child
    return text


FLANGE = joint("flange", "arm7", "wrist", "0.1 0 0", kind="fixed") + link("wrist")
MOUNT = joint("mount", "wrist", "palm", "0.02 0.01 0", kind="fixed")
ARM = link("base") + chain("arm", "base", 7) + FLANGE + MOUNT + hand()
ROBOT = (
    link("pelvis")
    + chain("leg", "pelvis", 6)
    + chain("waist", "pelvis", 1, "continuous")
    + "".join(
        chain(f"{side}arm", "waist1", 5) + joint(f"{side}mount", f"{side}arm5", f"{side}palm", kind="fixed")
        for side in "lr"
    )
    + hand("lpalm", "l")
    + hand("rpalm", "r")
)


def test_a_hand_on_an_arm_is_the_hand_alone(tmp_path: Path) -> None:
    """The meshes of what is left out are not looked for; the link that carries the palm without a joint belongs to it."""
    text = ARM.replace(
        ' name="arm7"><collision><geometry><mesh filename="none.stl"/></geometry></collision>', ' name="arm7">'
    )
    made, told = read(tmp_path, text, palm="palm")
    alone, nothing = read(tmp_path, hand())
    assert nothing == ""
    joints = ", ".join(f"'arm_{number}'" for number in range(1, 8))
    assert told.endswith(f"the joints that carry the palm 'palm' hold still, their links are left out: {joints}")
    assert (made.links, made.fingertips) == (alone.links, alone.fingertips)
    assert made.palm.name == "palm"
    assert [shape.origin for shape in made.palm.collision] == [
        (0.03, 0.0, 0.0),
        (0.0, -0.01, 0.0),
    ]  # the wrist's after its own


def test_any_fixed_link_may_name_the_palm(tmp_path: Path) -> None:
    text = ARM.replace('<mesh filename="none.stl"/>', '<sphere radius="0.02"/>').replace(
        'xyz="0.02 0.01 0"', 'xyz="0.02 0.01 0" rpy="0.3 -0.2 0.5"'
    )
    here, there = (read(tmp_path, text, palm=name)[0] for name in ("palm", "arm7"))
    place = Frame.of((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)) @ Frame.of((0.02, 0.01, 0.0), (0.3, -0.2, 0.5))
    angles = np.linspace(0.0, 1.0, 6)
    tips = HandKinematics(here).tips(angles) @ place.rotation.T + place.origin
    np.testing.assert_allclose(HandKinematics(there).tips(angles), tips, atol=1e-15)
    assert len(here.palm.collision) == len(there.palm.collision) == 3


def test_one_hand_of_a_robot_is_read_and_the_rest_left_out(tmp_path: Path) -> None:
    text = ROBOT.replace("none.stl", "also_none.stl").replace(
        '<link name="rarm5"><collision><geometry><mesh filename="also_none.stl"/></geometry></collision></link>',
        '<link name="rarm5"/>',
    )
    made, told = read(tmp_path, text, palm="rpalm")
    assert made.joint_names == ("ria", "rib", "rma", "rmb", "rta", "rtb")
    assert "'rpalm' hold still, their links are left out: 'waist_1', 'rarm_1'" in told
    assert "limbs that the palm 'rpalm' does not carry are left out, with the joints 'leg_1'" in told
    assert "'larm_5'" in told
    assert "'lta'" in told
    thumb, _ = read(tmp_path, text, palm="rpalm", fingertips=["rt2", "rm2"])
    assert thumb.finger_names == ("rt2", "rm2")
    with pytest.raises(
        InvalidInputError, match="the palm 'rpalm' does not carry the fingertips 'lt2'; its links are 'rarm5', 'rpalm'"
    ):
        read(tmp_path, text, palm="rpalm", fingertips=["rt2", "lt2"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            ARM,
            (
                "'arm_6', 'arm_7' has 7 motors and leads to a branching. Name the hand's palm, palm='palm'; palm='base' reads all",
            ),
        ),
        (
            ROBOT,
            (
                "has 5 motors and leads to a branching",
                "palm='lpalm' or palm='rpalm'; palm='pelvis' reads all of it as one hand",
            ),
        ),
        (link("base") + chain("arm", "base", 7), ("has 7 motors. No link carries several chains",)),
    ],
)
def test_arms_and_robots_are_refused_at_once_with_the_names_of_palms(
    tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    with pytest.raises(InvalidInputError) as told:
        read(tmp_path, text)
    for each in ("this is an arm or a whole robot", *words):
        assert each in str(told.value)
    assert "none.stl" not in str(told.value)


def test_hands_with_wrists_and_long_fingers_are_no_arms(tmp_path: Path) -> None:
    solid = '<sphere radius="0.01"/>'
    wrist = link("base") + chain("w", "base", 3) + joint("mount", "w3", "palm", kind="fixed") + hand()
    made, _ = read(tmp_path, wrist.replace('<mesh filename="none.stl"/>', solid).replace("0.2 0 0", "0.03 0 0"))
    assert made.joint_count == 9
    fingers = link("base") + "".join(chain(name, "base", 6) for name in "abc")
    made, _ = read(tmp_path, fingers.replace('<mesh filename="none.stl"/>', solid).replace("0.2 0 0", "0.02 0 0"))
    assert made.joint_count == 18


def test_naming_the_root_reads_all(tmp_path: Path) -> None:
    text = ARM.replace('<mesh filename="none.stl"/>', '<sphere radius="0.02"/>')
    made, _ = read(tmp_path, text, palm="base")
    assert (made.joint_count, made.palm.name) == (13, "base")
    plain = hand()
    assert read(tmp_path, plain, palm="palm") == read(tmp_path, plain)


@pytest.mark.parametrize(
    ("palm", "message"),
    [
        ("hand", "palm: no link is called 'hand'; joints branch at 'palm'; links are 'base', 'arm1'"),
        ("i2", "the palm 'i2' carries no joint that moves; links that do are 'base', 'arm1'"),
        ("", "palm='' must be a name"),
        (3, "palm=3 must be a name"),
    ],
)
def test_a_palm_must_be_a_link_that_carries_joints(tmp_path: Path, palm: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, ARM, palm=palm)


def test_joints_that_mimic_what_is_left_out_hold_still(tmp_path: Path) -> None:
    """At the angle that they have where the other is at 0; and those of joints that no hand has are not looked at."""
    follower = joint("f", "palm", "follower", "0 0 -0.02", mimic="arm_1").replace("<mimic ", '<mimic offset="0.3" ')
    second = joint("g", "follower", "second", mimic="f").replace("<mimic ", '<mimic multiplier="2" ')
    floating = link("cart") + joint("free", "cart", "base", kind="floating")
    text = floating + ARM.replace('<mesh filename="none.stl"/>', '<sphere radius="0.02"/>')
    made, told = read(tmp_path, text + follower + link("follower") + second + link("second"), palm="palm")
    assert "joints that mimic others that are left out hold still: 'f', 'g'" in told
    assert made.joint_count == 6
    tilts = [shape.rotation[1] for shape in made.palm.collision if shape.kind == "box"]
    np.testing.assert_allclose(tilts, (0.0, 0.0, 0.3, 0.9), atol=1e-12)  # palm, wrist, follower, second


def test_a_finger_alone_can_be_the_hand(tmp_path: Path) -> None:
    made, told = read(tmp_path, hand() + finger("x", "i2", "0.04 0 0"), palm="i1")
    assert made.joint_names == ("ib", "xa", "xb")
    assert "hold still, their links are left out: 'ia';" in told
