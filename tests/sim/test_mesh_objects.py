"""Objects from meshes: measured, repaired, cut into pieces, and held."""

from __future__ import annotations

import json
import pickle
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import manifold3d
import numpy as np
import pytest
import trimesh
from engines import needs_bullet
from episodes import ENV
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull
from trimesh import Trimesh, creation

from grasp_env.errors import GraspWarning, InvalidInputError
from grasp_env.sim import BulletEngine, ObjectDescription
from grasp_env.sim.mesh_shape import volume
from grasp_env.sim.objects.closing import close_mesh
from grasp_env.sim.objects.mesh import _load, load_mesh, principal_rotation
from grasp_env.sim.objects.pieces import MAX_CORNERS, MAX_PIECES, convex_pieces


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """A cache for these tests alone, so that no solid is cut twice."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        _load.cache_clear()
        yield
        _load.cache_clear()


def cube(x: float, y: float, z: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    return manifold3d.Manifold.cube((x, y, z), True).translate(at)


def of_manifold(made: Any) -> Trimesh:
    mesh = made.to_mesh64()
    return Trimesh(
        np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False
    )


def l_shape() -> Trimesh:
    return of_manifold(cube(0.05, 0.09, 0.05) + cube(0.09, 0.03, 0.05, at=(0.02, -0.03, 0.0)))


def cup() -> Trimesh:
    return of_manifold(cube(0.06, 0.08, 0.06) - cube(0.05, 0.08, 0.05, at=(0.0, 0.005, 0.0)))


DENSITY = 400.0
Made = tuple[Trimesh, ObjectDescription]
SOLIDS: dict[str, Callable[[], Trimesh]] = {"L-shape": l_shape, "cup": cup}


@pytest.fixture(scope="module", params=SOLIDS)
def made(request, tmp_path_factory):
    """Solids that are not convex, turned and far from the origin."""
    solid = SOLIDS[request.param]()
    solid.apply_transform(
        trimesh.transformations.random_rotation_matrix(np.random.default_rng(1).random(3))
    )
    solid.apply_translation((0.3, -0.2, 0.1))
    return solid, load(tmp_path_factory.mktemp("mesh"), solid, density=DENSITY, friction=0.8)[0]


def box(*sides: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Trimesh:
    return creation.box(sides or (0.06, 0.05, 0.04)).apply_translation(at)


def together(*meshes: Trimesh) -> Any:
    return trimesh.util.concatenate(meshes)


def load(folder: Path, mesh: Trimesh, **settings: Any) -> tuple[ObjectDescription, str]:
    """The object, and its warnings."""
    mesh.export(folder / "a.obj", digits=17)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        item = ObjectDescription.from_mesh(folder / "a.obj", **settings)
    assert all(issubclass(each.category, GraspWarning) for each in told)
    return item, "; ".join(str(each.message) for each in told)


def test_mass_and_moments_are_those_of_the_solid(made):
    solid = made[0].copy()
    item = made[1]
    solid.density = DENSITY
    assert item.mass == pytest.approx(DENSITY * solid.volume, rel=1e-9)
    # axes count as principal if the rest beside the diagonal is small
    assert_allclose(np.sort(item.moments), np.sort(solid.principal_inertia_components), rtol=5e-6)
    body = Trimesh(*item.faces, process=False)
    body.density = DENSITY
    assert_allclose(body.moment_inertia, item.inertia_matrix, atol=3e-6 * max(item.moments))
    assert_allclose(body.center_mass, 0.0, atol=1e-10)
    assert_allclose(body.extents, item.extent, atol=1e-12)
    file = load_mesh(str(item.mesh), 1.0)
    back = item.faces[0] @ file.rotation + file.center  # the corners of the file
    assert (
        np.linalg.norm(back[:, None] - np.asarray(solid.vertices)[None], axis=2).min(axis=1).max()
        < 1e-10
    )
    for array in (*item.faces, *item.pieces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_scale_and_copies(made):
    item = made[1]
    half = ObjectDescription.from_mesh(str(item.mesh), 0.5, density=DENSITY)
    assert half.mass == pytest.approx(item.mass / 8.0, rel=1e-12)
    assert_allclose(half.moments, np.array(item.moments) / 32.0, rtol=1e-12)
    for one, other in zip(
        (item.faces[0], *item.pieces), (half.faces[0], *half.pieces), strict=True
    ):
        assert_array_equal(0.5 * one, other)
    found = item.surface.nearest(np.array([0.01, 0.05, 0.02]))
    stored = ObjectDescription(**json.loads(json.dumps(asdict(item))))
    for copy in (replace(item), pickle.loads(pickle.dumps(item)), stored):
        assert (copy, hash(copy)) == (item, hash(item))
        assert_array_equal(copy.surface.nearest(np.array([0.01, 0.05, 0.02]))[0], found[0])
    assert len(pickle.dumps(item)) < 2000  # without the mesh


def test_axes_turn_no_more_than_needed(tmp_path):
    matrix = np.asarray(trimesh.transformations.rotation_matrix(0.3, (1.0, 2.0, -1.0)))
    cubic, _ = load(tmp_path, box(0.1, 0.1, 0.1).apply_transform(matrix))
    assert np.ptp(cubic.faces[0], axis=0).min() > 0.11  # any axes of a cube are principal ones
    turn = matrix[:3, :3]
    rod = turn @ np.diag([1.0, 2.0, 1.0]) @ turn.T
    rotation = principal_rotation(rod)
    assert_allclose(rotation @ rod @ rotation.T, np.diag([1.0, 2.0, 1.0]), atol=1e-9)
    assert np.arccos(0.5 * (np.trace(rotation) - 1.0)) == pytest.approx(
        np.arccos(turn[1, 1]), abs=1e-6
    )


# --- pieces


def heights(item: ObjectDescription, points: np.ndarray) -> np.ndarray:
    """Heights of points above the nearest piece, negative inside."""
    hulls = [ConvexHull(piece).equations for piece in item.pieces]
    return np.min([(points @ hull[:, :3].T + hull[:, 3]).max(axis=1) for hull in hulls], axis=0)


def test_pieces_cover_the_mesh(made):
    item = made[1]
    size = max(made[1].extent)
    assert 1 < len(item.pieces) <= MAX_PIECES
    assert max(map(len, item.pieces)) <= MAX_CORNERS
    assert heights(item, item.faces[0]).max() < 1e-9 * size
    middles = item.faces[0][item.faces[1]].mean(axis=1)
    inner = [middle + 1e-4 * size * item.surface.nearest(middle)[1] for middle in middles]
    assert heights(item, np.array(inner)).max() < 0.02 * size
    volumes = sum(ConvexHull(piece).volume for piece in item.pieces)
    whole = volume(*item.faces)
    assert 0.99 * whole <= volumes < 1.5 * whole
    # deep in the convex hull, but outside of the mesh: the inside of the cup, the corner of the L
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (1000, 3)) * item.extent
    hull = ConvexHull(item.faces[0]).equations
    away = np.array([item.surface.nearest(point)[2] for point in points])
    hollow = ((points @ hull[:, :3].T + hull[:, 3]).max(axis=1) < 0.0) & (away > 0.015)
    assert hollow.sum() > 5
    assert heights(item, points[hollow]).min() > 0.008
    if len(item.faces[1]) < 25:  # the L is cut fast
        for one, other in zip(item.pieces, convex_pieces(*item.faces, "again"), strict=True):
            assert_array_equal(one, other)


def test_a_fine_ball_is_one_piece_of_few_corners(tmp_path):
    item, _ = load(tmp_path, creation.icosphere(4, 0.033))
    (piece,) = item.pieces
    assert len(piece) <= MAX_CORNERS
    assert heights(item, item.faces[0]).max() < 0.01 * max(item.extent)


# --- repairs


def without(solid: Trimesh, *gone: Any) -> Trimesh:
    return Trimesh(solid.vertices, np.delete(solid.faces, gone, axis=0), process=False)


def flipped(solid: Trimesh, every: int) -> Trimesh:
    faces = np.array(solid.faces)
    faces[::every] = faces[::every, ::-1]
    return Trimesh(solid.vertices, faces, process=False)


def open_seams(solid: Trimesh, gap: float) -> Trimesh:
    """Separate faces, their corners moved by a share of the size."""
    corners = np.array(solid.vertices)[solid.faces].reshape(-1, 3)
    corners = corners + np.random.default_rng(0).uniform(-0.5, 0.5, corners.shape) * gap * np.ptp(
        corners
    )
    return Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def nested(*sizes: float) -> Trimesh:
    """Balls within balls, every second one inside out."""
    balls = [creation.icosphere(1, size) for size in sizes]
    for ball in balls[1::2]:
        ball.invert()
    return together(*balls)


def beside() -> Trimesh:
    """A small box inside out in the corner of an L: in the L's bounding box, but not in the L."""
    return together(l_shape(), flipped(box(0.01, 0.01, 0.01, at=(0.05, 0.03, 0.0)), 1))


WHOLE = 0.06 * 0.05 * 0.04
BALL = creation.icosphere(1, 1.0).volume
SHELL = (0.05**3 - 0.04**3) * BALL
TURNED = "faces that pointed inward were turned"
REPAIRS: dict[str, tuple[Callable[[], Trimesh], float, str]] = {
    "a hole": (lambda: without(box(), 0), WHOLE, "holes were filled with 1 faces"),
    "a missing side": (
        lambda: without(box(), *np.flatnonzero(box().face_normals[:, 2] > 0.5)),
        WHOLE,
        "holes were filled with 2 faces",
    ),
    "flipped faces": (lambda: flipped(box(), 3), WHOLE, "faces were turned"),
    "inside out": (lambda: flipped(box(), 1), WHOLE, TURNED),
    "double faces": (
        lambda: Trimesh(box().vertices, np.vstack([box().faces, box().faces[:3]]), process=False),
        WHOLE,
        "duplicate faces",
    ),
    "open seams": (
        lambda: open_seams(box(), 2e-6),
        WHOLE,
        "corners were joined with others within 1e-05 of its size",
    ),
    "overlap": (
        lambda: together(box(), box(at=(0.03, 0.0, 0.0))),
        1.5 * WHOLE,
        "its 2 parts overlap and were united",
    ),
    "overlap with a common corner": (
        lambda: together(
            creation.box(bounds=[(0, 0, 0), (0.1, 0.1, 0.1)]),
            creation.box(bounds=[(0, 0, 0), (0.05, 0.05, 0.2)]),
        ),
        0.1**3 + 0.05**2 * 0.1,
        "united",
    ),
    "a box within a box": (
        lambda: together(box(), box(0.02, 0.02, 0.02)),
        WHOLE,
        "its 2 parts overlap and were united",
    ),
    "a wall between boxes": (lambda: together(box(), box(at=(0.06, 0.0, 0.0))), 2.0 * WHOLE, ""),
    "a hollow": (lambda: nested(0.05, 0.04), SHELL, ""),
    "a core in a hollow": (lambda: nested(0.05, 0.04, 0.02), SHELL + 0.02**3 * BALL, ""),
    "a core inside out": (
        lambda: flipped(nested(0.05, 0.04, 0.02), 1),
        SHELL + 0.02**3 * BALL,
        TURNED,
    ),
    "a part inside out beside another": (beside, l_shape().volume + 1e-6, TURNED),
    "parts apart": (lambda: together(box(), box(at=(0.1, 0.0, 0.0))), 2.0 * WHOLE, ""),
}


@pytest.mark.parametrize("name", REPAIRS)
def test_repairs_are_right_and_reported(name):
    make, expected, message = REPAIRS[name]
    solid = make()
    if name != "open seams":  # corners are merged in a grid, by luck of their places in it
        solid.apply_transform(
            trimesh.transformations.random_rotation_matrix(np.random.default_rng(4).random(3))
        )
    corners, faces, changes = close_mesh(np.array(solid.vertices), np.array(solid.faces), "mesh")
    assert message in "; ".join(changes)
    assert (changes == []) == (message == "") or name == "a wall between boxes"
    # welding at 1e-5 of the size moves corners by that much
    assert volume(corners, faces) == pytest.approx(
        expected, rel=1e-4 if name == "open seams" else 1e-6
    )
    assert Trimesh(corners, faces).is_watertight


def test_repairs_are_warned_of_each_time(tmp_path):
    torn = without(box(), 0)
    first = load(tmp_path, torn)[1]
    assert "holes were filled with 1 faces" in first
    assert "grasp object show" in first
    _load.cache_clear()
    assert load(tmp_path, torn)[1] == first


def test_too_many_parts():
    corners = np.concatenate([np.add(box().vertices, (0.1 * k, 0.0, 0.0)) for k in range(501)])
    with pytest.raises(
        InvalidInputError, match="501 parts that are not connected, allowed are up to 500"
    ):
        close_mesh(corners, np.concatenate([box().faces + 8 * k for k in range(501)]), "mesh")


# --- in a hand


@pytest.mark.parametrize(
    "engine",
    [
        *(
            pytest.param(BulletEngine(mesh_contacts=how), marks=needs_bullet)
            for how in ("faces", "pieces")
        ),
        "mujoco",
    ],
    ids=["faces", "pieces", "mujoco"],
)
def test_a_hand_holds_it(made, engine):
    """Its contacts are on the faces of the file."""
    if engine == "mujoco":
        pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    mesh, item = made
    file = load_mesh(str(item.mesh), 1.0)
    with closing(gym.make(ENV, hand="allegro", object=item, engine=engine)) as env:
        env.reset(seed=3)
        for _ in range(25):
            _, _, terminated, _, info = env.step(
                np.zeros(env.action_space.shape or (), dtype=np.float32)
            )
            assert not terminated, info
        look = env.unwrapped.scene.look()
        points = look.points @ file.rotation + file.center
        outward = -look.normals @ file.rotation
        _, away, faces = trimesh.proximity.closest_point_naive(mesh, points)
        assert away.max() < 1e-4
        # others may be at an edge
        assert np.einsum("ni,ni->n", mesh.face_normals[faces], outward).max() > np.cos(
            np.radians(2.0)
        )
        assert info["is_success"], info


def test_parts_that_are_not_connected_are_told(tmp_path):
    two = together(box(), box(at=(0.1, 0.0, 0.0)))
    item, told = load(tmp_path, two, mass=0.1)
    assert "has 2 parts that are not connected: they are held and move as one rigid body" in told
    assert item.extent[0] == pytest.approx(0.16)
    hollow = together(box(), Trimesh(0.5 * box().vertices, box().faces[:, ::-1], process=False))
    assert load(tmp_path, hollow, mass=0.1)[1] == ""  # a cavity is no part


def test_a_missing_mass_is_told(tmp_path):
    item, told = load(tmp_path, box())
    assert item.mass == 0.2
    assert (
        "neither mass nor density is given, 0.2 kg is assumed; give mass= [kg] or density=" in told
    )


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (60.0, "0.001 if the file is in millimetres (60 mm large)"),
        (
            6.0,
            "0.01 if the file is in centimetres (60 mm large), 0.0254 if the file is in inches (152 mm large)",
        ),
        # in millimetres it would be 5 m large
        (5000.0, "are its factor to metres, choose another"),
    ],
)
def test_a_fitting_scale_is_proposed(tmp_path, size, words):
    box(size, size, size).export(tmp_path / "a.stl")
    with pytest.raises(InvalidInputError) as told:
        ObjectDescription.from_mesh(tmp_path / "a.stl", mass=0.1)
    assert "scale= of `from_mesh` and size=" in str(told.value)
    assert words in str(told.value)


def finned(size: float) -> tuple[Trimesh, Trimesh]:
    """Return a ball, and the same with a stray face of this size on one of its edges."""
    ball = creation.icosphere(3, 0.03)
    a, b = ball.vertices[ball.faces[0, :2]]
    tip = 0.5 * (a + b) * (1.0 + size / 0.03)
    corners = np.vstack([ball.vertices, tip])
    fin = [[ball.faces[0, 0], ball.faces[0, 1], len(ball.vertices)]]
    return ball, Trimesh(corners, np.vstack([ball.faces, fin]), process=False)


def test_loops_where_three_faces_meet_are_closed(tmp_path):
    """A small stray face becomes a wall, which is dropped; the hole of a large one is an error."""
    ball, mesh = finned(0.004)
    item, told = load(tmp_path, mesh, density=DENSITY)
    assert "small holes were filled with 1 faces" in told
    assert item.mass == pytest.approx(DENSITY * ball.volume, rel=1e-6)
    with pytest.raises(InvalidInputError, match="is not closed: 3 edges"):
        load(tmp_path, finned(0.02)[1], density=DENSITY)


def test_of_faces_that_look_both_ways_one_is_kept(tmp_path):
    solid = box()
    faces = np.vstack([solid.faces, solid.faces[:, ::-1]])
    item, told = load(tmp_path, Trimesh(solid.vertices, faces, process=False), density=DENSITY)
    assert "of faces that look both ways one was kept" in told
    assert item.mass == pytest.approx(DENSITY * solid.volume, rel=1e-9)
