"""Compare hands from MuJoCo models with MuJoCo."""

from __future__ import annotations

from typing import Any

import mujoco as compiled
import numpy as np
import pytest
import trimesh
from urdf_text import read

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HandKinematics
from grasp_env.sim.hand.frames import Frame

mujoco: Any = compiled  # it has no types

CROOKED = """<mujoco model="crooked"><compiler angle="radian"/>
<worldbody><geom type="plane" size="1 1 0.1"/><body name="ball" pos="0 0 1"><freejoint/><geom size="0.03"/></body>
 <body name="base" pos="0.1 0.2 0.3" quat="0.9 0.1 0.3 0.2"><freejoint name="float"/><geom type="box" size="0.03 0.04 0.01"/>
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
   <joint name="side" axis="0 0 1" pos="0.004 0 0" range="-0.4 0.4"/>
   <joint name="bend" axis="0 1 0" pos="0 0 0.01" range="-1 1" actuatorfrcrange="-0.7 0.7"/>
   <geom size="0.01" pos="0 0 0.05" mass="0.03"/></body></body></worldbody>
<actuator><position joint="turn" kp="1" forcerange="-2 3" gear="2"/><motor joint="slide" gear="5" ctrlrange="-4 4"/>
 <general joint="side"/><motor joint="bend" ctrlrange="-0.9 0.9"/></actuator></mujoco>"""

FINGERS = """<mujoco><compiler angle="radian"/><option gravity="-300 0 0"/><worldbody><body name="palm"><geom type="box" size="0.03 0.03 0.01"/>
 <body name="p1" pos="0 0 0.02"><joint name="j1" axis="0 1 0" range="0 1.5" {one}/><geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.04"/>
  <body name="p2" pos="0 0 0.04"><joint name="j2" axis="0 1 0" range="0 1.5" {two}/><geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.03"/>
  </body></body>{rod}
 <body name="q1" pos="0.04 0 0.02"><joint name="k1" axis="0 1 0" range="-1 1"/><geom type="capsule" size="0.006" fromto="0 0 0 0 0 0.05"/></body>
</body></worldbody>{more}</mujoco>"""
PLAIN = FINGERS.format(one="", two="", rod="", more="")
MOTORS = '<actuator><motor joint="j1" ctrlrange="-3 3"/><motor joint="k1"/></actuator>'


def test_a_scene_is_the_hand_that_mujoco_simulates(tmp_path):
    """The base floats, the floor and a free ball are left out, and the file has the suffix of a
    URDF."""
    hand, told = read(tmp_path, CROOKED, ["pad", "touch", "c"], rotor_inertia=None)
    assert (hand.name, hand.palm.name, hand.joint_names) == (
        "crooked",
        "base",
        ("turn", "slide", "side", "bend"),
    )
    assert [(shape.kind, shape.size) for shape in hand.palm.collision] == [
        ("box", (0.06, 0.08, 0.02))
    ]
    assert [(link.lower, link.upper) for link in hand.links] == [
        (-0.5, 1.2),
        (-0.01, 0.02),
        (-0.4, 0.4),
        (-1.0, 1.0),
    ]
    assert hand.torque_limits[[0, 1, 3]].tolist() == [6.0, 20.0, 0.7]
    assert [tip.radius for tip in hand.fingertips] == pytest.approx([0.008, 0.006, 0.01])
    for words in (
        "no effort is given for 'side'",
        "torque_limit=",
        "hold still in the file's posture: 'float'",
    ):
        assert words in told
    model = mujoco.MjModel.from_xml_string(CROOKED)
    data = mujoco.MjData(model)
    kinematics = HandKinematics(hand)
    rng = np.random.default_rng(0)
    full = np.empty((model.nv, model.nv))
    dofs = [int(model.joint(name).dofadr[0]) for name in ("turn", "slide")]
    for _ in range(10):
        angles = kinematics.lower + rng.random(4) * (kinematics.upper - kinematics.lower)
        for name, angle in zip(hand.joint_names, angles, strict=True):
            data.joint(name).qpos[:] = angle
        mujoco.mj_forward(model, data)
        base = Frame(data.body("base").xmat.reshape(3, 3), data.body("base").xpos)
        places = (data.geom("pad").xpos, data.site("touch").xpos, data.geom(model.ngeom - 1).xpos)
        np.testing.assert_allclose(
            kinematics.tips(angles) @ base.rotation.T + base.origin, places, atol=1e-12
        )
        mujoco.mj_fullM(model, data, full)
        own = kinematics.mass_matrix(angles)[:2, :2]  # the rotor of `turn` included
        np.testing.assert_allclose(own, full[np.ix_(dofs, dofs)], rtol=1e-9)


@pytest.mark.parametrize(("before", "upper"), [("", 1.5), ('angle="radian"', 0.04)])
def test_radians_that_mujoco_takes_for_degrees(tmp_path, before, upper):
    """Ranges of 1.5 degrees become radians; small ranges in a file with angle="radian" stay."""
    meant = FINGERS.format(one="", two='ref="0.5"', rod="", more="").replace(
        'range="0 1.5"', f'range="0 {upper}"'
    )
    meant = meant.replace('range="-1 1"', f'range="{-upper} {upper}"')
    hand, told = read(tmp_path, meant.replace('angle="radian"', before))
    assert ("without angle='radian' in <compiler> ranges are degrees" in told) == (before == "")
    assert [link.upper for link in hand.links] == pytest.approx([upper] * 3, abs=1e-12)
    model = mujoco.MjModel.from_xml_string(meant)
    data = mujoco.MjData(model)
    data.qpos[:] = (0.3, 0.7, 0.1)
    mujoco.mj_forward(model, data)
    frames, origins = HandKinematics(hand).links(data.qpos)
    for frame, origin, name in zip(frames, origins, ("p1", "p2", "q1"), strict=True):
        np.testing.assert_allclose(origin, data.body(name).xpos, atol=1e-12)
        np.testing.assert_allclose(frame, data.body(name).xmat.reshape(3, 3), atol=1e-12)


BAR = '<geom type="capsule" size="0.003" fromto="0 0 0 {} 0 {}"/>'
LOOP = (
    '<body name="rod" pos="0.02 0 0.02"><joint name="r1" axis="0 1 0"/>'
    + BAR.format(0, 0.04)
    + "</body>"
)
TENDON = (
    '<tendon><fixed {}><joint joint="j1" coef="{}"/><joint joint="j2" coef="{}"/></fixed></tendon>'
)


COUPLED = [
    # springs share the motion of a tendon over both joints 1 : 2
    (
        {
            "one": 'stiffness="0.4" springref="0"',
            "two": 'stiffness="0.1" springref="0"',
            "more": TENDON.format('name="t"', 0.02, 0.01)
            + '<actuator><motor tendon="t" ctrlrange="0 12" forcerange="0 50" forcelimited="true"/><motor joint="k1"/></actuator>',
        },
        ("j2", "j1"),
        (0.5, 0.0),
        50.0 * (0.01 + 0.02 * 0.5),
    ),
    # a range of a tendon so narrow that it couples
    (
        {"more": TENDON.format('limited="true" range="-0.0005 0.0005"', 0.01, -0.01) + MOTORS},
        ("j1", "j2"),
        (1.0, 0.0),
        3.0,
    ),
    # rod and first link are a parallelogram: the second link keeps its direction
    (
        {
            "rod": LOOP,
            "more": f'<equality><connect body1="rod" body2="p2" anchor="0 0 0.04"/></equality>{MOTORS}',
        },
        ("j1", "j2"),
        (-1.0, 0.0),
        3.0,
    ),
]


@pytest.mark.parametrize(
    ("fields", "pair", "line", "limit"), COUPLED, ids=["tendon", "narrow", "loop"]
)
def test_joints_that_share_a_motor_are_coupled(tmp_path, fields, pair, line, limit):
    text = FINGERS.format(**{"one": "", "two": "", "rod": "", **fields})
    if "rod" in fields:
        text = text.replace('range="0 1.5"', 'range="-0.6 0.6"').replace(
            '0 0.03"/>', '0 0.03"/>' + BAR.format(0.02, 0)
        )
    hand, told = read(tmp_path, text)
    links = {link.joint: link for link in hand.links}
    mimic = links[pair[1]].mimic
    assert mimic is not None
    assert mimic.joint == pair[0]
    assert (mimic.ratio, mimic.offset) == pytest.approx(line, abs=0.03)
    assert links[pair[0]].torque_limit == pytest.approx(limit, rel=0.02)
    assert f"joints that share a motor are coupled as MuJoCo moves them: {pair[1]} = " in told
    assert ("rods that only move a finger are not fingertips: 'rod'" in told) == ("rod" in fields)
    assert hand.finger_names == ("p2", "q1")


JAWS = """<mujoco><compiler angle="radian"/><option {option}/><worldbody><body name="palm"><geom type="box" size="0.06 0.02 0.01"/>
 <body name="wheel"><joint name="m" axis="0 0 1" range="0 6"/><geom size="0.01"/></body>
 <body name="l" pos="-0.05 0 0.05"><joint name="a" type="slide" axis="1 0 0" {a}/><geom type="box" size="0.01 0.01 0.03"/></body>
 <body name="r" pos="0.05 0 0.05"><joint name="b" type="slide" axis="-1 0 0" {b}/><geom type="box" size="0.01 0.01 0.03"/></body>
 </body></worldbody><equality>{equality}</equality><actuator><motor joint="{motor}"/></actuator></mujoco>"""
WIDE = 'range="0 0.04"'


EQUALITIES = [
    (
        'timestep="0.5"',
        "",
        'range="0 0.025"',
        "a",
        '<joint joint1="b" joint2="a"/>',
        {"b": (1.0, 0.0)},
    ),
    (
        "",
        WIDE,
        WIDE,
        "b",
        '<joint joint1="b" joint2="a" polycoef="0.004 0.5"/>',
        {"a": (2.0, -0.008)},
    ),
    (
        "",
        WIDE,
        WIDE,
        "m",
        '<joint joint1="a" joint2="m" polycoef="0 0.0055 0 0 0"/>'
        '<joint joint1="b" joint2="m" polycoef="0 0.0004 0 0 0"/>',
        {"a": (0.0055, 0.0), "b": (0.0004, 0.0)},
    ),
]


@pytest.mark.parametrize(
    ("option", "a", "b", "motor", "equality", "lines"),
    EQUALITIES,
    ids=["free driver", "inverse", "rack"],
)
def test_equalities_of_jaws_are_read_exactly(tmp_path, option, a, b, motor, equality, lines):
    """A long time step changes nothing, and tips are at the far ends of jaws whose frames are in
    their middle."""
    hand, _ = read(tmp_path, JAWS.format(option=option, a=a, b=b, motor=motor, equality=equality))
    found = {link.joint: link.mimic for link in hand.links if link.mimic is not None}
    assert set(found) == set(lines)
    for joint, line in lines.items():
        assert (found[joint].ratio, found[joint].offset) == pytest.approx(line, rel=1e-9, abs=1e-9)
    assert all(tip.center[2] > 0.01 for tip in hand.fingertips if tip.link != "wheel")


ROD = '<body name="rod" pos="0 0.03 0.02"><joint name="ball" type="ball"/><geom type="capsule" size="0.003" fromto="0 0 0 0 0 0.04"/>{}</body>'


def test_what_a_file_does_not_give(tmp_path):
    """The world becomes the palm of a hand on a wrist, bodies get unused names, all joints get
    motors, and rods on ball joints are left out."""
    text = FINGERS.format(one="", two="", rod=ROD.format(""), more="").replace('name="p2" ', "")
    wrist = '<body name="body3"><joint name="wrist" axis="1 0 0" range="-0.5 0.5"/>'
    hand, told = read(tmp_path, text.replace('<body name="palm">', wrist))
    assert (hand.palm.name, hand.joint_names) == ("world", ("wrist", "j1", "j2", "k1"))
    assert hand.finger_names == ("body3_", "q1")
    assert [link.mimic for link in hand.links] == [None] * 4
    assert np.isfinite(hand.torque_limits).all()
    assert "no effort" in told
    assert "bodies that move freely, and rods on ball joints, are left out: 'rod'" in told


def test_meshes_lie_where_their_files_have_them(tmp_path):
    """The mesh is in a folder above the model."""
    corners = np.array([[0, 0, 0], [40, 0, 0], [0, 30, 0], [0, 0, 60], [10, 10, 50]], dtype=float)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4)]
    trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "wedge.obj")
    (tmp_path / "models").mkdir()
    asset = (
        '<asset><mesh name="wedge" file="wedge.obj" scale="0.001 0.001 0.001"/></asset><worldbody>'
    )
    text = PLAIN.replace("<worldbody>", asset, 1)
    text = text.replace(
        'type="box" size="0.03 0.03 0.01"',
        'type="mesh" mesh="wedge" pos="0.01 0 0.02" euler="0.5 0 0"',
    )
    hand, _ = read(tmp_path / "models", text, name="hand.mjcf")
    (hull,) = (shape for shape in hand.palm.collision if shape.kind == "hull")
    (seen,) = (shape for shape in hand.palm.visual if shape.kind == "mesh")
    placed = Frame.of((0.01, 0.0, 0.02), (0.5, 0.0, 0.0))
    wanted = (0.001 * corners) @ placed.rotation.T + placed.origin
    drawn = (0.001 * corners) @ Frame.of(seen.origin, seen.rotation).rotation.T + seen.origin
    np.testing.assert_allclose(drawn, wanted, atol=1e-7)
    touched = np.array(hull.corners) @ Frame.of(hull.origin, hull.rotation).rotation.T + hull.origin
    assert np.linalg.norm(touched[:, None] - wanted[None], axis=2).min(axis=1).max() < 1e-7


def test_attributes_of_other_versions_are_left_out(tmp_path):
    """Those of options, also in a file that is included; those of joints may change the hand."""
    old = '<mujocoinclude><option apirate="200" timestep="0.001"/><size njmax="9"/></mujocoinclude>'
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "old.xml").write_text(old)
    text = PLAIN.replace("<worldbody>", '<include file="parts/old.xml"/><worldbody>', 1)
    for name in ("hand.xml", "hand.mjcf"):
        hand, told = read(tmp_path, text, name=name)
        assert (
            f"attributes that MuJoCo {mujoco.__version__} does not know are left out: 'apirate' of <option>"
            in told
        )
        assert hand.joint_names == read(tmp_path, PLAIN)[0].joint_names
    with pytest.raises(InvalidInputError, match="unrecognized attribute: 'stiff'"):
        read(tmp_path, FINGERS.format(one='stiff="1"', two="", rod="", more=""))


CARRIED = '<body name="r2"><joint name="r" axis="0 1 0"/><geom size="0.005" pos="0 0 0.05"/></body>'


NO_HAND = [
    (
        "<scene/>",
        "the first element is <scene>; a URDF starts with <robot name=...>, a MuJoCo model with <mujoco>",
    ),
    (
        "<mujoco><worldbody><body><geom size='0.1'/></body></worldbody></mujoco>",
        "the file has no joint; a part that other files include",
    ),
    (
        FINGERS.format(
            one="", two="", rod="<site name='s'/>", more="<actuator><motor site='s'/></actuator>"
        ),
        "no actuator moves a hinge or slide joint; add <position joint=.../>",
    ),
    (
        PLAIN.replace(
            "<worldbody>",
            "<asset><mesh name='m' file='gone.stl'/></asset><worldbody><geom type='mesh' mesh='m'/>",
        ),
        "gone.stl",
    ),
    (
        FINGERS.format(one="", two="", rod=ROD.format(CARRIED), more=""),
        "the ball joint 'ball' has no motor and carries joints that motors move: such parallel mechanisms are not supported",
    ),
]


@pytest.mark.parametrize(
    ("text", "message"), NO_HAND, ids=["no robot", "no joint", "no motor", "no mesh", "ball"]
)
def test_files_that_are_no_hand_are_refused(tmp_path, text, message):
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, text)
