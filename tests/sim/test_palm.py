"""Find the hand in a file: arms, robots, frozen joints, rods of linkages."""

from __future__ import annotations

import numpy as np
import pytest
from urdf_text import INERTIAL, finger, hand, joint, link, read

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.kinematics import HandKinematics

MESH = '<mesh filename="none.stl"/>'
SOLID = '<sphere radius="0.01"/>'


def chain(name: str, parent: str, count: int, shape: str = MESH, step: float = 0.2) -> str:
    """Return a chain of links `name`1, ...

    on the joints `name`_1, ... with missing meshes; the last has no shape.
    """
    text = ""
    for number in range(1, count + 1):
        body = (
            f"<collision><geometry>{shape}</geometry></collision>"
            if number < count or shape != MESH
            else ""
        )
        text += (
            joint(f"{name}_{number}", parent, f"{name}{number}", f"{step} 0 0")
            + f'<link name="{name}{number}">{body}</link>'
        )
        parent = f"{name}{number}"
    return text


MOUNT = joint("mount", "wrist", "palm", "0.02 0.01 0", kind="fixed").replace(
    '0.01 0"', '0.01 0" rpy="0.3 -0.2 0.5"'
)
FLANGE = joint("flange", "arm7", "wrist", "0.1 0 0", kind="fixed")
ARM = link("base") + chain("arm", "base", 7) + FLANGE + link("wrist") + MOUNT + hand()
ROBOT = link("pelvis") + chain("leg", "pelvis", 6, SOLID) + chain("waist", "pelvis", 1)
for side in "lr":
    fixed = joint(f"{side}mount", f"{side}arm5", f"{side}palm", kind="fixed")
    ROBOT += chain(f"{side}arm", "waist1", 5) + fixed + hand(f"{side}palm", side)


def many_motors(step: float) -> str:
    """Return a chain of 8 joints, 3 cm apart, then 3 cm and a step, then a step [m] apart."""
    plate = joint("bracket", "a4", "plate", "0.03 0 0", kind="fixed") + link("plate")
    first = link("base") + chain("a", "base", 4, SOLID, 0.03)
    return first + plate + chain("b", "plate", 4, SOLID, step)


def test_a_hand_on_an_arm_is_the_hand_alone(tmp_path):
    """Meshes of the arm are not looked for; any link fixed to the palm may be named instead."""
    made, told = read(tmp_path, ARM, palm="palm")
    alone, nothing = read(tmp_path, hand())
    assert nothing == ""
    joints = ", ".join(f"'arm_{number}'" for number in range(1, 8))
    assert told.endswith(
        f"the joints that carry the palm 'palm' hold still, their links are left out: {joints}"
    )
    assert (made.links, made.fingertips, made.palm.name) == (alone.links, alone.fingertips, "palm")
    there, _ = read(tmp_path, ARM, palm="arm7")
    place = Frame.of((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)) @ Frame.of(
        (0.02, 0.01, 0.0), (0.3, -0.2, 0.5)
    )
    angles = np.linspace(0.0, 1.0, 6)
    tips = HandKinematics(made).tips(angles) @ place.rotation.T + place.origin
    np.testing.assert_allclose(HandKinematics(there).tips(angles), tips, atol=1e-15)
    wrist = made.palm.collision[1]  # part of the palm, wherever that is seen from
    np.testing.assert_allclose(
        place.rotation @ wrist.origin + place.origin, (0.12, 0.0, 0.0), atol=1e-15
    )
    assert any(shape.origin == pytest.approx((0.12, 0.0, 0.0)) for shape in there.palm.collision)


def test_one_hand_of_a_robot_is_read(tmp_path):
    made, told = read(tmp_path, ROBOT, ["rt2", "rm2"], palm="rpalm")
    assert made.joint_names == ("ria", "rib", "rma", "rmb", "rta", "rtb")
    assert made.finger_names == ("rt2", "rm2")
    assert "'rpalm' hold still, their links are left out: 'waist_1', 'rarm_1'" in told
    assert (
        "limbs that the palm 'rpalm' does not carry are left out, with the joints 'leg_1'" in told
    )
    words = "'rpalm' does not carry the fingertips 'lt2'; its links are 'rarm5', 'rpalm'"
    with pytest.raises(InvalidInputError, match=words):
        read(tmp_path, ROBOT, ["rt2", "lt2"], palm="rpalm")


REFUSED = [
    (
        ARM,
        None,
        "'arm_7' has 7 motors and leads to a branching. Name the hand's palm, palm='palm'; palm='base' reads all of it as one hand",
    ),
    (
        ROBOT,
        None,
        "has 5 motors and leads to a branching. Name the hand's palm, palm='lpalm' or palm='rpalm'; palm='pelvis' reads all",
    ),
    (
        ARM,
        "hand",
        "palm: no link is called 'hand'; joints branch at 'palm'; links are 'base', 'arm1'",
    ),
    # 0.32 m from the first joint to the last
    (
        many_motors(0.05),
        None,
        "'b_4' has 8 motors. If the last joint moves a jaw against the link 'b3', name palm='b3'",
    ),
    (ARM, "i2", "the palm 'i2' carries no joint that moves; links that do are 'base', 'arm1'"),
]


@pytest.mark.parametrize(("text", "palm", "words"), REFUSED)
def test_arms_and_robots_are_refused_with_palms(tmp_path, text, palm, words):
    with pytest.raises(InvalidInputError) as told:
        read(tmp_path, text, palm=palm)
    assert words in str(told.value)
    assert "none.stl" not in str(told.value)


FOLLOWER = joint("f", "palm", "follower", "0 0 -0.02", mimic="arm_1").replace(
    "<mimic ", '<mimic offset="0.3" '
) + link("follower")
SECOND = joint("g", "follower", "second", mimic="f").replace(
    "<mimic ", '<mimic multiplier="2" '
) + link("second")
NAIL = (
    joint("n", "i2", "nail", limits=(0.4, 0.4))
    + link("nail")
    + joint("o", "nail", "end", mimic="n")
    + link("end")
)


STILL = [
    (
        link("base")
        + chain("w", "base", 3, SOLID, 0.03)
        + joint("mount", "w3", "palm", kind="fixed")
        + hand(),
        {},
        9,
        "",
        (0.0,),
    ),
    (
        link("base") + "".join(chain(name, "base", 6, SOLID, 0.02) for name in "abc"),
        {},
        18,
        "",
        (0.0,),
    ),
    (many_motors(0.0425), {}, 8, "", (0.0,)),  # 0.29 m
    (
        hand() + finger("x", "i2", "0.04 0 0"),
        {"palm": "i1"},
        3,
        "hold still, their links are left out: 'ia';",
        (0.0,),
    ),
    # at the angle that they have where the others are at 0; joints that no hand has are not
    # looked at
    (
        link("cart")
        + joint("free", "cart", "base", kind="floating")
        + ARM.replace(' rpy="0.3 -0.2 0.5"', "")
        + FOLLOWER
        + SECOND,
        {"palm": "palm"},
        6,
        "joints that mimic others that are left out hold still: 'f', 'g'",
        (0.0, 0.0, 0.3, 0.9),
    ),
    (hand() + NAIL, {"palm": "i2", "joint_limits": {"n": (0.0, 0.4)}}, 2, "hold still", (0.0,)),
    (
        hand() + NAIL,
        {},
        6,
        "joints with equal limits, lower = upper, or a mimic multiplier of 0 hold still: 'n', 'o'; give the true ranges as joint_limits=",
        (0.0,),
    ),
]


@pytest.mark.parametrize(
    ("text", "options", "count", "words", "tilts"),
    STILL,
    ids=[
        "wrist",
        "long fingers",
        "many motors",
        "a finger",
        "followers",
        "given range",
        "equal limits",
    ],
)
def test_joints_that_hold_still(tmp_path, text, options, count, words, tilts):
    made, told = read(tmp_path, text, **options)
    assert made.joint_count == count
    assert words in told
    boxes = [shape.rotation[1] for shape in made.palm.collision if shape.kind == "box"]
    # palm, wrist, follower, second
    np.testing.assert_allclose(boxes[: len(tilts)], tilts, atol=1e-12)
    if text.endswith(NAIL) and not options:
        nail = next(each for each in made.links if each.name == "i2").collision[1]
        assert nail.rotation[1] == pytest.approx(0.4)


def rods(name: str, *ends: tuple[float, float]) -> str:
    """Return a link with rods of 6 x 6 mm from its origin to points (x, z) [m]."""
    shapes = "".join(
        f'<collision><origin xyz="{x / 2} 0 {z / 2}" rpy="0 {np.arctan2(x, z)} 0"/><geometry><box size="0.006 0.006 {np.hypot(x, z)}"/>'
        "</geometry></collision>"
        for x, z in ends
    )
    return f'<link name="{name}">{INERTIAL}{shapes}</link>'


def pivot(
    parent: str,
    child: str,
    x: float,
    z: float,
    ratio: float = 0.0,
    limits: tuple[float, float] = (-0.5, 0.5),
) -> str:
    """Return a joint at (x, z) [m], coupled to that of `left_crank` unless the ratio is 0."""
    text = joint(
        f"{child}_joint",
        parent,
        child,
        f"{x} 0 {z}",
        limits,
        mimic="left_crank_joint" if ratio else "",
    )
    return text.replace("<mimic ", f'<mimic multiplier="{ratio}" ')


def gripper(limits: tuple[float, float]) -> str:
    """Return two fingers, each a parallelogram of a crank, a rod and a fingertip that keeps its
    direction."""
    text = link("palm", 0.01)
    for side, x, sign in (("left", -0.04, 1.0), ("right", 0.04, -1.0)):
        text += pivot("palm", f"{side}_crank", x, 0.01, min(0.0, sign)) + rods(
            f"{side}_crank", (0.0, 0.04)
        )
        text += pivot("palm", f"{side}_rod", x + 0.015 * sign, 0.01, sign) + rods(
            f"{side}_rod", (0.0, 0.04)
        )
        text += pivot(f"{side}_crank", f"{side}_tip", 0.0, 0.04, -sign, limits) + rods(
            f"{side}_tip", (0.015 * sign, 0.0), (0.0, 0.05)
        )
    return text


@pytest.mark.parametrize(
    ("limits", "options", "ignored", "lower"),
    [
        ((0.0, 0.5), {}, True, -0.5),  # opposite joints would stop each other
        ((0.4, 0.5), {}, True, -0.5),
        ((-0.5, 0.3), {}, False, -0.3),
        # a caller's always count
        ((-0.5, 0.5), {"joint_limits": {"left_tip_joint": (0.0, 0.1)}}, False, -0.1),
    ],
)
def test_rods_are_no_fingertips(tmp_path, limits, options, ignored, lower):
    made, told = read(tmp_path, gripper(limits), **options)
    assert made.finger_names == ("left_tip", "right_tip")
    assert "rods that only move a finger are not fingertips: 'left_rod', 'right_rod'" in told
    if not options:
        words = "hardly any range and are ignored: 'left_tip_joint', 'right_crank_joint'"
        assert (words in told.replace("'left_rod_joint', ", "")) == ignored
    assert HandKinematics(made).lower[0] == pytest.approx(lower)
    words = "'left_tip_joint' have no motor of their own; give that of 'left_crank_joint'"
    with pytest.raises(InvalidInputError, match=words):
        read(tmp_path, gripper(limits), torque_limit={"left_tip_joint": 2.0})


def test_jaws_that_meet_are_no_rods(tmp_path):
    text = (
        link("palm", 0.01)
        + pivot("palm", "left_crank", -0.012, 0.01)
        + rods("left_crank", (0.0, 0.05))
    )
    text += pivot("palm", "short_jaw", 0.012, 0.01, -1.0) + rods("short_jaw", (0.0, 0.035))
    assert read(tmp_path, text)[0].finger_names == ("left_crank", "short_jaw")


def test_of_two_hands_on_a_flange_one_is_read(tmp_path):
    """The flange is kept. Without `palm` both are read as one hand, with a note."""
    text = link("flange")
    for side in "lr":
        text += joint(f"{side}mount", "flange", f"{side}palm", kind="fixed")
        text += hand(f"{side}palm", side)
    made, told = read(tmp_path, text, palm="lpalm")
    alone, _ = read(tmp_path, hand("lpalm", "l"))
    assert (made.links, made.finger_names) == (alone.links, alone.finger_names)
    assert "limbs that the palm 'lpalm' does not carry are left out, with the joints " in told
    both, told = read(tmp_path, text)
    assert both.finger_count == 2 * made.finger_count
    assert (
        "the links 'lpalm', 'rpalm' carry several fingers each, which are read as one hand" in told
    )
    # a flange that carries both is no hand of its own
    assert read(tmp_path, text, palm="flange")[0].finger_count == both.finger_count
