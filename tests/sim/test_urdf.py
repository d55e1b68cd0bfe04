"""Hands written as URDF and read again, a user's hand, and files that are none."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.check import inertia_matrix, inertia_of
from grasp_env.sim.hand.description import HANDS, Fingertip, HandDescription, Mimic
from grasp_env.sim.hand.frames import Frame, roll_pitch_yaw, rotation_matrix
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.urdf import hand_urdf

CROOKED = Path(__file__).parent / "assets" / "crooked_hand.urdf"
CROOKED_TIPS = ("pad_a", "finger_b_end", "finger_c_end")
ENDLESS = {"b_root": (-math.inf, math.inf)}

INERTIAL = '<inertial><mass value="0.1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/></inertial>'
SPHERE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
JOINT = (
    '<joint name="bend" type="revolute"><parent link="palm"/><child link="finger"/><axis xyz="0 0 2"/>'
    '<limit lower="-1" upper="1" effort="2" velocity="1"/></joint>'
)
SMALL = f'<robot name="small"><link name="palm"/>{JOINT}<link name="finger">{INERTIAL}{SPHERE}</link></robot>'


def read(folder: Path, text: str, tips: tuple[str, ...] = ("finger",), **options: Any) -> HandDescription:
    path = folder / "hand.urdf"
    path.write_text(text, encoding="utf-8")
    return HandDescription.from_urdf(path, tips, **options)


@pytest.mark.parametrize("name", [*sorted(HANDS), "crooked"])
def test_a_written_hand_reads_as_itself(tmp_path: Path, name: str) -> None:
    hand = HANDS[name]() if name in HANDS else HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS)
    path = tmp_path / "hand.urdf"
    path.write_text(hand_urdf(hand))
    endless = ENDLESS if name == "crooked" else None
    again = HandDescription.from_urdf(path, [tip.link for tip in hand.fingertips], home=hand.home, joint_limits=endless)
    assert (again.links, again.palm, again.name) == (hand.links, hand.palm, hand.name)
    tips = [[(tip.link, tip.center, tip.radius) for tip in each.fingertips] for each in (again, hand)]
    assert name == "crooked" or tips[0] == tips[1]
    assert hand_urdf(again) == path.read_text()
    assert (pickle.loads(pickle.dumps(hand)), hash(hand)) == (hand, hash(replace(hand)))


def test_a_comment_may_stand_before_the_declaration(tmp_path: Path) -> None:
    assert read(tmp_path, f'<!-- a licence -->\n<?xml version="1.0"?>{SMALL}').name == "small"


def test_a_users_hand_is_what_its_file_says() -> None:
    hand = HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS)
    assert hand.joint_names == (
        "c_swing", "palm_fold", "b_root", "b_curl", "a_root", "a_curl", "c_curl", "c_hook", "b_hook",
    )  # fmt: skip
    assert hand.palm.name == "base"
    assert hand.finger_names == CROOKED_TIPS
    assert [tip.link for tip in hand.fingertips] == ["finger_a_mid", "finger_b_end", "finger_c_end"]
    assert hand.torque_limits.tolist() == [4.0, 6.0, 2.5, 3.5, 2.0, 3.0, 4.0, 3.0, 3.0]
    links = {link.joint: link for link in hand.links}
    assert (links["b_root"].lower, links["b_root"].upper) == (-np.inf, np.inf)
    assert hand.home[hand.joint_names.index("b_root")] == 0.0
    assert links["palm_fold"].parent == "base"
    np.testing.assert_allclose(links["b_hook"].axis, np.array([0.0, 0.9, -0.1]) / np.sqrt(0.82), atol=1e-15)
    assert links["a_root"].color == (0.1, 0.2, 0.9)
    assert hand.palm.visual[0].kind == "box"
    kinematics = HandKinematics(hand)
    shared = kinematics.carries.sum(axis=0)
    assert shared.tolist() == [2 if name == "palm_fold" else 1 for name in hand.joint_names]


def test_fixed_parts_join_the_link_before_them() -> None:
    """finger_a_mid and its pad, put together by hand: mass points instead of frames."""
    link = next(
        link
        for link in HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS).links
        if link.joint == "a_curl"
    )
    place = Frame.of((0.06, 0.003, 0.002), (0.5, 0.6, 0.7))
    parts = [
        (0.04, np.array([0.03, 0.001, 0.0]), rotation_matrix((0.2, 0.1, 0.4)), (4e-6, 1e-6, -5e-7, 2.2e-5, 7e-7, 2e-5)),
        (
            0.012, place.rotation @ (0.001, 0.0, 0.002) + place.origin,
            place.rotation @ rotation_matrix((0.3, 0, 0)), (6e-7, 5e-8, 0, 7e-7, 0, 8e-7),
        ),
    ]  # fmt: skip
    center = sum(mass * at for mass, at, _, _ in parts) / 0.052
    total = np.zeros((3, 3))
    for mass, at, turn, inertia in parts:
        # second moments add: J = integral of r r^T, I = trace(J) 1 - J
        own = turn @ inertia_matrix(inertia) @ turn.T
        moments = 0.5 * np.trace(own) * np.eye(3) - own + mass * np.outer(at - center, at - center)
        total += np.trace(moments) * np.eye(3) - moments
    assert link.mass == pytest.approx(0.052)
    np.testing.assert_allclose(link.center, center, atol=1e-15)
    np.testing.assert_allclose(inertia_matrix(link.inertia), total, atol=1e-18)
    sphere = next(shape for shape in link.collision if shape.kind == "sphere")
    np.testing.assert_allclose(sphere.origin, place.rotation @ (0.002, 0, 0.003) + place.origin, atol=1e-16)


def test_a_users_hand_can_be_put_anywhere() -> None:
    place = Frame.of((0.0, 0.145, 0.02), (1.0, -0.4, 2.0))
    here = HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS)
    there = HandDescription.from_urdf(
        CROOKED, CROOKED_TIPS, joint_limits=ENDLESS, position=(0.0, 0.145, 0.02), rotation=(1.0, -0.4, 2.0)
    )
    angles = np.linspace(-0.3, 0.4, 9)
    expected = HandKinematics(here).tips(angles) @ place.rotation.T + place.origin
    np.testing.assert_allclose(HandKinematics(there).tips(angles), expected, atol=1e-15)


def test_a_hand_is_placed_where_its_place_or_posture_is_given(tmp_path: Path) -> None:
    assert not read(tmp_path, SMALL).placed
    assert read(tmp_path, SMALL, home=(0.5,)).placed
    assert read(tmp_path, SMALL, position=(0.0, 0.0, 0.0)).placed
    assert read(tmp_path, SMALL, rotation=(0.0, 0.0, 1.0)).placed
    assert read(tmp_path, SMALL).moved((0.0, 0.0, 0.0)).placed
    assert HandDescription.four_finger().placed


def test_visual_meshes_are_left_out_and_tip_radius_makes_a_tip(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="nowhere.stl"/></geometry></visual>'
    with pytest.warns(UserWarning, match=r"visual meshes that are missing are left out: 'nowhere.stl'"):
        hand = read(tmp_path, SMALL.replace(SPHERE, mesh), tip_radius=0.012)
    assert hand.fingertips == (Fingertip("finger", "finger", (0.0, 0.0, 0.0), 0.012),)
    assert [shape.kind for shape in hand.links[0].collision] == ["sphere"]
    assert hand.links[0].axis == (0.0, 0.0, 1.0)
    assert [shape.kind for shape in hand.links[0].visual] == ["sphere"]


def test_torques_are_those_given_else_those_of_the_file(tmp_path: Path) -> None:
    for text in (SMALL, SMALL.replace(' effort="2"', ""), SMALL.replace('effort="2"', 'effort="1e4"')):
        assert read(tmp_path, text, torque_limit=3.0).torque_limits.tolist() == [3.0]
        assert read(tmp_path, text, torque_limit=[3.0]).torque_limits.tolist() == [3.0]
        assert read(tmp_path, text, torque_limit={"bend": 3.0}).torque_limits.tolist() == [3.0]
    assert read(tmp_path, SMALL, torque_limit={}).torque_limits.tolist() == [2.0]
    for given in (0.0, [1.0, 2.0], [], {"bent": 1.0}, {"bend": 0.0}, "3", [[1.0]], {3: 1.0}, object()):
        with pytest.raises(InvalidInputError, match="torque_limit"):
            read(tmp_path, SMALL, torque_limit=given)


CHAIN = "".join(
    f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="0.03 0 0"/><axis xyz="0 0 1"/>'
    f'<limit lower="{lower}" upper="{upper}" effort="2"/>{mimic}</joint>'
    for name, kind, parent, child, lower, upper, mimic in (
        ("tip", "revolute", "middle", "end", -3, 3, '<mimic joint="mid" multiplier="-0.5" offset="0.1"/>'),
        ("mid", "revolute", "base", "middle", -3, 3, '<mimic joint="drive" multiplier="1.5" offset="0.2"/>'),
        ("drive", "revolute", "slider", "base", -1, 1, ""),
        ("slide", "prismatic", "palm", "slider", 0, 0.02, ""),
    )
) + "".join(f'<link name="{name}">{INERTIAL}</link>' for name in ("slider", "base", "middle"))
CHAINED = f'<robot name="chained"><link name="palm"/>{CHAIN}<link name="end">{INERTIAL}{SPHERE}</link></robot>'


def test_coupled_and_sliding_joints_are_read(tmp_path: Path) -> None:
    hand = read(tmp_path, CHAINED, ("end",))
    links = {link.joint: link for link in hand.links}
    assert list(links) == ["slide", "drive", "mid", "tip"]
    assert links["slide"].sliding
    assert links["mid"].mimic == Mimic("drive", 1.5, 0.2)
    assert links["tip"].mimic == Mimic("drive", -0.75, 0.0)  # -0.5 (1.5 q + 0.2) + 0.1
    assert hand.drivers == (0, 1, 1, 1)
    again = read(tmp_path, hand_urdf(hand), ("end",))
    assert again.links == hand.links


def test_everything_wrong_with_a_file_is_told_at_once(tmp_path: Path) -> None:
    text = CHAINED.replace('multiplier="1.5"', 'multiplier="x"').replace('lower="-1"', 'lower="2"')
    text = text.replace('<sphere radius="0.01"/>', '<mesh filename="no.stl"/>')
    text = text.replace("</robot>", '<link name="spare"/></robot>')
    with pytest.raises(InvalidInputError) as told:
        read(tmp_path, text, ("nothing",))
    message = str(told.value)
    for fault in ("multiplier=", "lower=2.0", "no.stl", "'palm', 'spare'", "no link is called 'nothing'"):
        assert fault in message
    assert message.count(str(tmp_path / "hand.urdf")) == 1


def test_all_repairs_are_told_at_once(tmp_path: Path) -> None:
    text = SMALL.replace(INERTIAL, "").replace('effort="2"', 'effort="0"')
    text = text.replace(
        SPHERE, SPHERE + SPHERE.replace("collision", "visual").replace('sphere radius="0.01"', 'mesh filename="a.glb"')
    )
    (tmp_path / "a.glb").touch()
    with pytest.warns(UserWarning, match="effort 0 of 'bend'") as told:
        hand = read(tmp_path, text)
    assert len(told) == 1
    message = str(told[0].message)
    assert "without mass get that of their shapes at 1 g/cm^3: 'finger'" in message
    assert "none of .obj, .stl, .dae are left out: 'a.glb'" in message
    volume = 4.0 / 3.0 * np.pi * 0.01**3  # the ball's outline is a little larger
    assert hand.links[0].mass == pytest.approx(1000.0 * volume, rel=0.1)
    assert min(np.linalg.eigvalsh(inertia_matrix(hand.links[0].inertia))) > 0.0


def test_what_turns_too_easily_gets_a_rotor(tmp_path: Path) -> None:
    light = SMALL.replace("1e-5", "1e-7")
    with pytest.warns(
        UserWarning, match="end links have less inertia than any geared motor: finger get a rotor of 0.0001 kg m"
    ):
        hand = read(tmp_path, light)
    np.testing.assert_allclose(np.diag(inertia_matrix(hand.links[0].inertia)), 1.001e-4)
    whole = read(tmp_path, SMALL, rotor_inertia=3e-4)
    np.testing.assert_allclose(np.diag(inertia_matrix(whole.links[0].inertia)), 3.1e-4)


@pytest.mark.parametrize(
    "given",
    [
        (1e-5, 0, 0, 1e-5, 0, 9e-5),  # the largest is above the sum of the others
        (1e-5, 0, 0, -1e-5, 0, 1e-5),
        (1e-5, 5e-5, 0, 1e-5, 0, 1e-5),
    ],
)
def test_inertias_of_no_body_become_the_nearest_of_one(tmp_path: Path, given: tuple[float, ...]) -> None:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    row = " ".join(f'{name}="{value}"' for name, value in zip(names, given, strict=True))
    with pytest.warns(
        UserWarning, match="physically impossible inertias are replaced by the nearest possible ones: 'finger'"
    ):
        hand = read(tmp_path, SMALL.replace('ixx="1e-5" iyy="1e-5" izz="1e-5"', row), rotor_inertia=0.0)
    found = inertia_matrix(hand.links[0].inertia)
    distance = np.linalg.norm(found - inertia_matrix(given))
    rng = np.random.default_rng(0)  # no other body is nearer: second moments are positive, I = tr(S) 1 - S
    for _ in range(2000):
        half = rng.normal(size=(3, 3)) * rng.uniform(0.0, 8e-3)
        second = half @ half.T * rng.uniform(0.0, 1.0, 3).max()
        other = np.trace(second) * np.eye(3) - second
        assert np.linalg.norm(other - inertia_matrix(given)) > 0.98 * distance - 1e-6  # a body's shape is not a plane's
    inertia_of(hand.links[0].inertia, "finger")


def test_a_palm_needs_no_inertia_that_can_be(tmp_path: Path) -> None:
    bad = '<link name="palm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="9"/></inertial></link>'
    assert read(tmp_path, SMALL.replace('<link name="palm"/>', bad)) == read(tmp_path, SMALL)


def test_names_of_all_kinds_are_written_as_xml(tmp_path: Path) -> None:
    hand = read(tmp_path, SMALL.replace('name="bend"', 'name="&lt;bend &amp; &quot;turn&quot;&gt;"'))
    assert hand.joint_names == ('<bend & "turn">',)
    assert ElementTree.fromstring(hand_urdf(hand)).findall("joint")[0].get("name") == '<bend & "turn">'


EXTRA = JOINT.replace('"bend"', '"bend_2"').replace('"finger"', '"finger_2"')
LINK_2 = f'<link name="finger_2">{INERTIAL}</link>'
END, MESH, DRIVE, RATIO = "</robot>", '<sphere radius="0.01"', '<mimic joint="drive"', 'multiplier="1.5"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (END, "", "is not XML: no element found"),
        ("robot", "sdf", "the first element is <sdf>"),
        (END, f'<link name="spare"/>{END}', "2 links are carried by no joint, 'palm', 'spare'"),
        (END, f'<link name="palm"/>{END}', "two links are called 'palm'"),
        (END, f"{JOINT.replace('finger', 'palm')}{END}", "the joints form a cycle|two joints"),
        (END, f"{EXTRA.replace('finger_2', 'finger')}{END}", "'finger' is the child of two joints, 'bend' and"),
        (END, f"{EXTRA}{END}", "joint 'bend_2' names the link 'finger_2', which is not in the file"),
        (END, f"{EXTRA.replace('palm', 'finger_2')}{LINK_2}{END}", "joints 'bend_2' form a cycle apart"),
        ("revolute", "floating", "is of type 'floating'"),
        ("revolute", "fixed", "no joint moves"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "joint 'bend': the axis .* has no direction"),
        ('xyz="0 0 2"', 'xyz="0 0"', "must be 3 numbers, not 2"),
        ('xyz="0 0 2"', 'xyz="0 nan 1"', "must be finite"),
        ('xyz="0 0 2"', 'xyz="0 a 1"', "must be 3 numbers"),
        ('lower="-1"', 'lower="2"', "joint 'bend', <limit> .*lower=2.0 must be below upper=1.0"),
        ('lower="-1"', 'lower="-inf"', "must be finite"),
        ('<child link="finger"/>', "", "joint 'bend' names no child"),
        ('mass value="0.1"', 'mass value="-1"', "mass=-1.0 kg must be above 0"),
        ('mass value="0.1"', "mass", "lacks value="),
        ('izz="1e-5"', "", "lacks izz="),
        ("<sphere", "<mesh", "link 'finger', <collision>, <mesh> lacks filename="),
        (
            MESH,
            '<mesh filename="no.stl"',
            r"neither beside the URDF nor in the 5 folders above it: 'no.stl' \(finger\)",
        ),
        (SPHERE, "", "fingertip 'finger' has no shape to lie in; pass tip_radius="),
        ("<sphere", "<cone", "the shape <cone> is not one of"),
        (f"{MESH}/>", "", "has no shape in its <geometry>"),
        ('radius="0.01"', 'radius="0"', "size=.* must be above 0"),
        ('link name="finger"', "link", "<link> has no name"),
        (DRIVE, '<mimic joint="tip"', "the joints 'mid', 'tip' mimic each other in a loop"),
        (DRIVE, '<mimic joint="mid"', "the joints 'mid' mimic each other in a loop"),
        (DRIVE, '<mimic joint="none"', "'mid' mimics 'none', which is not a joint of the file; joints are"),
        (DRIVE, "<mimic", "joint 'mid', <mimic> lacks joint="),
        (RATIO, 'multiplier="0"', "ratio=0.0 does not move the joint"),
        (RATIO, 'multiplier="x"', "joint 'mid', <mimic>: multiplier="),
        ('name="drive" type="revolute"', 'name="drive" type="fixed"', "mimics 'drive', which does not move"),
    ],
)
def test_files_that_are_no_hand_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text, tip = (SMALL, "finger") if old in SMALL else (CHAINED, "end")
    assert old in text
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, text.replace(old, new), (tip,))


@pytest.mark.parametrize(
    ("tips", "message"),
    [
        (("thumb", "finger", "toe"), "no link is called 'thumb', 'toe'; links are 'palm', 'finger'"),
        (("palm",), "'palm' does not move, it is part of the palm"),
        (("finger", "finger"), "two fingertips are called 'finger'"),
        *((tips, "fingertips=.* must be a list of one link name or more") for tips in ((), 0, [0], "finger", {}, {"finger": 1.0})),
    ],
)  # fmt: skip
def test_fingertips_must_be_moving_links_of_the_file(tmp_path: Path, tips: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, SMALL, tips)
    with pytest.raises(InvalidInputError, match=r"cannot read the file .*check the path"):
        HandDescription.from_urdf(tmp_path / "none.urdf", ("finger",))


def test_angles_and_matrices_are_the_same_rotation() -> None:
    rng = np.random.default_rng(0)
    quarter = np.pi / 2
    cases = [*rng.uniform(-np.pi, np.pi, (200, 3)), (0.3, quarter, 0.7), (0.3, -quarter, 0.7), (0.1, quarter - 1e-9, 2)]
    for angles in cases:
        matrix = rotation_matrix(tuple(angles))
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(rotation_matrix(roll_pitch_yaw(matrix)), matrix, atol=2e-15)
