"""Xacro files are read as the URDFs that they expand to."""

from __future__ import annotations

from pathlib import Path

import pytest

from grasp_env import _extras
from grasp_env.errors import InvalidInputError, MissingExtraError
from grasp_env.sim.hand.description import HandDescription

FINGER = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:macro name="finger" params="name y">
 <joint name="${name}_joint" type="revolute"><parent link="palm"/><child link="${name}"/><origin xyz="0 ${y} 0"/>
  <axis xyz="0 0 1"/><limit lower="${-pi/4}" upper="${pi/4}" effort="2" velocity="1"/></joint>
 <link name="${name}"><inertial><mass value="0.1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><sphere radius="0.01"/></geometry></collision></link>
</xacro:macro></robot>"""
HAND = """<robot name="made" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="gap" default="0.04"/>
<xacro:include filename="$(find parts)/finger.xacro"/><link name="palm"/>
<xacro:finger name="left" y="$(arg gap)"/><xacro:finger name="right" y="-0.04"/></robot>"""


def package(folder: Path, name: str, files: dict[str, str]) -> Path:
    home = folder / name
    home.mkdir()
    (home / "package.xml").write_text(f"<package><name>{name}</name></package>")
    for file, text in files.items():
        (home / file).write_text(text)
    return home


def test_a_xacro_file_finds_the_package_beside_its_own(tmp_path: Path) -> None:
    package(tmp_path, "parts", {"finger.xacro": FINGER})
    home = package(tmp_path, "hand", {"hand.urdf.xacro": HAND})
    hand = HandDescription.from_urdf(home / "hand.urdf.xacro")
    assert (hand.name, hand.finger_names) == ("made", ("left", "right"))
    assert [link.origin[1] for link in hand.links] == [0.04, -0.04]
    assert hand.links[0].upper == pytest.approx(0.7853981634)


@pytest.mark.parametrize(
    "space", ["http://www.ros.org/wiki/xacro", "http://wiki.ros.org/xacro", "https://example.org/xacro"]
)
def test_files_beside_a_xacro_file_are_included_whatever_the_namespace_is_called(tmp_path: Path, space: str) -> None:
    (tmp_path / "finger.xacro").write_text(FINGER.replace("http://www.ros.org/wiki/xacro", space))
    text = HAND.replace("$(find parts)/", "").replace("http://www.ros.org/wiki/xacro", space)
    (tmp_path / "hand.urdf").write_text(text)
    assert HandDescription.from_urdf(tmp_path / "hand.urdf").finger_names == ("left", "right")


def test_what_xacro_refuses_is_said(tmp_path: Path) -> None:
    home = package(tmp_path, "hand", {"macro.xacro": FINGER, "hand.xacro": HAND})
    with pytest.raises(InvalidInputError, match="only defines macros, it has no <link>; give the file that calls them"):
        HandDescription.from_urdf(home / "macro.xacro")
    with pytest.raises(InvalidInputError, match=r"xacro cannot expand .*hand\.xacro: .*parts"):
        HandDescription.from_urdf(home / "hand.xacro")


def test_without_xacrodoc_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = package(tmp_path, "hand", {"macro.xacro": FINGER})
    found = _extras.find_spec
    monkeypatch.setattr(_extras, "find_spec", lambda name: None if name == "xacrodoc" else found(name))
    with pytest.raises(MissingExtraError, match=r'pip install "grasp-force\[xacro\]"'):
        HandDescription.from_urdf(home / "macro.xacro")
