"""Hands written as URDF and read again, a user's hand, wrong arguments and wrong files."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from urdf_text import INERTIAL, hand, joint, link, read, robot, small, solid

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.description import HANDS, Fingertip, HandDescription, Mimic
from grasp_env.sim.hand.frames import (
    Frame,
    quaternion_rotation,
    roll_pitch_yaw,
    rotation_matrix,
)
from grasp_env.sim.hand.inertia import inertia_matrix, inertia_of
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.urdf import hand_urdf

CROOKED = Path(__file__).parent / "assets" / "crooked_hand.urdf"
CROOKED_TIPS = ("pad_a", "finger_b_end", "finger_c_end")
ENDLESS = {"b_root": (-math.inf, math.inf)}

SPHERE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
SMALL = small(SPHERE)
CHAINED = robot(
    "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="0.03 0 0"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="2"/>{mimic}</joint>'
        for name, kind, parent, child, lower, upper, mimic in (
            (
                "tip",
                "revolute",
                "middle",
                "end",
                -3,
                3,
                '<mimic joint="mid" multiplier="-0.5" offset="0.1"/>',
            ),
            (
                "mid",
                "revolute",
                "base",
                "middle",
                -3,
                0.95,
                '<mimic joint="drive" multiplier="1.5" offset="0.2"/>',
            ),
            ("drive", "revolute", "slider", "base", -1, 1, ""),
            ("slide", "prismatic", "palm", "slider", 0, 0.02, ""),
        )
    )
    + "".join(
        f'<link name="{name}">{INERTIAL}</link>' for name in ("palm", "slider", "base", "middle")
    )
    + f'<link name="end">{INERTIAL}{SPHERE}</link>'
)


def crooked(**options: Any) -> HandDescription:
    return HandDescription.from_urdf(CROOKED, CROOKED_TIPS, joint_limits=ENDLESS, **options)


@pytest.mark.parametrize("name", ["allegro", "four_finger_4dof", "crooked"])
def test_a_written_hand_reads_as_itself(tmp_path, name):
    made = crooked() if name == "crooked" else HANDS[name]()
    path = tmp_path / "hand.urdf"
    path.write_text(hand_urdf(made))
    endless = ENDLESS if name == "crooked" else None
    again = HandDescription.from_urdf(
        path, [tip.link for tip in made.fingertips], home=made.home, joint_limits=endless
    )
    assert (again.links, again.palm, again.name) == (made.links, made.palm, made.name)
    tips = [
        [(tip.link, tip.center, tip.radius) for tip in each.fingertips] for each in (again, made)
    ]
    assert name == "crooked" or tips[0] == tips[1]
    assert hand_urdf(again) == path.read_text()
    assert (pickle.loads(pickle.dumps(made)), hash(made)) == (made, hash(replace(made)))


def test_a_users_hand_is_that_of_its_file():
    """Frames and masses are compared with PyBullet in test_kinematics."""
    made = crooked()
    names = "c_swing palm_fold b_root b_curl a_root a_curl c_curl c_hook b_hook"
    assert made.joint_names == tuple(names.split())
    assert (made.palm.name, made.finger_names) == ("base", CROOKED_TIPS)
    assert made.torque_limits.tolist() == [4.0, 6.0, 2.5, 3.5, 2.0, 3.0, 4.0, 3.0, 3.0]
    endless = made.links[2]
    first = made.links[4]
    assert (endless.lower, endless.upper, made.home[2]) == (-np.inf, np.inf, 0.0)
    assert first.color == (0.1, 0.2, 0.9)
    shared = HandKinematics(made).carries.sum(axis=0)
    assert shared.tolist() == [2 if name == "palm_fold" else 1 for name in made.joint_names]
    with pytest.raises(InvalidInputError, match=r"cannot read the file .*check the path"):
        HandDescription.from_urdf("none.urdf")


def test_a_given_place_or_posture_places_a_hand():
    here = crooked()
    place = Frame.of((0.0, 0.145, 0.02), (1.0, -0.4, 2.0))
    there = crooked(position=(0.0, 0.145, 0.02), rotation=(1.0, -0.4, 2.0))
    angles = np.linspace(-0.3, 0.4, 9)
    expected = HandKinematics(here).tips(angles) @ place.rotation.T + place.origin
    np.testing.assert_allclose(HandKinematics(there).tips(angles), expected, atol=1e-15)
    assert [made.placed for made in (here, there, crooked(home=here.home))] == [False, True, True]
    assert crooked(rotation=(0.0, 0.0, 1.0)).placed


def test_tip_radius_makes_a_tip(tmp_path):
    made, _ = read(tmp_path, small(""), ["finger"], tip_radius=0.012)
    assert made.fingertips == (Fingertip("finger", "finger", (0.0, 0.0, 0.0), 0.012),)
    assert [shape.kind for shape in made.links[0].collision + made.links[0].visual] == [
        "sphere",
        "sphere",
    ]


@pytest.mark.parametrize(("given", "limit"), [([3.0], 3.0), ({"bend": 3.0}, 3.0), ({}, 2.0)])
def test_given_torques_count(tmp_path, given, limit):
    made, told = read(tmp_path, SMALL, torque_limit=given)
    assert (made.torque_limits.tolist(), told) == ([limit], "")


def test_coupled_and_sliding_joints_are_read(tmp_path):
    made, _ = read(tmp_path, CHAINED, ["end"])
    links = {each.joint: each for each in made.links}
    assert list(links) == ["slide", "drive", "mid", "tip"]
    assert [each.sliding for each in made.links] == [True, False, False, False]
    assert links["drive"].axis == (1.0, 0.0, 0.0)  # where a file names none
    assert links["mid"].mimic == Mimic("drive", 1.5, 0.2)
    assert links["tip"].mimic == Mimic("drive", -0.75, 0.0)  # -0.5 (1.5 q + 0.2) + 0.1
    assert made.drivers == (0, 1, 1, 1)
    ranges = np.column_stack([HandKinematics(made).lower, HandKinematics(made).upper])
    # 0.95 = 1.5 * 0.5 + 0.2
    np.testing.assert_allclose(ranges[1:], [(-1.0, 0.5), (-1.3, 0.95), (-0.375, 0.75)])
    assert read(tmp_path, hand_urdf(made), ["end"])[0].links == made.links


def test_all_faults_are_told_at_once(tmp_path):
    text = CHAINED.replace('multiplier="1.5"', 'multiplier="x"').replace('lower="-1"', 'lower="2"')
    text = text.replace('<sphere radius="0.01"/>', '<mesh filename="no.stl"/>')
    with pytest.raises(InvalidInputError) as told:
        read(tmp_path, text.replace("</robot>", '<link name="spare"/></robot>'), ["nothing"])
    for fault in (
        "multiplier=",
        "lower=2.0",
        "no.stl",
        "'palm', 'spare'",
        "no link is called 'nothing'",
    ):
        assert fault in str(told.value)
    assert str(told.value).count(str(tmp_path / "hand.urdf")) == 1


def test_all_repairs_are_told_at_once(tmp_path):
    look = '<visual><geometry><mesh filename="a.glb"/></geometry></visual>'
    (tmp_path / "a.glb").touch()
    text = small(SPHERE + look).replace(INERTIAL, "").replace('effort="2"', 'effort="0"')
    _, told = read(tmp_path, f'<!-- a licence -->\n<?xml version="1.0"?>{text}')
    for repair in (
        "effort 0 of 'bend'",
        "get that of their shapes at 1 g/cm^3: 'finger'",
        "not one of .obj, .stl, .dae are left out: 'a.glb'",
    ):
        assert repair in told


def test_links_with_too_little_inertia_get_a_rotor(tmp_path):
    made, told = read(tmp_path, SMALL.replace("1e-5", "1e-7"), rotor_inertia=None)
    assert (
        "end links have less inertia than any geared motor: finger get a rotor of 0.0001 kg m^2"
        in told
    )
    np.testing.assert_allclose(np.diag(inertia_matrix(made.links[0].inertia)), 1.001e-4)
    whole, _ = read(tmp_path, SMALL, rotor_inertia=3e-4)
    np.testing.assert_allclose(np.diag(inertia_matrix(whole.links[0].inertia)), 3.1e-4)


@pytest.mark.parametrize("given", [(1e-5, 0, 0, 1e-5, 0, 9e-5), (1e-5, 5e-5, 0, 1e-5, 0, 1e-5)])
def test_impossible_inertias_become_the_nearest(tmp_path, given):
    """The largest moment exceeds the sum of the others, or one is negative; the palm's inertia is
    not judged."""
    row = " ".join(
        f'{name}="{value}"'
        for name, value in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), given, strict=True)
    )
    bad = INERTIAL.replace('ixx="1e-5" iyy="1e-5" izz="1e-5"', row)
    made, told = read(tmp_path, small(SPHERE, palm=bad).replace(INERTIAL, bad))
    assert (
        "principal moments that no body can have are replaced by the nearest possible ones: 'finger' ("
        in told
    )
    assert "'palm'" not in told
    inertia_of(made.links[0].inertia, "finger")
    wrong = inertia_matrix(given)
    # no other body is nearer: second moments S are positive, I = tr(S) 1 - S; a body's shape is not
    # a plane's
    rng = np.random.default_rng(0)
    halves = rng.normal(size=(2000, 3, 3)) * rng.uniform(0.0, 8e-3, (2000, 1, 1))
    others = np.einsum("nij,nij->n", halves, halves)[:, None, None] * np.eye(
        3
    ) - halves @ halves.transpose(0, 2, 1)
    distance = np.linalg.norm(inertia_matrix(made.links[0].inertia) - wrong)
    assert np.linalg.norm(others - wrong, axis=(1, 2)).min() > 0.98 * distance - 1e-6


EXTRA = joint("bend_2", "palm", "finger_2")
END = "</robot>"
DRIVE = '<mimic joint="drive"'
RATIO = 'multiplier="1.5"'


NO_HAND = [
    (END, "", "is not XML: no element found"),
    (END, f'<link name="palm"/>{END}', "two links are called 'palm'"),
    (
        END,
        f"{EXTRA.replace('finger_2', 'finger')}{END}",
        "'finger' is the child of two joints, 'bend' and",
    ),
    (END, f"{EXTRA}{END}", "joint 'bend_2' names the link 'finger_2', which is not in the file"),
    (
        END,
        f"{EXTRA.replace('palm', 'finger_2')}{link('finger_2')}{END}",
        "joints 'bend_2' form a cycle apart",
    ),
    (SPHERE, SPHERE * 2001, "2001 shapes, allowed are up to 2000"),
    (END, '<link name="l"/>' * 499 + END, "501 links and 1 joints, allowed are up to 500"),
    ("revolute", "floating", "is of type 'floating'"),
    ("revolute", "fixed", "no joint moves"),
    ('xyz="0 2 0"', 'xyz="0 0 0"', "joint 'bend': the axis .* has no direction"),
    ('xyz="0 2 0"', 'xyz="0 0"', r"must have shape \(3,\), got \(2,\)"),
    ('lower="-1"', 'lower="2"', "joint 'bend', <limit> .*lower=2.0 must be below upper=1.0"),
    ('<child link="finger"/>', "", "joint 'bend' names no child"),
    ('mass value="0.1"', 'mass value="-1"', "mass=-1.0 kg must be above 0"),
    (SPHERE, "", "fingertip 'finger' has no shape to lie in; pass tip_radius="),
    ("<sphere", "<cone", "the shape <cone> is not one of"),
    ('radius="0.01"', 'radius="0"', "size=.* must be above 0"),
    ('link name="finger"', "link", "<link> has no name"),
    (DRIVE, '<mimic joint="tip"', "the joints 'mid', 'tip' mimic each other in a loop"),
    (
        DRIVE,
        '<mimic joint="none"',
        "'mid' mimics 'none', which is not a joint of the file; joints are",
    ),
    (
        'name="drive" type="revolute"',
        'name="drive" type="fixed"',
        "mimics 'drive', which does not move",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), NO_HAND)
def test_files_that_are_no_hand_are_refused(tmp_path, old, new, message):
    text, tip = (SMALL, "finger") if old in SMALL else (CHAINED, "end")
    assert old in text
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, text.replace(old, new), [tip])


WRONG = [
    *(
        ({"torque_limit": given}, "torque_limit")
        for given in (0.0, [1.0, 2.0], {"ja": 1.0}, {"ia": 0.0}, "3")
    ),
    ({"joint_limits": {"ia": 1.0}}, r"joint_limits of 'ia'=1.0 must be \(lower, upper\)"),
    ({"joint_limits": [(0.0, 1.0)]}, "joint_limits=.* must be a dict with names of joints as keys"),
    (
        {"inertials": {"palm": 0.1}},
        "inertials: no moving link is called 'palm'; moving links are 'i1'",
    ),
    (
        {"inertials": {"i1": (0.1, (0, 0, 0))}},
        r"must be a mass \[kg\], or \(mass, center, inertia\)",
    ),
    (
        {"inertials": {"i1": (0.1, (0, 0, 0), (1, 0, 0, 1, 0, 9))}},
        "inertials of 'i1': inertia=.* the principal moments",
    ),
    ({"fingertips": ("palm",)}, "'palm' does not move, it is part of the palm"),
    ({"fingertips": ("i1", "i1")}, "two fingertips are called 'i1'"),
    *(
        ({"fingertips": tips}, "fingertips=.* must be a list of one link name or more")
        for tips in ((), 0, "i1", {"i1": 1.0})
    ),
    ({"fingertips": {"i1": ((0.0, 0.0, 0.0), -1.0)}}, "fingertips: radius .* must be a number > 0"),
    ({"palm": ""}, "palm='' must be a name"),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_wrong_arguments_are_refused(tmp_path, options, message):
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, hand(), **options)


def test_angles_and_matrices_are_the_same_rotation():
    rng = np.random.default_rng(0)
    quarter = np.pi / 2
    cases = [
        *rng.uniform(-np.pi, np.pi, (100, 3)),
        (0.3, quarter, 0.7),
        (0.3, -quarter, 0.7),
        (0.1, quarter - 1e-9, 2),
    ]
    for angles in cases:
        matrix = rotation_matrix(tuple(angles))
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(rotation_matrix(roll_pitch_yaw(matrix)), matrix, atol=2e-15)


def test_a_quaternion_is_the_rotation_of_its_axis_and_angle():
    for turn in Rotation.random(20, random_state=3):
        matrix = quaternion_rotation(turn.as_quat())
        np.testing.assert_allclose(matrix, turn.as_matrix(), atol=2e-15)


def test_a_joint_that_mimics_with_ratio_0_holds_still_at_its_offset(tmp_path):
    made, told = read(tmp_path, CHAINED.replace(RATIO, 'multiplier="0"'), ["end"])
    assert "or a mimic multiplier of 0 hold still: 'tip', 'mid'" in told
    assert [link.joint for link in made.links] == ["slide", "drive"]
    moving = HandKinematics(read(tmp_path, CHAINED, ["end"])[0])
    # where the driver is at 0, a coupled joint is at its offset, too
    assert np.allclose(
        HandKinematics(made).tips(np.array([0.01, 0.0])),
        moving.tips(moving.coupled(np.array([0.01, 0.0, 0.0, 0.0]))),
        atol=1e-12,
    )


def test_links_that_are_only_drawn_are_told(tmp_path):
    drawn = solid('<box size="0.03 0.01 0.01"/>', role="visual")
    _, told = read(tmp_path, small(SPHERE, palm=drawn))
    assert "links without collision shapes are drawn and touch nothing: 'palm'" in told
    assert "touch nothing" not in read(tmp_path, small(SPHERE + drawn))[1]


def test_digits_that_a_file_rounds_are_not_told(tmp_path):
    rounded = INERTIAL.replace(
        'ixx="1e-5" iyy="1e-5" izz="1e-5"', 'ixx="1e-5" iyy="1e-5" izz="2.001e-5"'
    )
    made, told = read(tmp_path, SMALL.replace(INERTIAL, rounded))
    assert "moments" not in told
    inertia_of(made.links[0].inertia, "finger")
