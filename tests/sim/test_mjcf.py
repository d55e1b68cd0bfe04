"""Hands from MuJoCo models: MuJoCo itself says where the links are, how heavy they are and what moves them."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import mujoco as compiled
import numpy as np
import pytest

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandDescription, HandKinematics
from grasp_env.sim.hand.frames import Frame

mujoco: Any = compiled  # it has no types

CROOKED = """<mujoco model="crooked"><compiler angle="radian"/>
<worldbody><geom type="plane" size="1 1 0.1"/>
 <body name="base" pos="0.1 0.2 0.3" quat="0.9 0.1 0.3 0.2"><geom type="box" size="0.03 0.04 0.01"/>
  <body name="a" pos="0.02 0.03 0.01" euler="0.3 0.2 0.1">
   <joint name="turn" axis="1 2 2" pos="0.01 -0.02 0.005" range="-0.5 1.2" ref="0.2" armature="0.003"/>
   <geom type="capsule" size="0.008 0.02" pos="0 0 0.02" mass="0.05"/>
   <body name="mount" pos="0.003 0 0.01" euler="0.4 0 0"><geom type="ellipsoid" size="0.01 0.006 0.008" mass="0.01"/>
    <body name="b" pos="0 0.01 0.05" quat="0.8 0.2 0 0.5">
     <joint name="slide" type="slide" axis="0 1 0" range="-0.01 0.02" ref="0.005"/>
     <geom type="cylinder" size="0.006 0.015" pos="0 0 0.015" mass="0.04"/>
     <geom name="pad" size="0.008" pos="0.001 0 0.035" mass="0.01"/><site name="touch" pos="0 0.002 0.03" size="0.006"/>
    </body></body></body>
  <body name="c" pos="-0.03 0 0.01" euler="1 0 0.2">
   <joint name="side" axis="0 0 1" pos="0.004 0 0" range="-0.4 0.4"/><joint name="bend" axis="0 1 0" pos="0 0 0.01" range="-1 1"/>
   <geom size="0.01" pos="0 0 0.05" mass="0.03"/></body></body></worldbody>
<actuator><position joint="turn" kp="1" forcerange="-2 3" gear="2"/><motor joint="slide" gear="5" ctrlrange="-4 4"/>
 <general joint="side"/><motor joint="bend" ctrlrange="-0.9 0.9"/></actuator></mujoco>"""


def read(
    folder: Path, text: str, *arguments: Any, name: str = "hand.xml", **options: Any
) -> tuple[HandDescription, str]:
    """A hand from a text, and its warning."""
    path = folder / name
    path.write_text(text)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        hand = HandDescription.from_mjcf(path, *arguments, **options)
    return hand, str(told[0].message) if told else ""


def test_links_are_where_mujoco_has_them(tmp_path: Path) -> None:
    hand, _ = read(tmp_path, CROOKED, ["pad", "touch", "c"], rotor_inertia=0.0)
    assert (hand.name, hand.palm.name, hand.joint_names) == ("crooked", "base", ("turn", "slide", "side", "bend"))
    model = mujoco.MjModel.from_xml_string(CROOKED)
    data, kinematics, rng = mujoco.MjData(model), HandKinematics(hand), np.random.default_rng(0)
    places = {
        "pad": lambda: data.geom("pad").xpos,
        "touch": lambda: data.site("touch").xpos,
        "c": lambda: data.geom(model.ngeom - 1).xpos,
    }
    for _ in range(20):
        angles = kinematics.lower + rng.random(4) * (kinematics.upper - kinematics.lower)
        for name, angle in zip(hand.joint_names, angles, strict=True):
            data.joint(name).qpos[:] = angle
        mujoco.mj_forward(model, data)
        base = Frame(data.body("base").xmat.reshape(3, 3), data.body("base").xpos)
        for name, tip in zip(hand.finger_names, kinematics.tips(angles), strict=True):
            assert base.rotation @ tip + base.origin == pytest.approx(places[name](), abs=1e-12)
    assert [tip.radius for tip in hand.fingertips] == pytest.approx([0.008, 0.006, 0.01])


def test_masses_are_those_of_mujoco(tmp_path: Path) -> None:
    text = CROOKED.replace('armature="0.003"', "")
    text = text.replace('<joint name="bend" axis="0 1 0" pos="0 0 0.01" range="-1 1"/>', "").replace(
        '<motor joint="bend" ctrlrange="-0.9 0.9"/>', ""
    )
    hand, _ = read(tmp_path, text, rotor_inertia=0.0)
    model = mujoco.MjModel.from_xml_string(text)
    data, angles = mujoco.MjData(model), np.array([0.7, 0.012, -0.2])
    data.qpos[:] = angles
    mujoco.mj_forward(model, data)
    full = np.empty((3, 3))
    mujoco.mj_fullM(model, data, full)
    assert HandKinematics(hand).mass_matrix(angles) == pytest.approx(full, rel=1e-9)


def test_ranges_efforts_and_rotors_are_those_of_the_file(tmp_path: Path) -> None:
    hand, told = read(tmp_path, CROOKED)
    assert [(link.lower, link.upper) for link in hand.links] == [(-0.5, 1.2), (-0.01, 0.02), (-0.4, 0.4), (-1.0, 1.0)]
    assert hand.torque_limits.tolist()[:2] + hand.torque_limits.tolist()[3:] == [6.0, 20.0, 0.9]
    assert "'side'" in told
    assert "torque_limit=" in told
    weaker, _ = read(tmp_path, CROOKED.replace('axis="0 0 1"', 'axis="0 0 1" actuatorfrcrange="-0.2 0.2"').replace(
        '<general joint="side"/>', '<general joint="side" forcerange="-3 3"/>'))  # fmt: skip
    assert weaker.torque_limits[2] == 0.2
    bare, _ = read(tmp_path, CROOKED.replace('armature="0.003"', ""))
    more = np.array(hand.links[0].inertia) - np.array(bare.links[0].inertia)
    assert more == pytest.approx([0.003, 0.0, 0.0, 0.003, 0.0, 0.003], abs=1e-12)


def test_radians_that_mujoco_takes_for_degrees(tmp_path: Path) -> None:
    text = FINGERS.format(one="", two='ref="0.5"', more="")
    meant, _ = read(tmp_path, text)
    hand, told = read(tmp_path, text.replace('angle="radian"', ""))
    assert "without angle='radian' in <compiler> ranges are degrees" in told
    ranges = [[(link.lower, link.upper) for link in each.links] for each in (hand, meant)]
    assert np.array(ranges[0]) == pytest.approx(np.array(ranges[1]), abs=1e-12)
    tips = [HandKinematics(each).tips([0.3, 0.7, 0.1]) for each in (hand, meant)]
    assert tips[0] == pytest.approx(tips[1], abs=1e-12)


def test_a_scene_is_read_without_its_floor_and_objects(tmp_path: Path) -> None:
    held = '<body name="ball" pos="0 0 1"><freejoint/><geom size="0.03"/></body></worldbody>'
    hand, told = read(tmp_path, CROOKED.replace("</worldbody>", held))
    assert [(shape.kind, shape.size) for shape in hand.palm.collision] == [("box", (0.06, 0.08, 0.02))]
    assert all(link.name != "ball" for link in hand.links)
    free, told = read(
        tmp_path, CROOKED.replace('quat="0.9 0.1 0.3 0.2">', 'quat="0.9 0.1 0.3 0.2"><freejoint name="float"/>')
    )
    assert free.joint_names == hand.joint_names
    assert "joints without a motor hold still in the file's posture: 'float'" in told


FINGERS = """<mujoco><compiler angle="radian"/><option gravity="-300 0 0"/><worldbody><body name="palm"><geom type="box" size="0.03 0.03 0.01"/>
 <body name="p1" pos="0 0 0.02"><joint name="j1" axis="0 1 0" range="0 1.5" {one}/><geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.04"/>
  <body name="p2" pos="0 0 0.04"><joint name="j2" axis="0 1 0" range="0 1.5" {two}/><geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.03"/>
  </body></body>
 <body name="q1" pos="0.04 0 0.02"><joint name="k1" axis="0 1 0" range="-1 1"/><geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.05"/></body>
</body></worldbody>{more}</mujoco>"""


@pytest.mark.parametrize(
    ("options", "pair", "line", "limit"),
    [
        # an equality of joints
        ({"more": '<equality><joint joint1="j2" joint2="j1" polycoef="0.1 0.8"/></equality>'
                  '<actuator><motor joint="j1" ctrlrange="-3 3"/><motor joint="k1"/></actuator>'}, ("j1", "j2"), (0.8, 0.1), 3.0),
        # a tendon over both joints, with springs that share the motion 1 : 2
        ({"one": 'stiffness="0.4" springref="0"', "two": 'stiffness="0.1" springref="0"',
          "more": '<tendon><fixed name="t"><joint joint="j1" coef="0.02"/><joint joint="j2" coef="0.01"/></fixed></tendon>'
                  '<actuator><motor tendon="t" ctrlrange="0 12" forcerange="0 50" forcelimited="true"/><motor joint="k1"/></actuator>'},
         ("j2", "j1"), (0.5, 0.0), 50.0 * (0.01 + 0.02 * 0.5)),
        # a range of a tendon so narrow that it couples
        ({"more": '<tendon><fixed limited="true" range="-0.0005 0.0005"><joint joint="j1" coef="0.01"/><joint joint="j2" coef="-0.01"/></fixed>'
                  '</tendon><actuator><motor joint="j1" ctrlrange="-3 3"/><motor joint="k1"/></actuator>'}, ("j1", "j2"), (1.0, 0.0), 3.0),
    ],
    ids=["equality", "tendon", "narrow"],
)  # fmt: skip
def test_joints_that_share_a_motor_are_coupled(
    tmp_path: Path, options: dict[str, str], pair: tuple[str, str], line: tuple[float, float], limit: float
) -> None:
    hand, told = read(tmp_path, FINGERS.format(**{"one": "", "two": "", **options}))
    links = {link.joint: link for link in hand.links}
    first, second = links[pair[0]], links[pair[1]]
    assert second.mimic is not None
    assert second.mimic.joint == pair[0]
    assert (second.mimic.ratio, second.mimic.offset) == pytest.approx(line, abs=0.03)
    assert first.torque_limit == pytest.approx(limit, rel=0.02)
    assert f"joints that share a motor are coupled as MuJoCo moves them: {pair[1]} = " in told


JAWS = """<mujoco><compiler angle="radian"/><option {option}/><worldbody><body name="palm"><geom type="box" size="0.06 0.02 0.01"/>
 <body name="wheel"><joint name="m" axis="0 0 1" range="0 6"/><geom size="0.01"/></body>
 <body name="l" pos="-0.05 0 0.05"><joint name="a" type="slide" axis="1 0 0" {a}/><geom type="box" size="0.01 0.01 0.03"/></body>
 <body name="r" pos="0.05 0 0.05"><joint name="b" type="slide" axis="-1 0 0" {b}/><geom type="box" size="0.01 0.01 0.03"/></body>
 </body></worldbody><equality>{equality}</equality><actuator><motor joint="{motor}"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("a", "b", "motor", "equality", "lines"),
    [
        ('range="0 0.04"', 'range="0 0.025"', "a", '<joint joint1="b" joint2="a"/>', {"b": (1.0, 0.0)}),
        ("", 'range="0 0.04"', "a", '<joint joint1="b" joint2="a"/>', {"b": (1.0, 0.0)}),
        ('range="0 0.04"', "", "a", '<joint joint1="b" joint2="a"/>', {"b": (1.0, 0.0)}),
        ('range="0 0.04"', 'range="0 0.04"', "b", '<joint joint1="b" joint2="a" polycoef="0.004 0.5"/>', {"a": (2.0, -0.008)}),
        ('range="0 0.04"', 'range="0 0.04"', "m", '<joint joint1="a" joint2="m" polycoef="0 0.0055 0 0 0"/>'
         '<joint joint1="b" joint2="m" polycoef="0 0.0004 0 0 0"/>', {"a": (0.0055, 0.0), "b": (0.0004, 0.0)}),
    ],
    ids=["shorter", "free driver", "free follower", "inverse", "rack"],
)  # fmt: skip
def test_equalities_of_jaws_are_read_exactly(
    tmp_path: Path, a: str, b: str, motor: str, equality: str, lines: dict[str, tuple[float, float]]
) -> None:
    for option in ("", 'timestep="0.5"'):
        hand, _ = read(tmp_path, JAWS.format(option=option, a=a, b=b, motor=motor, equality=equality))
        found = {link.joint: link.mimic for link in hand.links if link.mimic is not None}
        assert {joint: (line.ratio, line.offset) for joint, line in found.items()} == {
            joint: (pytest.approx(ratio, rel=1e-9), pytest.approx(offset, abs=1e-9))
            for joint, (ratio, offset) in lines.items()
        }


def test_a_jaw_ends_away_from_the_palm_wherever_its_frame_is(tmp_path: Path) -> None:
    hand, _ = read(
        tmp_path,
        JAWS.format(
            option="", a='range="0 0.04"', b='range="0 0.04"', motor="a", equality='<joint joint1="b" joint2="a"/>'
        ),
    )
    assert all(tip.center[2] > 0.01 for tip in hand.fingertips)


def test_names_that_are_made_up_are_free(tmp_path: Path) -> None:
    text = (
        FINGERS.format(one="", two="", more="")
        .replace('name="palm"', 'name="body3"')
        .replace('name="p2" ', "")
        .replace('name="p1" ', "")
    )
    hand, _ = read(tmp_path, text)
    assert hand.palm.name == "body3"
    assert hand.finger_names == ("body3_", "q1")


def test_small_ranges_in_radians_stay(tmp_path: Path) -> None:
    text = (
        FINGERS.format(one="", two="", more="")
        .replace('range="0 1.5"', 'range="0 0.04"')
        .replace('range="-1 1"', 'range="-0.04 0.04"')
    )
    hand, _ = read(tmp_path, text)
    assert [link.upper for link in hand.links] == [0.04] * 3


def test_a_hand_on_a_wrist_hangs_on_the_world(tmp_path: Path) -> None:
    wrist = '<body name="palm"><joint name="wrist" axis="1 0 0" range="-0.5 0.5"/>'
    hand, _ = read(tmp_path, FINGERS.format(one="", two="", more="").replace('<body name="palm">', wrist))
    assert (hand.palm.name, hand.joint_names) == ("world", ("wrist", "j1", "j2", "k1"))


def test_rods_on_ball_joints_are_left_out(tmp_path: Path) -> None:
    rod = '<body name="rod" pos="0 0.03 0.02"><joint type="ball"/><geom type="capsule" size="0.003" fromto="0 0 0 0 0 0.04"/></body>'
    text = FINGERS.format(one="", two="", more="").replace('<body name="q1"', f'{rod}<body name="q1"')
    hand, told = read(tmp_path, text)
    assert hand.finger_names == ("p2", "q1")
    assert len(hand.palm.collision) == 1
    assert "bodies that move freely, and rods on ball joints, are left out: 'rod'" in told
    inside = rod.replace(
        "</body>", '<body name="r2"><joint name="r" axis="0 1 0"/><geom size="0.005" pos="0 0 0.05"/></body></body>'
    )
    with pytest.raises(
        InvalidInputError,
        match="has no motor and carries joints that motors move: such parallel mechanisms are not supported",
    ):
        read(tmp_path, FINGERS.format(one="", two="", more="").replace('<body name="q1"', f'{inside}<body name="q1"'))


def test_a_closed_loop_is_coupled_and_its_rod_left_out(tmp_path: Path) -> None:
    rod = ('<body name="rod" pos="0.02 0 0.02"><joint name="r1" axis="0 1 0"/><geom type="capsule" size="0.003" fromto="0 0 0 0 0 0.04"/>'
           '</body><body name="q1"')  # fmt: skip
    more = ('<equality><connect body1="rod" body2="p2" anchor="0 0 0.04"/></equality>'
            '<actuator><motor joint="j1" ctrlrange="-3 3"/><motor joint="k1"/></actuator>')  # fmt: skip
    text = FINGERS.format(one="", two="", more=more).replace('<body name="q1"', rod)
    bar = '<geom type="capsule" size="0.003" fromto="0 0 0 0.02 0 0"/>'
    text = text.replace('fromto="0 0 0 0 0 0.03"/>', f'fromto="0 0 0 0 0 0.03"/>{bar}')
    hand, told = read(tmp_path, text.replace('range="0 1.5"', 'range="-0.6 0.6"'))
    assert "rods that only move a finger are not fingertips: 'rod'" in told
    (second,) = (link for link in hand.links if link.joint == "j2")
    assert second.mimic is not None
    # rod and first link are a parallelogram: the second keeps its direction
    assert (second.mimic.ratio, second.mimic.offset) == pytest.approx((-1.0, 0.0), abs=0.02)
    assert "rod" not in hand.finger_names


def test_meshes_lie_where_their_files_have_them(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [40, 0, 0], [0, 30, 0], [0, 0, 60], [10, 10, 50]], dtype=float)
    faces = [(1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 5), (2, 5, 4), (3, 4, 5)]
    (tmp_path / "wedge.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners.tolist()) + "".join(f"f {a} {b} {c}\n" for a, b, c in faces)
    )
    text = CROOKED.replace(
        "<worldbody>", '<asset><mesh name="wedge" file="wedge.obj" scale="0.001 0.001 0.001"/></asset><worldbody>', 1
    )
    hand, _ = read(
        tmp_path,
        text.replace('type="box" size="0.03 0.04 0.01"', 'type="mesh" mesh="wedge" pos="0.01 0 0.02" euler="0.5 0 0"'),
    )
    (hull,) = (shape for shape in hand.palm.collision if shape.kind == "hull")
    (seen,) = (shape for shape in hand.palm.visual if shape.kind == "mesh")
    touched = np.array(hull.corners) @ Frame.of(hull.origin, hull.rotation).rotation.T + np.array(hull.origin)
    drawn = (0.001 * corners) @ Frame.of(seen.origin, seen.rotation).rotation.T + np.array(seen.origin)
    away = np.linalg.norm(touched[:, None] - drawn[None], axis=2)
    assert away.min(axis=1).max() < 1e-7
    turned = Frame.of((0.01, 0.0, 0.02), (0.5, 0.0, 0.0))
    assert drawn == pytest.approx((0.001 * corners) @ turned.rotation.T + turned.origin, abs=1e-7)


def test_meshes_in_a_folder_above_and_other_names_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "ball.obj").write_text("v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    text = FINGERS.format(
        one="", two="", more='<actuator><motor joint="j1"/><motor joint="j2"/><motor joint="k1"/></actuator>'
    )
    text = text.replace(
        "<worldbody>", '<asset><mesh name="ball" file="ball.obj"/></asset><worldbody><geom type="mesh" mesh="ball"/>', 1
    )
    for name in ("hand.xml", "hand.mjcf"):
        hand, _ = read(tmp_path / "models", text, name=name)
        assert hand.finger_names == ("p2", "q1")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody>", "hand.xml is not XML"),
        ("<sdf/>", "the first element is <sdf>; a URDF starts with <robot name=...>, a MuJoCo model with <mujoco>"),
        ("<mujoco><worldbody><body><geom size='0.1'/></body></worldbody></mujoco>", "the file has no joint; a part that other files include"),
        (FINGERS.format(one="", two="", more="<actuator><motor site='s'/></actuator>").replace("<worldbody>", "<worldbody><site name='s'/>"),
         "no actuator moves a hinge or slide joint; add <position joint=.../>"),
        (CROOKED.replace('type="plane" size="1 1 0.1"', 'type="mesh" mesh="m"').replace("<worldbody>", "<asset><mesh name='m' file='gone.stl'/></asset><worldbody>"),
         "gone.stl"),
    ],
)  # fmt: skip
def test_files_that_are_no_hand_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, text)


def test_the_first_element_says_what_a_file_is(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="check the path"):
        HandDescription.from_mjcf(tmp_path / "none.xml")
    hand, _ = read(tmp_path, CROOKED, name="hand.urdf")
    assert hand.name == "crooked"


def test_all_joints_count_as_motors_without_actuators(tmp_path: Path) -> None:
    hand, told = read(tmp_path, FINGERS.format(one="", two="", more=""))
    assert [link.mimic for link in hand.links] == [None] * 3
    assert math.isfinite(hand.torque_limits.sum())
    assert "no effort" in told
