"""Xacro files: which are expanded, the files that they read, and their arguments."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
from urdf_text import SMALL_HAND, SPACE, joint, link, read, xacro_hand

from grasp_env.errors import InvalidInputError, MissingExtraError
from grasp_env.inputs import extras
from grasp_env.sim import HandDescription
from grasp_env.sim.hand.files.expansion import _is_inside


def package(folder: Path, **files: str) -> Path:
    """A ROS package with the name of its folder."""
    folder.mkdir(parents=True)
    (folder / "package.xml").write_text(f"<package><name>{folder.name}</name></package>")
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)
    return folder


def test_files_beside_it_and_in_packages_are_read(tmp_path, monkeypatch):
    """In folders above, in packages beside them, in those of ROS, and through the links that ROS
    installs."""
    part = f'<robot {SPACE}><xacro:property name="{{}}" value="{{}}"/></robot>'
    package(tmp_path / "ws" / "sizes", sizes_yaml="radius: 0.01\nangle: !degrees 180\n")
    package(tmp_path / "ros1" / "group" / "one", one_xacro=part.format("one", 1))
    package(tmp_path / "ros2" / "share" / "two", two_xacro=part.format("two", 2))
    own = package(
        tmp_path / "ws" / "own", a_xacro=part.format("a", "x"), b1_xacro=part.format("b", "y")
    )
    (own / "urdf").mkdir()
    includes = ("../a.xacro", "../b*.xacro", "$(find one)/one.xacro", "$(find two)/two.xacro")
    before = "".join(f'<xacro:include filename="{name}"/>' for name in includes)
    before += '<xacro:include filename="none.xacro" optional="true"/>'
    before += '<xacro:property name="s" value="${xacro.load_yaml(\'$(find sizes)/sizes.yaml\')}"/>'
    text = xacro_hand(before, "${a}${b}${one}${two}${round(s.angle, 2)}").replace(
        "0.01", "${s.radius}"
    )
    (own / "urdf" / "hand.xacro").write_text(text)
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'ros1'}{os.pathsep}{tmp_path / 'none'}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ros2"))
    made = HandDescription.from_file(own / "urdf" / "hand.xacro")
    assert made.name == "xy123.14"
    assert made.fingertips[0].radius == 0.01
    installed = tmp_path / "install" / "share" / "own"
    (installed / "urdf").mkdir(parents=True)
    for name in ("package.xml", "a.xacro", "b1.xacro", "urdf/hand.xacro"):
        (installed / name).symlink_to(own / name)
    assert HandDescription.from_file(installed / "urdf" / "hand.xacro") == made


def test_macros_are_called(tmp_path, monkeypatch):
    ends = ("${-pi/4}", "${pi/4}")
    finger = joint("${name}_joint", "palm", "${name}", "0 ${y} 0", ends) + link("${name}")
    macro = f'<xacro:macro name="finger" params="name y">{finger}</xacro:macro>'
    calls = '<xacro:include filename="finger.xacro"/><link name="palm"/>'
    calls += '<xacro:finger name="left" y="0.04"/><xacro:finger name="right" y="-0.04"/>'
    for space in (SPACE, 'xmlns:xacro="https://example.org/xacro"'):
        (tmp_path / "finger.xacro").write_text(f"<robot {space}>{macro}</robot>")
        text = f'<robot name="made" {space}>{calls}</robot>'
        made, _ = read(tmp_path, text, name="hand.xacro")
        assert (made.name, made.finger_names) == ("made", ("left", "right"))
        assert [each.origin[1] for each in made.links] == [0.04, -0.04]
        assert made.links[0].upper == pytest.approx(math.pi / 4)
    with pytest.raises(
        InvalidInputError,
        match="only defines macros, it has no <link>; give the file that calls them",
    ):
        HandDescription.from_file(tmp_path / "finger.xacro")
    (tmp_path / "finger.xacro").unlink()
    with pytest.raises(InvalidInputError, match=r"xacro cannot expand .*hand\.xacro: .*finger"):
        HandDescription.from_file(tmp_path / "hand.xacro")
    found = extras.find_spec
    monkeypatch.setattr(
        extras, "find_spec", lambda name: None if name == "xacrodoc" else found(name)
    )
    with pytest.raises(MissingExtraError, match=r'pip install "grasp-force\[xacro\]"'):
        HandDescription.from_file(tmp_path / "hand.xacro")


ARGUMENTS = xacro_hand(
    '<xacro:arg name="side"/><xacro:arg name="size" default="1"/>', "$(arg side)_$(arg size)"
)


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"side": "left"}, "left_1"),
        ({"side": "left", "size": 2}, "left_2"),
        ({"side": True, "size": 0.5}, "True_0.5"),
    ],
)
def test_arguments_are_given(tmp_path, given, name):
    assert read(tmp_path, ARGUMENTS, name="hand.xacro", xacro_args=given)[0].name == name


WRONG = [
    ({}, r"its argument 'side' has no default: pass xacro_args=\{\"side\": \.\.\.\}$"),
    (
        {"sise": 1},
        r"its argument 'side' has no default: pass xacro_args=\{\"side\": \.\.\.\}; given are sise$",
    ),
    (
        {"side": "a", "sise": 1},
        "it has no argument 'sise': did you mean 'si[dz]e'.* its arguments are side, size$",
    ),
    ({"side": None}, "xacro_args of 'side'=None must be text, a number, True or False"),
    ({"side": [1]}, "xacro_args of 'side'=.* must be text, a number, True or False"),
    ({1: "a"}, "xacro_args=.* must be a dict from names of arguments to their values"),
    ("side", "xacro_args='side' must be a dict"),
]


@pytest.mark.parametrize(("given", "message"), WRONG)
def test_wrong_arguments_are_named(tmp_path, given, message):
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, ARGUMENTS, name="hand.xacro", xacro_args=given)


UNFIT = [
    (
        "hand.urdf",
        SMALL_HAND,
        {"xacro_args": {"side": "left"}},
        r"xacro_args are given, but .* rename it to \.xacro, or pass xacro=True",
    ),
    ("hand.urdf", SMALL_HAND, {"xacro": 1}, "xacro must be True or False, got 1"),
    (
        "hand.xml",
        "<mujoco/>",
        {"xacro": True},
        "the first element is <mujoco>, xacro expands <robot>",
    ),
    ("hand.xacro", xacro_hand(), {"xacro": False}, "it has xacro elements, but is not expanded"),
]


@pytest.mark.parametrize(("name", "text", "options", "message"), UNFIT)
def test_options_that_do_not_fit_a_file(tmp_path, name, text, options, message):
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, text, name=name, **options)


@pytest.mark.parametrize(
    "words", ['<xacro:include filename="a.xacro"/>', "<x y=\"${xacro.load_yaml('a.xacro')}\"/>"]
)
def test_pointers_among_its_files_are_named(tmp_path, words):
    (tmp_path / "a.xacro").write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 9\n"
    )
    with pytest.raises(
        InvalidInputError, match=r"the file .*a\.xacro is a Git LFS pointer: run `git lfs pull`"
    ):
        read(tmp_path, xacro_hand(words), name="hand.xacro")


def test_other_versions_of_xacro_are_refused(tmp_path, monkeypatch):
    """ROS puts its own version in front."""
    module = tmp_path / "ros" / "xacro"
    module.mkdir(parents=True)
    (module / "__init__.py").write_text("import glob\nparse = load_yaml = None\n")
    (module / "substitution_args.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path / "ros"))
    with pytest.raises(
        InvalidInputError,
        match=r"ros/xacro/__init__\.py is a version without safe_eval, .*: pip install xacro==2",
    ):
        read(tmp_path, xacro_hand(), name="hand.xacro")


def test_a_file_of_the_root_reads_its_neighbours():
    root = Path("/")
    assert _is_inside(root / "sizes.yaml", root)
    assert not _is_inside(root / "etc" / "passwd", root)
    assert _is_inside(root / "a" / "b" / "c.yaml", root / "a")
    for name in (".ssh/key", "b/.netrc", ".hidden"):
        assert not _is_inside(root / "a" / name, root / "a")
