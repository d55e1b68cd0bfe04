"""`grasp hand` prints the contents of a file and its repairs, and draws it."""

from __future__ import annotations

import numpy as np
from PIL import Image
from urdf_text import xacro_hand

from training.program.cli import main

URDF = """<robot name="tiny"><link name="palm"/>
<joint name="bend" type="revolute"><parent link="palm"/><child link="finger"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="0"/></joint>
<joint name="curl" type="revolute"><parent link="finger"/><child link="tip"/><origin xyz="0 0 0.05"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1"/><mimic joint="bend" multiplier="0.5" offset="0.1"/></joint>
<link name="finger"><inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/></inertial>
<collision><origin xyz="0 0 0.025"/><geometry><box size="0.02 0.02 0.04"/></geometry></collision></link>
<link name="tip"><collision><origin xyz="0 0 0.02"/><geometry><box size="0.016 0.02 0.04"/></geometry></collision></link></robot>"""
PRINTED = (
    "bend",
    "0.5 x bend +0.1",
    "-1.000 rad",
    "1.7 N m",
    "8.0",
    "effort 0 of 'bend'",
    "without mass",
    "tiny.png",
)
"""The motor's limit is 15 N at 81 mm, and the share of the coupled joint."""


def test_a_file_is_printed_and_drawn(tmp_path, capsys):
    path = tmp_path / "tiny.urdf"
    path.write_text(URDF)
    assert main(f"hand {path} --draw {tmp_path / 'tiny.png'} --size 64".split()) == 0
    out = capsys.readouterr().out
    assert [word for word in PRINTED if word not in out] == []
    picture = np.array(Image.open(tmp_path / "tiny.png"))
    assert picture.shape == (64, 128, 3)
    red = (picture[..., 0] > 150) & (picture[..., 1] < 100)
    assert red[:, 64:].sum() > 10  # the fingertip among the collision shapes
    assert not red[:, :64].any()
    assert main(f"hand {path} --torque-limit 0.3 --fingertips finger".split()) == 0
    out = capsys.readouterr().out
    assert "0.3 N m" in out
    assert "is no motor's limit" not in out


def test_arguments_of_a_xacro_file_are_given(tmp_path, capsys):
    path = tmp_path / "hand.xacro"
    path.write_text(
        xacro_hand('<xacro:arg name="side"/><xacro:arg name="kind"/>', "$(arg side) $(arg kind)")
    )
    assert main(["hand", str(path), "--xacro-args", "side=left", "kind=a=b"]) == 0
    assert "left a=b: 1 joints" in capsys.readouterr().out
    for words, message in (
        ("side=left", "its argument 'kind' has no default"),
        ("side", "NAME=VALUE, such as side=left, got 'side'"),
    ):
        assert main(["hand", str(path), "--xacro-args", words]) == 2
        assert message in capsys.readouterr().err


def test_errors_are_one_line(capsys):
    assert main(["hand", "leap"]) == 0
    assert "0.95 N m" in capsys.readouterr().out
    for words, message in {
        "lepa": "did you mean 'leap'?",
        "nowhere.urdf": "cannot read the file nowhere.urdf",
        "leap --torque-limit 0.3": "leap is no file",
        "leap --xacro-args side=left": "and no arguments",
        "leap --size 1": "size must be an integer >= 16",
        "leap --draw /nowhere/a.png --size 16": "/nowhere",
    }.items():
        assert main(["hand", *words.split()]) == 2
        err = capsys.readouterr().err
        assert message in err
        assert err.count("\n") == 1
