"""Collision meshes of hands as convex pieces, where files are sought, fingertips in links of any shape, and files that are no mesh."""

from __future__ import annotations

import pickle
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.files.pieces import convex_pieces
from grasp_env.sim.hand.solids import MOST_CORNERS, beneath, few_corners, inset, outline
from grasp_env.sim.hand.tree import Geometry
from grasp_env.sim.hand.urdf import hand_files, hand_urdf

BOX = trimesh.creation.box((0.02, 0.03, 0.04))


def urdf(shapes: str, more: str = "") -> str:
    """A finger of one joint about y, its link with some elements."""
    return (
        '<robot name="small"><link name="palm"/><joint name="bend" type="revolute"><parent link="palm"/><child link="finger"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="2"/></joint><link name="finger"><inertial><mass value="0.1"/>'
        f'<inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/></inertial>{shapes}</link>{more}</robot>'
    )


def solid(shape: str, xyz: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}"/><geometry>{shape}</geometry></collision>'


def mesh(name: str, scale: str = "1 1 1") -> str:
    return solid(f'<mesh filename="{name}" scale="{scale}"/>')


def read(folder: Path, text: str, tips: Any = None, **options: Any) -> HandDescription:
    path = folder / "hand.urdf"
    path.write_text(text, encoding="utf-8")
    return HandDescription.from_urdf(path, tips, **options)


def outside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """How far points stick out of the hull of corners [m]."""
    faces = ConvexHull(corners).equations
    return (points @ faces[:, :3].T + faces[:, 3]).max(axis=1)


def volume(pieces: list[np.ndarray]) -> float:
    return sum(ConvexHull(piece).volume for piece in pieces)


@pytest.mark.parametrize(
    "name", ["meshes/box.obj", "file://meshes/box.stl", "package://any_name/meshes/box.obj", "{folder}/meshes/box.stl"]
)
def test_meshes_are_found_and_become_hulls(tmp_path: Path, name: str) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "urdf").mkdir()
    BOX.export(tmp_path / "meshes" / "box.obj")
    BOX.export(tmp_path / "meshes" / "box.stl")
    text, tips = urdf(mesh(name.format(folder=tmp_path), "2 1 -0.5")), {"finger": ((0.0, 0.0, 0.005), 0.001)}
    for folder in (tmp_path, tmp_path / "urdf"):  # beside it, and in the folder above
        hand = read(folder, text, tips)
        (hull,) = (shape for shape in hand.links[0].collision if shape.kind == "hull")
        found = np.array(sorted(hull.corners))
        np.testing.assert_allclose(np.abs(found), np.tile((0.02, 0.015, 0.01), (8, 1)), atol=1e-7)


def test_a_mesh_to_look_at_is_kept(tmp_path: Path) -> None:
    BOX.export(tmp_path / "box.stl")
    look = '<visual><geometry><mesh filename="box.stl" scale="1 2 3"/></geometry></visual>'
    hand = read(tmp_path, urdf(look + solid('<sphere radius="0.01"/>')))
    assert hand.links[0].visual == (Geometry("mesh", (1.0, 2.0, 3.0), file=str(tmp_path / "box.stl")),)
    assert read(tmp_path, hand_urdf(hand)).links == hand.links


CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.glb", b"glTF", "are none of .obj, .stl, .dae"),
        ("a.obj", b"", "are broken"),
        ("a.obj", CORNERS + b"f 1 2 4\n", "are broken"),  # Bullet would read beyond its corners, and crash
        ("a.obj", b"f 1 2 3\n" + CORNERS, "are broken"),
        ("a.obj", CORNERS + b"f 1/2 2/1 3/1\nvt 0 0\nvt 1 1\n", "are broken"),
        ("a.obj", CORNERS + b"f -1 -2 -3\n", "are broken"),
        ("a.stl", bytes(10), "are empty"),
        ("a.stl", None, "are missing"),
    ],
)
def test_looks_that_cannot_be_drawn_are_left_out(tmp_path: Path, name: str, content: bytes | None, why: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    look = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    with pytest.warns(UserWarning, match=f"visual meshes that {why} are left out: '{name}'"):
        hand = read(tmp_path, urdf(look + solid('<sphere radius="0.01"/>')))
    assert [shape.kind for shape in hand.links[0].visual] == ["sphere"]


def test_hulls_are_written_and_read_as_themselves(tmp_path: Path) -> None:
    BOX.export(tmp_path / "box.obj")
    hand = read(tmp_path, urdf(mesh("box.obj")), {"finger": ((0.0, 0.0, 0.015), 0.004)})
    for name, text in hand_files(hand).items():
        (tmp_path / name).write_text(text)
    again = HandDescription.from_urdf(tmp_path / "hand.urdf", {"finger": ((0.0, 0.0, 0.015), 0.004)})
    for one, other in zip(hand.links[0].collision, again.links[0].collision, strict=True):
        assert one.kind == other.kind
        assert set(one.corners) == set(other.corners)


def bent() -> Any:
    """An L of two boxes, one mesh."""
    long, short = trimesh.creation.box((0.01, 0.01, 0.06)), trimesh.creation.box((0.03, 0.01, 0.01))
    return trimesh.util.concatenate([long, short.apply_translation((0.02, 0.0, -0.025))])


RING = trimesh.creation.torus(0.03, 0.006, major_sections=32, minor_sections=16)


@pytest.mark.parametrize(
    ("shape", "counts"),
    [(bent(), {2}), (RING, range(3, 9)), (trimesh.creation.annulus(0.01, 0.012, 0.04), range(3, 9))],
)
def test_a_mesh_that_is_not_convex_falls_into_pieces(shape: trimesh.Trimesh, counts: Any) -> None:
    """All of it is in them, and a hole stays one."""
    pieces = convex_pieces(np.array(shape.vertices), np.array(shape.faces))
    assert len(pieces) in counts
    assert all(len(piece) <= MOST_CORNERS for piece in pieces)
    samples = np.vstack([trimesh.sample.sample_surface(shape, 500, seed=0)[0], shape.vertices])
    assert np.min([outside(samples, piece) for piece in pieces], axis=0).max() < 1e-6
    if len(pieces) == 2:
        assert volume(pieces) == pytest.approx(9e-6, rel=1e-3)
    else:
        assert min(outside(np.zeros((1, 3)), piece).item() for piece in pieces) > 0.003


def test_parts_inside_one_another_and_open_ones_are_one_piece() -> None:
    """A cylinder whose caps and side are meshes of their own, and a box around it that hides half of it."""
    side = trimesh.creation.cylinder(0.01, 0.04)
    loose = trimesh.Trimesh(side.triangles.reshape(-1, 3), np.arange(3 * len(side.faces)).reshape(-1, 3), process=False)
    assert len(convex_pieces(np.array(loose.vertices).round(9), np.array(loose.faces))) == 1
    hidden: Any = trimesh.util.concatenate([side, trimesh.creation.box((0.03, 0.03, 0.05))])
    assert len(convex_pieces(np.array(hidden.vertices), np.array(hidden.faces))) == 1


@pytest.mark.parametrize("name", ["ball", "capsule", "cone"])
def test_few_corners_contain_all_and_little_more(name: str) -> None:
    """40 corners around a ball stick out by an eighth of its radius."""
    shapes = {
        "ball": trimesh.creation.icosphere(3, 0.012), "capsule": trimesh.creation.capsule(0.03, 0.012),
        "cone": trimesh.creation.cone(0.012, 0.04),
    }  # fmt: skip
    points = np.array(shapes[name].vertices)
    corners = few_corners(points)
    assert len(corners) <= MOST_CORNERS
    assert outside(points, corners).max() < 1e-9
    assert outside(corners, points).max() < 0.135 * 0.012
    assert few_corners(np.array(BOX.vertices)).shape == (8, 3)


def test_cut_and_inset_boxes_are_boxes() -> None:
    points, up = np.array(BOX.vertices), np.array([0.0, 0.0, 1.0])
    left, small = beneath(points, up, 0.005), inset(points, 1e-3)
    np.testing.assert_allclose(
        [left.min(axis=0), left.max(axis=0)], [(-0.01, -0.015, -0.02), (0.01, 0.015, 0.005)], atol=1e-12
    )
    assert len(beneath(points, up, -0.02)) == 0
    np.testing.assert_allclose(
        [small.min(axis=0), small.max(axis=0)], [(-0.009, -0.014, -0.019), (0.009, 0.014, 0.019)], atol=1e-9
    )
    thin = inset(points * (1.0, 1.0, 0.03), 1e-3)  # 1.2 mm: a third of the ball of 0.6 mm goes
    np.testing.assert_allclose(np.ptp(thin, axis=0), (0.0196, 0.0296, 0.0008), atol=1e-6)


def test_a_tip_is_the_ball_in_the_end_of_its_link(tmp_path: Path) -> None:
    """A dome of radius 8 mm on a box of 16 x 24 mm: the sphere is the dome's, and the box ends behind it."""
    dome = trimesh.creation.capsule(0.03, 0.008, count=(32, 32))  # 15 mm along z, then its end
    dome.export(tmp_path / "dome.stl")
    hand = read(tmp_path, urdf(mesh("dome.stl") + solid('<box size="0.016 0.024 0.03"/>', "0 0 0.01")))
    (tip,) = hand.fingertips
    assert (tip.name, tip.link) == ("finger", "finger")
    np.testing.assert_allclose(tip.center, (0.0, 0.0, 0.015), atol=1e-3)
    assert tip.radius == pytest.approx(0.008, abs=1e-3)  # of a hull of 40 corners
    for shape in hand.links[0].collision:
        if shape.kind != "sphere":
            assert outline(shape)[:, 2].max() < tip.center[2] - tip.radius + 1e-4  # as near as few corners are


@pytest.mark.parametrize(
    ("size", "radius"),
    [
        ((0.014, 0.03, 0.06), 0.007),  # half of the thickness
        ((0.06, 0.06, 0.06), 0.015),  # no larger than a fingertip
        ((0.003, 0.02, 0.06), 0.004),  # no smaller, though it sticks out
    ],
)
def test_a_tip_in_a_box_touches_its_end_in_the_middle(
    tmp_path: Path, size: tuple[float, float, float], radius: float
) -> None:
    hand = read(tmp_path, urdf(solid(f'<box size="{size[0]} {size[1]} {size[2]}"/>', "0 0 0.04")))
    (tip,) = hand.fingertips
    assert tip.radius == pytest.approx(radius, abs=1e-4)
    assert tip.center[1] == pytest.approx(0.0, abs=1e-4)
    assert 0.065 < tip.center[2] + radius < 0.0751


def test_tips_are_given_by_place_and_on_links_of_all_kinds(tmp_path: Path) -> None:
    fixed = (
        '<joint name="end" type="fixed"><parent link="finger"/><child link="pad"/><origin xyz="0 0 0.05" rpy="0 1.5707963267948966 0"/>'
        '</joint><link name="pad"/>'
    )
    text = urdf(solid('<box size="0.02 0.02 0.06"/>', "0 0 0.03"), fixed)
    given = read(tmp_path, text, {"pad": ((0.01, 0.0, 0.002), 0.006)})
    np.testing.assert_allclose(given.fingertips[0].center, (0.002, 0.0, 0.04), atol=1e-12)
    assert given.finger_names == ("pad",)
    named = read(tmp_path, text, ["pad"])  # no shape of its own: that of its link, towards it
    assert named.fingertips[0].radius == pytest.approx(0.01, abs=1e-4)
    assert 0.055 < named.fingertips[0].center[2] + 0.01 < 0.0601
    wrong = (0.1, ((0.0, 0.0), 0.1), ((0.0, 0.0, 0.0), -1.0), ((0.0, 0.0, 0.0),))
    for tips in (*({"pad": each} for each in wrong), {1: ((0, 0, 0), 1)}):
        with pytest.raises(InvalidInputError, match="fingertips"):
            read(tmp_path, text, tips)


def test_every_end_of_a_branch_is_a_finger(tmp_path: Path) -> None:
    more = "".join(
        f'<joint name="j{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="2"/></joint>'
        f'<link name="{name}"><inertial><mass value="0.1"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/></inertial>{shapes}</link>'
        for name, parent, shapes in (
            ("thumb", "palm", solid('<sphere radius="0.011"/>', "0 0 0.03")), ("last", "finger", solid('<box size="0.02 0.02 0.02"/>')),
            ("blade", "finger", ""),
        )
    )  # fmt: skip
    with pytest.warns(UserWarning, match="end links without a shape are not fingertips: 'blade'"):
        hand = read(tmp_path, urdf("", more))
    assert hand.finger_names == ("thumb", "last")
    assert hand.fingertips[0].radius == 0.011
    assert [shape.kind for shape in hand.links[hand.joint_names.index("jlast")].collision][-1] == "sphere"


RNG = np.random.default_rng(0)
FACES = "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
BAD: dict[str, tuple[str, Any, str]] = {
    "noise": ("a.obj", RNG.bytes(10**6), "is not a mesh|holds no triangles"),
    "noise as stl": ("a.stl", RNG.bytes(10**6), "a.stl"),
    "noise as dae": ("a.dae", RNG.bytes(10**6), "is not a mesh"),
    "words": ("a.obj", b"v 1 2\nf 1 2 3\n" * 70_000, "fewer than three coordinates"),
    "four billion faces": ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(500), "a.stl"),
    "a billion corners": ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1000000000\nproperty float x\nend_header\n", "is not a mesh"),
    "nothing": ("a.obj", b"", "holds no triangles"),
    "nan": ("a.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + FACES.encode(), "not finite"),
    "far": ("a.obj", b"v 1e300 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + FACES.encode(), "above 1e6"),
    "millimetres": ("a.obj", b"v 60 0 0\nv 1 0 0\nv 0 50 0\nv 0 0 40\n" + FACES.encode(), 'are 1e-05 to 5; .* scale="0.001'),
    "a point": ("a.obj", b"v 0 0 0\nv 0 0 0\nv 0 0 0\nv 0 0 0\n" + FACES.encode(), "all its faces are lines or points"),
    "missing corners": ("a.obj", CORNERS + b"f 1 2 999999999\n", "a.obj"),
    "a pickle": ("a.obj", pickle.dumps(pytest.fail), "holds no triangles"),
    "another kind": ("a.txt", b"", "of no kind that is read"),
    "sparse": ("a.obj", 2**40, "larger than 40 MB"),
    "a folder": (".", None, "neither beside the URDF nor"),
    "a device": ("/dev/zero", None, "neither beside the URDF nor"),
    "an address": ("http://example.org/a.obj", None, "only file://, package:// and plain paths"),
    "a long name": ("a" * 5000 + ".obj", None, "neither beside the URDF nor"),
    "no name": ("", None, "lacks filename="),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_files_that_are_no_mesh_are_refused_soon(tmp_path: Path, what: str) -> None:
    name, content, message = BAD[what]
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    elif content is not None:
        with (tmp_path / name).open("wb") as file:
            file.truncate(content)
    begun = time.perf_counter()
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, urdf(mesh(name)))
    with pytest.raises(InvalidInputError, match="must not be 0"):
        read(tmp_path, urdf(mesh("any.obj", "1 0 1")))
    assert time.perf_counter() - begun < 5.0


def test_soups_of_triangles_take_seconds(tmp_path: Path) -> None:
    points = (RNG.normal(size=(20_000, 1, 3)) * 0.01 + RNG.normal(size=(20_000, 3, 3)) * 0.005).reshape(-1, 3)
    trimesh.Trimesh(points, np.arange(60_000).reshape(-1, 3), process=False).export(tmp_path / "soup.stl")
    begun = time.perf_counter()
    hand = read(tmp_path, urdf(mesh("soup.stl")))
    assert time.perf_counter() - begun < 10.0
    assert len(hand.links[0].collision) <= 9


def robot(inside: str) -> str:
    return f'<robot name="s">{inside}</robot>'


ENTITIES = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
HOSTILE = {
    "entities": (f'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY l0 "lol">{ENTITIES}]>{robot("&l9;")}', "is not XML"),
    "another file": (f'<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>{robot("&x;")}', "is not XML"),
    "open": ('<robot name="s">' + "<link>" * 300_000, "is not XML"),
    "deep": (robot("<a>" * 200_000 + "</a>" * 200_000), "there is no <link>"),
    "many tags": (robot("<a/>" * 700_000), "700002 tags and attributes|700003 tags and attributes"),
    "many links": (
        robot("".join(f'<link name="l{i}"/>' for i in range(50_000))),
        "50000 links and 0 joints, .* up to 500",
    ),
    "many shapes": (urdf(solid('<sphere radius="1"/>') * 5000), "5000 shapes, allowed are up to 2000"),
    "many faults": (robot("".join(f'<link name="l{i}"><collision/></link>' for i in range(99))), "and 59 more"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_xml_is_refused_soon(tmp_path: Path, what: str) -> None:
    text, message = HOSTILE[what]
    begun = time.perf_counter()
    with pytest.raises(InvalidInputError, match=message) as told:
        read(tmp_path, text)
    assert len(str(told.value)) < 10_000
    assert time.perf_counter() - begun < 10.0
