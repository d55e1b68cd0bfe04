"""Meshes of hands: files, convex pieces and their cache, fitted fingertips."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull
from trimesh import creation
from urdf_text import finger, joint, link, read, small, solid

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.files import meshes, pieces
from grasp_env.sim.hand.files.pieces import convex_pieces
from grasp_env.sim.hand.solids import MAX_CORNERS, cut_below, few_corners, outline, shrunk
from grasp_env.sim.hand.tree import Geometry
from grasp_env.sim.hand.urdf import hand_files
from grasp_env.sim.objects import reading
from grasp_env.sim.objects.cache import entries

BOX = creation.box((0.02, 0.03, 0.04))
BALL = solid('<sphere radius="0.01"/>')
TIP = {"finger": ((0.0, 0.0, 0.005), 0.001)}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Use a cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def mesh(name: str, scale: str = "1 1 1", role: str = "collision") -> str:
    return solid(f'<mesh filename="{name}" scale="{scale}"/>', role=role)


def outside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the distances by which points stick out of the hull of corners [m]."""
    faces = ConvexHull(corners).equations
    return (points @ faces[:, :3].T + faces[:, 3]).max(axis=1)


def bent() -> Any:
    """Return an L of two boxes that share no corner."""
    long = creation.box((0.01, 0.01, 0.06))
    short = creation.box((0.03, 0.01, 0.01))
    return trimesh.util.concatenate([long, short.apply_translation((0.019, 0.0, -0.024))])


@pytest.mark.parametrize(
    "name",
    ["meshes/box.obj", "package://any_name/meshes/box.obj", "file://{folder}/meshes/box.stl"],
)
def test_meshes_are_found_and_become_hulls(tmp_path, name):
    """The meshes are in a folder above the URDF; their hulls are written and read without a change."""
    for folder in ("meshes", "urdf"):
        (tmp_path / folder).mkdir()
    for kind in ("obj", "stl"):
        BOX.export(tmp_path / "meshes" / f"box.{kind}")
    files = {}
    hulls = list[Any]()
    for scale in ("2 1 -0.5", "1 1 1", ""):  # the last time from the files that the hand becomes
        text = small(mesh(name.format(folder=tmp_path), scale)) if scale else files["hand.urdf"]
        made, _ = read(tmp_path / "urdf", text, TIP)
        hulls += [
            np.array(sorted(shape.corners))
            for shape in made.links[0].collision
            if shape.kind == "hull"
        ]
        files = hand_files(made)
        for file, written in files.items():
            (tmp_path / "urdf" / file).write_text(written)
    assert_allclose(np.abs(hulls[0]), np.tile((0.02, 0.015, 0.01), (8, 1)), atol=1e-7)
    assert_allclose(np.abs(hulls[1]), np.tile((0.01, 0.015, 0.02), (8, 1)), atol=1e-7)
    assert_array_equal(hulls[2], hulls[1])


CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


LOOKS = [
    ("a.obj", CORNERS + b"f 1 2 3\n", ""),
    ("a.glb", b"glTF", "are not one of .obj, .stl, .dae"),
    ("a.obj", b"", "are broken"),
    # Bullet would read beyond its corners, and crash
    ("a.obj", CORNERS + b"f 1 2 4\n", "are broken"),
    ("a.obj", b"f 1 2 3\n" + CORNERS, "are broken"),
    ("a.stl", bytes(10), "are empty"),
    ("a.stl", None, "are missing"),
]


@pytest.mark.parametrize(("name", "content", "why"), LOOKS)
def test_looks_that_cannot_be_drawn_are_left_out(tmp_path, name, content, why):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    made, told = read(tmp_path, small(mesh(name, "1 2 3", "visual") + BALL))
    assert told.endswith(f"visual meshes that {why} are left out: '{name}'" if why else "")
    drawn = Geometry("mesh", (1.0, 2.0, 3.0), file=str(tmp_path / name))
    assert made.links[0].visual[0] == (drawn if not why else made.links[0].collision[0])


@pytest.mark.parametrize(
    ("shape", "counts"),
    [
        (bent(), {2}),
        (creation.torus(0.03, 0.006, major_sections=32, minor_sections=16), range(3, 9)),
    ],
    ids=["bent", "ring"],
)
def test_hollow_meshes_fall_into_pieces(shape, counts):
    """The pieces contain all of the mesh, and a hole stays open."""
    found = convex_pieces(np.array(shape.vertices), np.array(shape.faces))
    assert len(found) in counts
    assert all(len(piece) <= MAX_CORNERS for piece in found)
    samples = np.vstack([trimesh.sample.sample_surface(shape, 500, seed=0)[0], shape.vertices])
    assert np.min([outside(samples, piece) for piece in found], axis=0).max() < 1e-6
    if len(found) == 2:
        assert sum(ConvexHull(piece).volume for piece in found) == pytest.approx(9e-6, rel=1e-3)
    else:
        assert min(outside(np.zeros((1, 3)), piece).item() for piece in found) > 0.003


def test_pieces_are_joined_and_soups_are_not_cut():
    """A cylinder half inside a box is one piece, no mesh has more than eight, and 20,000 loose
    triangles take no minutes."""
    hidden = [creation.cylinder(0.01, 0.04), creation.box((0.03, 0.03, 0.05))]
    row = [creation.box((0.004,) * 3).apply_translation((0.01 * k, 0.0, 0.0)) for k in range(12)]
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(20_000, 1, 3)) * 0.01 + rng.normal(size=(20_000, 3, 3)) * 0.005
    soup = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(60_000).reshape(-1, 3), process=False)
    for solids, count in ((hidden, 1), (row, 8), ([soup], 1)):
        mesh: Any = trimesh.util.concatenate(solids)
        assert len(convex_pieces(np.array(mesh.vertices), np.array(mesh.faces))) == count


def test_few_corners_contain_all_and_little_more():
    """40 corners around a ball stick out by an eighth of its radius."""
    points = np.array(creation.icosphere(3, 0.012).vertices)
    corners = few_corners(points)
    assert len(corners) <= MAX_CORNERS
    assert outside(points, corners).max() < 1e-9
    assert outside(corners, points).max() < 0.135 * 0.012
    assert few_corners(np.array(BOX.vertices)).shape == (8, 3)


def test_cut_and_inset_boxes_are_boxes():
    points = np.array(BOX.vertices)
    up = np.array([0.0, 0.0, 1.0])
    left = cut_below(points, up, 0.005)
    inner = shrunk(points, 1e-3)
    bounds = [(left.min(axis=0), left.max(axis=0)), (inner.min(axis=0), inner.max(axis=0))]
    assert_allclose(bounds[0], [(-0.01, -0.015, -0.02), (0.01, 0.015, 0.005)], atol=1e-12)
    assert_allclose(bounds[1], [(-0.009, -0.014, -0.019), (0.009, 0.014, 0.019)], atol=1e-9)
    assert len(cut_below(points, up, -0.02)) == 0
    thin = shrunk(points * (1.0, 1.0, 0.03), 1e-3)  # 1.2 mm: a third of the ball of 0.6 mm goes
    assert_allclose(np.ptp(thin, axis=0), (0.0196, 0.0296, 0.0008), atol=1e-6)


@pytest.mark.parametrize(
    ("shapes", "radius", "end"),
    [
        ("dome", 0.008, 0.023),  # a capsule's end, and the box around it is cut
        (solid('<box size="0.014 0.03 0.06"/>', "0 0 0.04"), 0.007, 0.07),  # half of the thickness
        # no larger than a fingertip
        (solid('<box size="0.06 0.06 0.06"/>', "0 0 0.04"), 0.015, 0.07),
        # no smaller, though it sticks out
        (solid('<box size="0.003 0.02 0.06"/>', "0 0 0.04"), 0.004, 0.07),
    ],
    ids=["dome", "pad", "thick", "thin"],
)
def test_a_tip_is_the_ball_in_the_end_of_its_link(tmp_path, shapes, radius, end):
    if shapes == "dome":
        creation.capsule(0.03, 0.008, count=(32, 32)).export(tmp_path / "dome.stl")
        shapes = mesh("dome.stl") + solid('<box size="0.016 0.024 0.03"/>', "0 0 0.01")
    made, _ = read(tmp_path, small(shapes))
    (tip,) = made.fingertips
    assert (tip.name, tip.link) == ("finger", "finger")
    assert tip.center[1] == pytest.approx(0.0, abs=1e-4)
    # of a hull of 40 corners
    assert tip.radius == pytest.approx(radius, abs=1e-3 if radius == 0.008 else 1e-4)
    assert end - 0.005 < tip.center[2] + tip.radius < end + 0.0051
    for shape in made.links[0].collision:
        if shape.kind != "sphere":
            # as near as few corners are
            assert outline(shape)[:, 2].max() < tip.center[2] - tip.radius + 1e-4


def test_tips_are_given_by_place(tmp_path):
    fixed = joint("end", "finger", "pad", "0 0 0.05", kind="fixed").replace(
        '0.05"', '0.05" rpy="0 1.5707963267948966 0"'
    )
    text = small(
        solid('<box size="0.02 0.02 0.06"/>', "0 0 0.03"), more=fixed + '<link name="pad"/>'
    )
    given, _ = read(tmp_path, text, {"pad": ((0.01, 0.0, 0.002), 0.006)})
    assert_allclose(given.fingertips[0].center, (0.002, 0.0, 0.04), atol=1e-12)
    assert given.finger_names == ("pad",)
    named, _ = read(tmp_path, text, ["pad"])  # no shape of its own: that of its link, towards it
    assert named.fingertips[0].radius == pytest.approx(0.01, abs=1e-4)
    assert 0.055 < named.fingertips[0].center[2] + 0.01 < 0.0601


def test_every_end_of_a_branch_is_a_finger(tmp_path):
    """Ends without a shape are left out; a sphere at the end of a link is the tip."""
    thumb = joint("t", "palm", "thumb") + link("thumb").replace(
        'box size="0.04 0.02 0.02"', 'sphere radius="0.011"'
    )
    more = (
        finger("i", "finger", "0 0 0") + thumb + joint("b", "i1", "blade") + '<link name="blade"/>'
    )
    made, told = read(tmp_path, small("", more=more))
    assert "end links without a shape are not fingertips: 'blade'" in told
    assert [tip.radius for tip in made.fingertips if tip.name != "i2"] == [0.011]


def fail(*_: Any, **__: Any) -> Any:
    raise AssertionError("this was to come from the cache")


def test_the_second_reading_makes_nothing(tmp_path, monkeypatch):
    bent().export(tmp_path / "bent.stl")
    creation.icosphere(2, 0.01).export(tmp_path / "seen.obj")
    text = small(mesh("seen.obj", role="visual"), mesh("bent.stl", "1 -1 0.5"))
    first, _ = read(tmp_path, text, ["finger"])  # the fingertip is sought in what is seen
    assert len(first.palm.collision) == 2
    corners = np.array(bent().vertices)
    faces = np.array(bent().faces)
    kept = pieces.cached_pieces(corners, faces, "of a model")
    assert ("of a model", "hand") in {(entry.name, entry.use) for entry in entries()}
    for module, name in ((pieces, "convex_pieces"), (reading, "apart"), (meshes, "_corners_exist")):
        monkeypatch.setattr(module, name, fail)
    assert read(tmp_path, text, ["finger"])[0] == first
    assert all(
        map(np.array_equal, pieces.cached_pieces(corners, faces.astype(np.int32), "again"), kept)
    )
    with pytest.raises(AssertionError, match="from the cache"):
        pieces.cached_pieces(1.1 * corners, faces, "other")
    bent().apply_scale(1.1).export(tmp_path / "bent.stl")  # the same file with other content
    with pytest.raises(AssertionError, match="from the cache"):
        read(tmp_path, text, ["finger"])


def test_one_process_reads_all_meshes_of_a_hand(tmp_path, monkeypatch):
    for name in ("a.stl", "b.obj", "c.ply"):
        BOX.export(tmp_path / name)
    runs = list[str]()
    apart = reading.apart
    monkeypatch.setattr(
        reading, "apart", lambda *given, **more: runs.append(given[1]) or apart(*given, **more)
    )
    text = small(mesh("a.stl") + mesh("b.obj"), mesh("c.ply") + mesh("a.stl", "2 2 2"))
    hands = [read(tmp_path, text, TIP)[0] for _ in range(2)]
    assert hands[0] == hands[1]
    assert runs == ["reading 3 mesh files, once for this content"]


def test_missing_meshes_are_told_at_once(tmp_path, monkeypatch):
    bent().export(tmp_path / "bent.stl")
    monkeypatch.setattr(meshes, "open_mesh", fail)
    palm = mesh("bent.stl") + mesh("meshes/a.stl") + mesh("c.stl", role="visual")
    with pytest.raises(InvalidInputError) as told:
        read(tmp_path, small(mesh("package://hand/b.obj") + mesh("meshes/a.stl"), palm))
    assert "'meshes/a.stl' (palm, finger), 'package://hand/b.obj' (finger). Download" in str(
        told.value
    )
    assert "c.stl" not in str(told.value)  # one to look at is left out


@pytest.mark.parametrize(
    ("unit", "scale"),
    [("<unit name='centimetre' meter='0.01'/>", "0.1 0.1 0.1"), ("<unit/>", "0.001 0.001 0.001")],
)
def test_the_unit_of_a_dae_counts(tmp_path, unit, scale):
    """ROS applies the unit, too; the up axis is ignored."""
    write_dae(tmp_path, f"{unit}<up_axis>Y_UP</up_axis>")
    made, _ = read(tmp_path, small(BALL, mesh("a.dae", scale) + mesh("a.dae", scale, "visual")))
    (hull,), (look,) = made.palm.collision, made.palm.visual
    assert_allclose(np.ptp(np.array(hull.corners), axis=0), (0.02, 0.03, 0.04), atol=1e-9)
    # engines multiply the file's numbers by `size`: neither Bullet nor the reader of MuJoCo's
    # pictures applies the unit
    assert look == Geometry("mesh", look.size, file=str(tmp_path / "a.dae"))
    assert look.size == pytest.approx((0.001, 0.001, 0.001))


def write_dae(folder: Path, asset: str) -> None:
    """Write a box of 20 x 30 x 40 with elements in its <asset>."""
    written: Any = creation.box((20.0, 30.0, 40.0)).export(file_type="dae")
    text = re.sub(r"<unit[^>]*/>|<up_axis>.*?</up_axis>", "", written.decode())
    assert "</asset>" in text
    (folder / "a.dae").write_text(text.replace("</asset>", f"{asset}</asset>"))


def test_meshes_of_millimetres_become_metres(tmp_path):
    """Visual meshes are judged by their own sizes."""
    creation.box((20.0, 30.0, 40.0)).export(tmp_path / "mm.obj")
    looks = [mesh("mm.obj", scale, "visual") for scale in ("1 1 1", "0.001 0.001 0.001")]
    text = small(mesh("mm.obj") + looks[0] + looks[1], mesh("mm.obj", "2 2 2"))
    made, told = read(tmp_path, text, TIP)
    (hull,) = made.palm.collision
    assert_allclose(np.ptp(np.array(hull.corners), axis=0), (0.04, 0.06, 0.08), atol=1e-9)
    assert "taken as millimetres and scaled by 0.001: 'mm.obj' (80 m), 'mm.obj' (40 m)" in told
    sizes = [shape.size for shape in made.links[0].visual if shape.kind == "mesh"]
    assert_allclose(sizes, np.full((2, 3), 0.001), rtol=1e-12)


@pytest.mark.parametrize(
    ("scale", "words"),
    [("0.001 0.001 0.001", "by 0.001 if the file is in millimetres"), ("20 20 20", "800 m large")],
    ids=["another in metres", "larger than a hand"],
)
def test_meshes_of_no_unit_are_refused(tmp_path, scale, words):
    creation.box((20.0, 30.0, 40.0)).export(tmp_path / "mm.obj")
    with pytest.raises(InvalidInputError, match=words):
        read(tmp_path, small(mesh("mm.obj"), mesh("mm.obj", scale)), TIP)


NO_MESH = [
    ("a.obj", b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "all its faces are lines or points"),
    ("a.txt", b"", "not of a supported type"),
    ("/dev/zero", None, "neither beside the URDF nor"),
    ("http://example.org/a.obj", None, "only file://, package:// and plain paths"),
    ("a" * 5000 + ".obj", None, "neither beside the URDF nor"),
    ("", None, "lacks filename="),
    ("a.dae", "inch", '<unit meter="inch">, which must be a number of metres above 0'),
]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    NO_MESH,
    ids=["a point", "kind", "device", "address", "long", "no name", "inches"],
)
def test_files_that_are_no_mesh_are_refused(tmp_path, name, content, message):
    if isinstance(content, str):
        write_dae(tmp_path, f'<unit meter="{content}"/>')
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, small(mesh(name)))
