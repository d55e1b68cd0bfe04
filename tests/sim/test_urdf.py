"""Hands written as URDF and read again, a user's hand, and files that are none."""

from __future__ import annotations

import pickle
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


@pytest.mark.parametrize("name", sorted(HANDS))
def test_a_written_hand_reads_as_itself(tmp_path: Path, name: str) -> None:
    hand = HANDS[name]()
    path = tmp_path / "hand.urdf"
    path.write_text(hand_urdf(hand))
    again = HandDescription.from_urdf(path, [tip.link for tip in hand.fingertips], home=hand.home)
    assert again.links == hand.links
    assert again.palm == hand.palm
    assert again.name == name
    assert [(tip.link, tip.center, tip.radius) for tip in again.fingertips] == [
        (tip.link, tip.center, tip.radius) for tip in hand.fingertips
    ]
    assert hand_urdf(again) == path.read_text()


def test_a_users_hand_writes_and_reads_as_itself(tmp_path: Path) -> None:
    hand = HandDescription.from_urdf(CROOKED, CROOKED_TIPS)
    path = tmp_path / "hand.urdf"
    path.write_text(hand_urdf(hand))
    again = HandDescription.from_urdf(path, [tip.link for tip in hand.fingertips])
    assert again.links == hand.links
    assert again.palm == hand.palm
    assert hand_urdf(again) == path.read_text()
    assert pickle.loads(pickle.dumps(hand)) == hand
    assert hash(hand) == hash(HandDescription.from_urdf(CROOKED, CROOKED_TIPS))


def test_a_users_hand_is_what_its_file_says() -> None:
    hand = HandDescription.from_urdf(CROOKED, CROOKED_TIPS)
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
    assert dict(zip(hand.joint_names, shared.tolist(), strict=True)) == dict.fromkeys(hand.joint_names, 1) | {
        "palm_fold": 2
    }


def test_fixed_parts_join_the_link_before_them() -> None:
    """finger_a_mid and its pad, put together by hand: mass points instead of frames."""
    link = next(link for link in HandDescription.from_urdf(CROOKED, CROOKED_TIPS).links if link.joint == "a_curl")
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
    here = HandDescription.from_urdf(CROOKED, CROOKED_TIPS)
    there = HandDescription.from_urdf(CROOKED, CROOKED_TIPS, position=(0.0, 0.145, 0.02), rotation=(1.0, -0.4, 2.0))
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
    for effort in ("", 'effort="0"', 'effort="-2"', 'effort="1000"'):
        with pytest.warns(
            UserWarning, match=r"effort.* of 'bend' is no motor's limit: 1 N m is assumed .* torque_limit="
        ):
            assert read(tmp_path, SMALL.replace('effort="2"', effort)).torque_limits.tolist() == [1.0]
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


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mimic joint="drive"', '<mimic joint="tip"', "the joints 'mid', 'tip' mimic each other in a loop"),
        ('<mimic joint="drive"', '<mimic joint="mid"', "the joints 'mid' mimic each other in a loop"),
        (
            '<mimic joint="drive"',
            '<mimic joint="none"',
            "'mid' mimics 'none', which is no joint of the file; joints are",
        ),
        ('<mimic joint="drive"', "<mimic", "joint 'mid', <mimic> lacks joint="),
        ('multiplier="1.5"', 'multiplier="0"', "ratio=0.0 does not move the joint"),
        ('multiplier="1.5"', 'multiplier="x"', "joint 'mid', <mimic>: multiplier="),
        ('name="drive" type="revolute"', 'name="drive" type="fixed"', "mimics 'drive', which does not move"),
    ],
)
def test_couplings_that_cannot_be_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in CHAINED
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, CHAINED.replace(old, new), ("end",))


def test_everything_wrong_with_a_file_is_told_at_once(tmp_path: Path) -> None:
    text = (
        CHAINED.replace('multiplier="1.5"', 'multiplier="x"')
        .replace('lower="-1"', 'lower="2"')
        .replace('<sphere radius="0.01"/>', '<mesh filename="no.stl"/>')
        .replace("</robot>", '<link name="spare"/></robot>')
    )
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
    for repair in (
        "effort 0 of 'bend'",
        "without mass get that of their shapes at 1 g/cm^3: finger",
        "none of .obj, .stl, .dae are left out: 'a.glb'",
    ):
        assert repair in str(told[0].message)
    volume = 4.0 / 3.0 * np.pi * 0.01**3
    assert hand.links[0].mass == pytest.approx(
        1000.0 * volume, rel=0.1
    )  # of the ball's outline, which is a little larger
    assert min(np.linalg.eigvalsh(inertia_matrix(hand.links[0].inertia))) > 0.0


def test_degrees_grams_and_millimetres_are_told(tmp_path: Path) -> None:
    strange = SMALL.replace('lower="-1" upper="1"', 'lower="-30" upper="90"').replace(
        'mass value="0.1"', 'mass value="100"'
    )
    strange = strange.replace('radius="0.01"', 'radius="10"')
    with pytest.warns(UserWarning, match="look again") as told:
        read(tmp_path, strange)
    for words in ("'bend' are wider than two turns", "'finger' weigh more than 5 kg", "have a radius above 0.2 m"):
        assert words in str(told[0].message)


def test_a_link_without_mass_and_shape_gets_a_gram(tmp_path: Path) -> None:
    text = CHAINED.replace(f'<link name="base">{INERTIAL}</link>', '<link name="base"/>')
    with pytest.warns(UserWarning, match=r"base \(1 g\)"):
        hand = read(tmp_path, text, ("end",))
    assert hand.links[1].mass == 1e-3


def test_what_turns_too_easily_gets_a_rotor(tmp_path: Path) -> None:
    light = SMALL.replace('ixx="1e-5" iyy="1e-5" izz="1e-5"', 'ixx="1e-7" iyy="1e-7" izz="1e-7"').replace(
        '<mass value="0.02"/>', '<mass value="0.0005"/>'
    )
    with pytest.warns(UserWarning, match="turn more easily than any geared motor: finger get a rotor's 0.0001 kg m"):
        hand = read(tmp_path, light)
    np.testing.assert_allclose(np.diag(inertia_matrix(hand.links[0].inertia)), 1.001e-4)
    whole = read(tmp_path, SMALL, rotor_inertia=3e-4)
    np.testing.assert_allclose(np.diag(inertia_matrix(whole.links[0].inertia)), 3.1e-4)


def test_a_centre_of_mass_far_outside_its_link_is_put_inside(tmp_path: Path) -> None:
    """As in a public hand, whose fingers' masses lie 0.29 m away: 100 times the inertia that they have."""
    text = SMALL.replace("<inertial>", '<inertial><origin xyz="0.3 0 0"/>', 1)
    with pytest.warns(UserWarning, match="centres of mass .* are put inside: 'finger'"):
        hand = read(tmp_path, text)
    assert np.abs(hand.links[0].center).max() < 0.05


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((1e-5, 0, 0, 1e-5, 0, 9e-5), None),  # the largest is above the sum of the others
        ((1e-5, 0, 0, -1e-5, 0, 1e-5), None),
        ((0, 0, 0, 0, 0, 0), (2e-7, 0, 0, 2e-7, 0, 2e-7)),  # a radius of gyration of 1 mm along each axis
        ((1e-5, 5e-5, 0, 1e-5, 0, 1e-5), None),
    ],
)
def test_inertias_of_no_body_become_the_nearest_of_one(tmp_path: Path, given: tuple[float, ...], expected: Any) -> None:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    row = " ".join(f'{name}="{value}"' for name, value in zip(names, given, strict=True))
    with pytest.warns(UserWarning, match="inertias that no body has are replaced by the nearest possible: 'finger'"):
        hand = read(tmp_path, SMALL.replace('ixx="1e-5" iyy="1e-5" izz="1e-5"', row), rotor_inertia=0.0)
    found = inertia_matrix(hand.links[0].inertia)
    if expected is not None:
        np.testing.assert_allclose(found, inertia_matrix(expected), atol=1e-18)
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


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</robot>", "", "is not XML: .*xacro"),
        ("robot", "sdf", "the first element is <sdf>"),
        ("</robot>", '<link name="spare"/></robot>', "2 links are carried by no joint, 'palm', 'spare'"),
        ("</robot>", '<link name="palm"/></robot>', "two links are called 'palm'"),
        ("</robot>", f"{JOINT.replace('finger', 'palm')}</robot>", "the joints form a cycle|two joints"),
        ("</robot>", f"{EXTRA.replace('finger_2', 'finger')}</robot>", "'finger' hangs on two joints, 'bend' and"),
        ("</robot>", f"{EXTRA}</robot>", "joint 'bend_2' names the link 'finger_2', which is not in the file"),
        ("</robot>", f"{EXTRA.replace('palm', 'finger_2')}{LINK_2}</robot>", "joints 'bend_2' form a cycle apart"),
        (
            '<parent link="palm"/>',
            '<parent link="finger"/>',
            "joints 'bend' form a cycle apart from 'palm'",
        ),
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
        ('<sphere radius="0.01"', '<mesh filename="no.stl"', "there is no mesh 'no.stl' beside the URDF or in the"),
        ("</joint>", '<mimic joint="other"/></joint>', "joint 'bend' mimics 'other', which is no joint of the file"),
        ("</joint>", '<mimic joint="bend"/></joint>', "the joints 'bend' mimic each other in a loop"),
        (SPHERE, "", "fingertip 'finger' has no shape to lie in; pass tip_radius="),
        ("<sphere", "<cone", "the shape <cone> is none of"),
        ('<sphere radius="0.01"/>', "", "has no shape in its <geometry>"),
        ('radius="0.01"', 'radius="0"', "size=.* must be above 0"),
        ('link name="finger"', "link", "<link> has no name"),
    ],
)
def test_files_that_are_no_hand_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SMALL
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, SMALL.replace(old, new))


def test_fingertips_must_be_moving_links_of_the_file(tmp_path: Path) -> None:
    assert read(tmp_path, SMALL).joint_count == 1
    with pytest.raises(InvalidInputError, match="no link is called 'thumb', 'toe'; links are 'palm', 'finger'"):
        read(tmp_path, SMALL, ("thumb", "finger", "toe"))
    with pytest.raises(InvalidInputError, match="'palm' does not move, it is part of the palm"):
        read(tmp_path, SMALL, ("palm",))
    with pytest.raises(InvalidInputError, match="two fingertips are called 'finger'"):
        read(tmp_path, SMALL, ("finger", "finger"))
    with pytest.raises(InvalidInputError, match=r"fingertips=\(\) must be a list of one link name or more"):
        read(tmp_path, SMALL, ())
    with pytest.raises(InvalidInputError, match="must be a list"):
        HandDescription.from_urdf(CROOKED, "pad_a")
    with pytest.raises(InvalidInputError, match=r"cannot read the URDF .*check the path"):
        HandDescription.from_urdf(tmp_path / "none.urdf", ("finger",))


def test_angles_and_matrices_are_the_same_rotation() -> None:
    rng = np.random.default_rng(0)
    quarter = np.pi / 2
    cases = [*rng.uniform(-np.pi, np.pi, (200, 3)), (0.3, quarter, 0.7), (0.3, -quarter, 0.7), (0.1, quarter - 1e-9, 2)]
    for angles in cases:
        matrix = rotation_matrix(tuple(angles))
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(rotation_matrix(roll_pitch_yaw(matrix)), matrix, atol=2e-15)
