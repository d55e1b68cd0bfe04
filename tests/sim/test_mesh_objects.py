"""Objects from meshes of any kind: what is measured, mended, cut into pieces, kept and refused."""

from __future__ import annotations

import json
import os
import pickle
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import pytest
import trimesh
from processes import start
from scipy.spatial import ConvexHull
from trimesh import creation

from grasp_env.errors import GraspWarning, InvalidInputError
from grasp_env.sim import progress
from grasp_env.sim.objects import cache, pieces
from grasp_env.sim.objects.apart import apart
from grasp_env.sim.objects.cache import clear, entries, folder, kept
from grasp_env.sim.objects.closing import closed
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.sim.objects.mesh import _load, load_mesh
from grasp_env.sim.objects.pieces import MAX_PIECES, MOST_CORNERS, convex_pieces

DENSITY = 800.0


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder, so that no solid is cut twice."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def own_cache(shared: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No test reads or writes the user's cache, and none finds what another has left in this process."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(shared))
    _load.cache_clear()
    yield
    _load.cache_clear()


@pytest.fixture
def empty_cache(own_cache: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def manifold(mesh: trimesh.Trimesh) -> Any:
    return manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices), np.array(mesh.faces).astype(np.uint64)))


def of_manifold(made: Any) -> trimesh.Trimesh:
    mesh = made.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int), process=False)


def l_shape() -> trimesh.Trimesh:
    outline = np.array([(0.0, 0.0), (0.1, 0.0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.08), (0.0, 0.08)])
    return of_manifold(manifold3d.Manifold.extrude(manifold3d.CrossSection([outline]), 0.04))


def mug() -> trimesh.Trimesh:
    hole = creation.cylinder(0.032, 0.1, sections=10).apply_translation((0.0, 0.0, 0.006))
    handle = creation.torus(0.025, 0.006, major_sections=8, minor_sections=6)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1.0, 0.0, 0.0)))
    handle.apply_translation((0.038, 0.0, 0.0))
    cup = manifold(creation.cylinder(0.036, 0.1, sections=10)) - manifold(hole)
    return of_manifold(cup + (manifold(handle) - manifold(creation.cylinder(0.034, 0.2, sections=10))))


def torus() -> trimesh.Trimesh:
    return creation.torus(0.04, 0.012, major_sections=12, minor_sections=6)


def box(*sides: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return creation.box(sides or (0.06, 0.05, 0.04)).apply_translation(at)


def together(*meshes: trimesh.Trimesh) -> Any:
    return trimesh.util.concatenate(meshes)


def export(folder: Path, mesh: trimesh.Trimesh, name: str = "object.obj") -> str:
    """In a kind of file that has all digits."""
    path = str(folder / name)
    options: dict[str, Any] = {"digits": 17} if name.endswith(".obj") else {}
    mesh.export(path, **options)
    return path


def load(
    folder: Path, mesh: trimesh.Trimesh, name: str = "object.obj", **settings: Any
) -> tuple[ObjectDescription, str]:
    """The object, and what it was warned of."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made = ObjectDescription.from_mesh(export(folder, mesh, name), **settings)
    assert all(issubclass(each.category, GraspWarning) for each in told)
    return made, "; ".join(str(each.message) for each in told)


def volume(item: ObjectDescription) -> float:
    return float(trimesh.Trimesh(*item.faces, process=False).volume)


def heights(item: ObjectDescription, points: np.ndarray) -> np.ndarray:
    """Of points above the lowest piece, below 0 inside of one."""
    hulls = [ConvexHull(piece).equations for piece in item.pieces]
    return np.min([(points @ hull[:, :3].T + hull[:, 3]).max(axis=1) for hull in hulls], axis=0)


SOLIDS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "box": box, "L-shape": l_shape, "mug": mug, "torus": torus,
}  # fmt: skip


@pytest.mark.parametrize("name", SOLIDS)
def test_mass_and_moments_are_those_of_the_solid(tmp_path: Path, name: str) -> None:
    solid = SOLIDS[name]()
    if name in ("box", "L-shape"):  # the others are cut in other tests, too, as they are
        solid.apply_transform(trimesh.transformations.random_rotation_matrix(np.random.default_rng(1).random(3)))
        solid.apply_translation((0.3, -0.2, 0.1))
    item, told = load(tmp_path, solid, density=DENSITY)
    assert told == ""
    assert item.mass == pytest.approx(DENSITY * solid.volume, rel=1e-9)
    solid.density = DENSITY
    # the largest of what is left beside the diagonal is that below which axes count as principal ones
    np.testing.assert_allclose(np.sort(item.moments), np.sort(solid.principal_inertia_components), rtol=5e-6)
    made = trimesh.Trimesh(*item.faces, process=False)
    made.density = DENSITY
    np.testing.assert_allclose(made.moment_inertia, item.inertia_matrix, atol=3e-6 * max(item.moments))
    np.testing.assert_allclose(made.center_mass, 0.0, atol=1e-10)
    np.testing.assert_allclose(made.extents, item.extent, atol=1e-12)
    file = load_mesh(str(item.mesh), 1.0)
    back = item.faces[0] @ file.rotation + file.center  # each corner is one of the file's
    away = np.linalg.norm(back[:, None] - np.asarray(solid.vertices)[None], axis=2).min(axis=1)
    assert away.max() < 1e-10


def test_scale_multiplies_everything(tmp_path: Path) -> None:
    solid = l_shape()
    item, _ = load(tmp_path, solid, density=DENSITY)
    large, _ = load(tmp_path, solid.copy().apply_scale(1000.0), "large.obj", scale=0.001, density=DENSITY)
    assert large.mass == pytest.approx(item.mass, rel=1e-12)
    np.testing.assert_allclose(large.moments, item.moments, rtol=1e-9)
    np.testing.assert_allclose(large.faces[0], item.faces[0], atol=1e-12)
    half = ObjectDescription.from_mesh(str(item.mesh), 0.5, density=DENSITY)
    assert half.mass == pytest.approx(item.mass / 8.0, rel=1e-12)
    np.testing.assert_allclose(half.moments, np.array(item.moments) / 32.0, rtol=1e-12)
    for one, other in zip(item.pieces, half.pieces, strict=True):
        np.testing.assert_array_equal(0.5 * one, other)


def test_copies_are_equal(tmp_path: Path) -> None:
    item, _ = load(tmp_path, torus(), density=DENSITY, friction=0.7)
    center = np.array([0.01, 0.05, 0.02])
    expected = item.surface.nearest(center)
    for made in (
        replace(item), pickle.loads(pickle.dumps(item)), ObjectDescription(**json.loads(json.dumps(asdict(item)))),
    ):  # fmt: skip
        assert (made, hash(made)) == (item, hash(item))
        found = made.surface.nearest(center)
        np.testing.assert_array_equal(found[0], expected[0])
        assert found[2] == expected[2]
    assert replace(item, friction=0.6) != item
    assert len(pickle.dumps(item)) < 2000  # the mesh is made anew, not carried


@pytest.mark.parametrize("name", SOLIDS)
def test_pieces_hold_the_mesh(tmp_path: Path, name: str) -> None:
    item, _ = load(tmp_path, SOLIDS[name]())
    assert (len(item.pieces) == 1) == (name == "box")
    assert len(item.pieces) <= MAX_PIECES
    assert max(map(len, item.pieces)) <= MOST_CORNERS
    size = max(item.extent)
    assert heights(item, item.faces[0]).max() < 1e-9 * size
    middles = item.faces[0][item.faces[1]].mean(axis=1)
    inner = middles + [1e-4 * size * item.surface.nearest(middle)[1] for middle in middles]
    assert heights(item, inner).max() < 0.02 * size  # CoACD holds them, too, but for its own grain
    volumes = [ConvexHull(piece).volume for piece in item.pieces]
    assert sum(volumes) >= 0.99 * volume(item)
    assert sum(volumes) < 1.5 * volume(item)


def test_pieces_leave_hollows_open(tmp_path: Path) -> None:
    """The middle of a ring and of a mug, and the corner of an L are outside of the mesh, and of all pieces."""
    for name, place in (("torus", (0.0, 0.0, 0.0)), ("mug", (0.0, 0.0, 0.02)), ("L-shape", (0.07, 0.06, 0.02))):
        item, _ = load(tmp_path, SOLIDS[name](), f"{name}.obj")
        mesh = load_mesh(str(item.mesh), 1.0)
        point = mesh.rotation @ (np.array(place) - mesh.center)
        assert item.surface.nearest(point)[2] > 0.015
        assert heights(item, point[None])[0] > 0.008


def test_a_fine_ball_is_one_piece_of_few_corners(tmp_path: Path) -> None:
    item, _ = load(tmp_path, creation.icosphere(5, 0.033))
    (piece,) = item.pieces
    assert len(piece) <= MOST_CORNERS
    assert heights(item, item.faces[0]).max() < 0.01 * max(item.extent)  # 0.6 mm


def test_pieces_are_the_same_each_time() -> None:
    solid = torus()
    first, second = (convex_pieces(np.array(solid.vertices), np.array(solid.faces), "torus") for _ in range(2))
    assert len(first) == len(second) > 1
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


# --- repairs


def without(solid: trimesh.Trimesh, *gone: Any) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices, np.delete(solid.faces, gone, axis=0), process=False)


def flipped(solid: trimesh.Trimesh, every: int) -> trimesh.Trimesh:
    faces = np.array(solid.faces)
    faces[::every] = faces[::every, ::-1]
    return trimesh.Trimesh(solid.vertices, faces, process=False)


def doubled(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices, np.vstack([solid.faces, solid.faces[:3]]), process=False)


def open_seams(solid: trimesh.Trimesh, gap: float) -> trimesh.Trimesh:
    """Every face on its own, its corners off by a part of the size."""
    corners = np.array(solid.vertices)[solid.faces].reshape(-1, 3)
    corners = corners + np.random.default_rng(0).uniform(-0.5, 0.5, corners.shape) * gap * np.ptp(corners)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


WHOLE = 0.06 * 0.05 * 0.04
REPAIRS: dict[str, tuple[Callable[[], trimesh.Trimesh], float, str]] = {
    "a hole": (lambda: without(box(), 0), WHOLE, "holes were filled with 1 faces"),
    "a missing side": (lambda: without(box(), *np.flatnonzero(box().face_normals[:, 2] > 0.5)), WHOLE, "holes were filled with 2 faces"),
    "flipped faces": (lambda: flipped(box(), 3), WHOLE, "faces were turned"),
    "inside out": (lambda: flipped(box(), 1), WHOLE, "faces that pointed inward were turned"),
    "double faces": (lambda: doubled(box()), WHOLE, "duplicate faces and faces back to back were dropped"),
    "open seams": (lambda: open_seams(box(), 2e-6), WHOLE, "corners were joined with others within 1e-05 of its size"),
    "overlapping boxes": (lambda: together(box(), box(at=(0.03, 0.0, 0.0))), 1.5 * WHOLE, "its 2 parts overlap and were united"),
    "a box within a box": (lambda: together(box(), box(0.02, 0.02, 0.02)), WHOLE, "its 2 parts overlap and were united"),
}  # fmt: skip


@pytest.mark.parametrize("name", REPAIRS)
def test_repairs_are_told_and_right(tmp_path: Path, name: str) -> None:
    make, expected, message = REPAIRS[name]
    item, told = load(tmp_path, make())
    assert message in told
    assert "grasp object show" in told
    # welding at 1e-5 of the size moves corners by that much
    assert volume(item) == pytest.approx(expected, rel=1e-4 if name == "open seams" else 1e-6)
    assert trimesh.Trimesh(*item.faces).is_watertight
    assert item.surface.nearest(np.array([0.0, 0.0, 0.3]))[2] > 0.2
    assert item.surface.nearest(item.faces[0][item.faces[1][0]].mean(axis=0) * 0.999)[2] < 1e-9


def test_hollows_and_parts_apart_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inner = box(0.02, 0.02, 0.02)
    inner.invert()
    with monkeypatch.context() as patched:
        patched.setattr(pieces, "CONCAVITY", 0.3)  # sooner done
        hollow, told = load(tmp_path, together(box(), inner), "hollow.obj")
    assert told == ""
    assert volume(hollow) == pytest.approx(WHOLE - 0.02**3, rel=1e-9)
    assert hollow.surface.nearest(np.zeros(3))[2] == pytest.approx(0.01, abs=1e-9)  # the hollow is outside
    assert hollow.surface.nearest(np.array([0.0, 0.017, 0.0]))[2] < 0.0
    pair, told = load(tmp_path, together(box(), box(at=(0.1, 0.0, 0.0))), "apart.obj")
    assert told == ""
    assert volume(pair) == pytest.approx(2.0 * WHOLE, rel=1e-9)
    assert len(pair.pieces) == 2
    assert pair.surface.nearest(np.zeros(3))[2] == pytest.approx(0.02, abs=1e-9)  # between the two


def test_boxes_that_touch_have_no_wall_between_them(tmp_path: Path) -> None:
    solid = together(box(0.05, 0.04, 0.03), box(0.05, 0.04, 0.03, at=(0.05, 0.0, 0.0)))
    solid.apply_transform(trimesh.transformations.random_rotation_matrix(np.random.default_rng(4).random(3)))
    item, _ = load(tmp_path, solid)
    points = np.random.default_rng(0).uniform(-0.012, 0.012, (500, 3))  # all inside
    assert max(item.surface.nearest(point)[2] for point in points) < 0.0


def test_boxes_that_overlap_and_have_a_corner_in_common() -> None:
    solid = together(
        creation.box(bounds=[(0, 0, 0), (0.1, 0.1, 0.1)]), creation.box(bounds=[(0, 0, 0), (0.05, 0.05, 0.2)])
    )
    corners, faces, _ = closed(
        np.array(solid.vertices), np.array(solid.faces), "mesh"
    )  # CoACD would not come to an end
    assert pieces.volume(corners, faces) == pytest.approx(0.1**3 + 0.05**2 * 0.1, rel=1e-6)


def nested(*sizes: float) -> trimesh.Trimesh:
    """Balls within balls, every second one inside out."""
    balls = [creation.icosphere(2, size) for size in sizes]
    for ball in balls[1::2]:
        ball.invert()
    return together(*balls)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("sizes", [(0.05, 0.04), (0.05, 0.04, 0.02)])
def test_hollows_and_cores_count_whichever_way_all_faces_look(sizes: tuple[float, ...], inverted: bool) -> None:
    solid = nested(*sizes)
    expected = sum((-1) ** k * creation.icosphere(2, size).volume for k, size in enumerate(sizes))
    if inverted:
        solid.invert()
    corners, faces, changes = closed(np.array(solid.vertices), np.array(solid.faces), "mesh")
    assert pieces.volume(corners, faces) == pytest.approx(expected, rel=1e-9)
    assert changes == (["faces that pointed inward were turned"] if inverted else [])


def test_a_part_inside_out_beside_another_is_no_hollow() -> None:
    """It lies in the box about the other, an L, but not in the L."""
    small = creation.box(bounds=[(0.06, 0.06, 0.01), (0.08, 0.08, 0.03)])
    small.invert()
    big = l_shape()
    low, high = big.bounds
    small.apply_translation(low + 0.8 * (high - low) - small.bounds.mean(axis=0))
    solid = together(big, small)
    inside = trimesh.Trimesh(big.vertices, big.faces).bounds
    assert (inside[0] < small.bounds[0]).all()
    corners, faces, _ = closed(np.array(solid.vertices), np.array(solid.faces), "mesh")
    assert pieces.volume(corners, faces) == pytest.approx(big.volume + abs(small.volume), rel=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: without(creation.icosphere(2, 0.05), *range(0, 320, 3)), "is not closed: .*grasp object mend"),
        (lambda: trimesh.Trimesh(box().vertices, [[0, 1, 2], [0, 2, 1]], process=False), "encloses no volume"),
        (lambda: box(0.06, 0.05, 5e-4), "allowed are 0.001 to 1"),
        (lambda: box(60.0, 50.0, 40.0), "millimetres"),
    ],
)
def test_refusals(tmp_path: Path, make: Callable[[], trimesh.Trimesh], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        load(tmp_path, make())
    for density in (0.0, -1.0, np.nan, "heavy"):
        with pytest.raises(InvalidInputError, match="density"):
            load(tmp_path, box(), density=density)
    with pytest.raises(InvalidInputError, match="not both"):
        load(tmp_path, box(), density=1000.0, mass=1.0)


# --- the cache


def fail(*_: Any, **__: Any) -> Any:
    raise AssertionError("this was to come from the cache")


def test_what_is_kept_is_taken_by_content(tmp_path: Path, empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solid = l_shape()
    item, _ = load(tmp_path, solid)
    (entry,) = entries()
    assert (entry.name, entry.path.parent) == ("object.obj", folder())
    assert folder().is_relative_to(tmp_path)
    assert entry.size == entry.path.stat().st_size
    monkeypatch.setattr(pieces, "apart", fail)
    _load.cache_clear()
    again = ObjectDescription.from_mesh(str(item.mesh))
    elsewhere, _ = load(tmp_path, solid, "copy.obj")
    for made in (again, elsewhere):
        for one, other in zip((*item.faces, *item.pieces), (*made.faces, *made.pieces), strict=True):
            np.testing.assert_array_equal(one, other)
        assert made.moments == item.moments
    load(tmp_path, solid, "copy.obj", scale=0.5)  # the scale is no part of the content
    assert len(entries()) == 1
    with pytest.raises((AssertionError, InvalidInputError), match="from the cache"):
        load(tmp_path, solid.copy().apply_scale(1.01), "object.obj")  # the same path with other content
    assert clear() == 1
    assert entries() == []
    assert list(folder().iterdir()) == []
    assert clear() == 0
    _load.cache_clear()
    with pytest.raises((AssertionError, InvalidInputError), match="from the cache"):
        ObjectDescription.from_mesh(str(item.mesh))


def test_repairs_are_told_each_time(tmp_path: Path) -> None:
    first = load(tmp_path, without(box(), 0))[1]
    _load.cache_clear()
    assert load(tmp_path, without(box(), 0))[1] == first != ""


@pytest.mark.parametrize(
    "spoil",
    [
        lambda blob: blob[: len(blob) // 2],
        lambda blob: b"",
        lambda blob: b"not ours",
        lambda blob: blob[:-30] + bytes(30),
    ],
)
def test_a_spoiled_entry_is_made_anew(tmp_path: Path, empty_cache: Path, spoil: Callable[[bytes], bytes]) -> None:
    item, _ = load(tmp_path, l_shape())
    (entry,) = entries()
    entry.path.write_bytes(spoil(entry.path.read_bytes()))
    assert len(entries()) == 1  # whatever it holds
    _load.cache_clear()
    again = ObjectDescription.from_mesh(str(item.mesh))
    np.testing.assert_array_equal(again.faces[0], item.faces[0])
    assert entries()[0].name == "object.obj"


def test_an_entry_of_other_arrays_is_made_anew(tmp_path: Path, empty_cache: Path) -> None:
    item, _ = load(tmp_path, l_shape())
    (entry,) = entries()
    with open(entry.path, "wb") as file:
        np.savez(file, other=np.zeros(3))
    _load.cache_clear()
    np.testing.assert_array_equal(ObjectDescription.from_mesh(str(item.mesh)).faces[0], item.faces[0])


def test_an_entry_runs_no_code(tmp_path: Path, empty_cache: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "exploded",))

    item, _ = load(tmp_path, l_shape())
    (entry,) = entries()
    with open(entry.path, "wb") as file:
        np.savez(file, vertices=np.array([Bomb()], dtype=object))
    _load.cache_clear()
    np.testing.assert_array_equal(ObjectDescription.from_mesh(str(item.mesh)).faces[0], item.faces[0])
    assert not (tmp_path / "exploded").exists()


def test_a_folder_that_cannot_be_written_costs_time_only(empty_cache: Path) -> None:
    empty_cache.write_text("a file where the folder should be")
    calls: list[int] = []
    for count in (1, 2):
        found = kept("key", "name", {"calls"}, lambda: {"calls": np.array(calls.append(1) or len(calls))})
        assert found["calls"] == count
    assert entries() == []
    assert clear() == 0


def test_an_error_keeps_nothing(empty_cache: Path) -> None:
    def bad() -> dict[str, Any]:
        raise InvalidInputError("no mesh")

    with pytest.raises(InvalidInputError, match="no mesh"):
        kept("key", "name", {"value"}, bad)
    assert entries() == []
    assert kept("key", "name", {"value"}, lambda: {"value": np.array(3.0)})["value"] == 3.0  # and no lock
    assert kept("key", "name", {"value"}, fail)["value"] == 3.0


def test_nobody_waits_for_ever(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "LONGEST_WAIT", 0.3)
    with ExitStack() as stack:
        stack.enter_context(cache._locked(folder() / "key.npz"))
        begun = time.monotonic()
        kept("key", "name", {"value"}, lambda: {"value": np.array(3.0)})
        assert 0.25 < time.monotonic() - begun < 5.0


WORKER = """
import sys, time
import numpy as np
from grasp_env.sim.objects.cache import kept

def make():
    with open(sys.argv[1], "a") as file:
        file.write("made\\n")
    time.sleep(0.5)
    return {"value": np.arange(5)}

print(kept("key", "name", {"value"}, make)["value"].sum())
"""


def test_four_processes_make_one_entry(tmp_path: Path, empty_cache: Path) -> None:
    log = tmp_path / "log"
    with ExitStack() as stack:
        running = [
            stack.enter_context(start([sys.executable, "-c", WORKER, str(log)], 60.0, stdout=-1, text=True))
            for _ in range(4)
        ]
        assert [process.communicate()[0].strip() for process in running] == ["10"] * 4
    assert log.read_text() == "made\n"
    assert [entry.name for entry in entries()] == ["name"]
    assert [path.suffix for path in folder().iterdir() if path.suffix not in (".npz", ".lock")] == []


# --- long work


TASK = f"{__name__}:task"


def task(what: np.ndarray) -> dict[str, np.ndarray]:
    """In the other process."""
    if what[0] == "sleep":
        time.sleep(60.0)
    if what[0] == "crash":
        os.kill(os.getpid(), 11)
    if what[0] == "raise":
        raise KeyError("inside")
    time.sleep(0.3)
    return {"twice": np.arange(3) * 2}


def test_work_apart_returns_crashes_raises_and_ends(capsys: pytest.CaptureFixture[str]) -> None:
    assert apart(TASK, "work", 60.0, what=np.array(["fine"]))["twice"].tolist() == [0, 2, 4]
    with pytest.raises(ChildProcessError, match="exit code -11"):
        apart(TASK, "work", 60.0, what=np.array(["crash"]))
    with pytest.raises(ChildProcessError, match="KeyError: 'inside'"):
        apart(TASK, "work", 60.0, what=np.array(["raise"]))
    begun = time.monotonic()
    with pytest.raises(TimeoutError, match="more than 1 s"):
        apart(TASK, "work", 1.0, what=np.array(["sleep"]))
    assert time.monotonic() - begun < 10.0
    assert capsys.readouterr().err == ""  # no terminal


def test_long_work_is_told_of_on_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    apart(TASK, "cutting", 60.0, what=np.array(["fine"]))
    assert "\rcutting, 0 s" in capsys.readouterr().err


def test_a_mesh_that_coacd_crashes_on_is_cut_by_vhacd_or_refused(
    tmp_path: Path, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def crash(name: str, *_: Any, **given: Any) -> Any:
        asked.append(name.rsplit("_", 1)[1])
        if asked[-1] == "coacd" or refuse:
            raise ChildProcessError("crashed")
        return apart(name, *_, **given)

    refuse = False
    monkeypatch.setattr(pieces, "apart", crash)
    item, _ = load(tmp_path, l_shape())
    assert asked == ["coacd", "vhacd"]
    assert len(item.pieces) > 1
    clear()
    _load.cache_clear()
    refuse = True
    with pytest.raises(InvalidInputError, match=r"cannot be cut .*grasp object mend"):
        load(tmp_path, l_shape())


INTERRUPTED = f"""
import numpy as np
from grasp_env.sim.objects.apart import apart
print("begun", flush=True)
apart({TASK!r}, "work", 60.0, what=np.array(["sleep"]))
"""


def test_ctrl_c_ends_the_process(tmp_path: Path) -> None:
    with start([sys.executable, "-c", INTERRUPTED], 60.0, stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        time.sleep(0.3)
        begun = time.monotonic()
        process.send_signal(2)
        _, told = process.communicate()
        assert time.monotonic() - begun < 5.0
        assert "KeyboardInterrupt" in told
        assert process.returncode != 0


# --- what a first user runs into


def test_a_heap_of_crumbs_is_refused_at_once() -> None:
    crumbs = together(*[box(0.001, 0.001, 0.001, at=(0.01 * k, 0.01 * j, 0.0)) for k in range(30) for j in range(20)])
    begun = time.monotonic()
    with pytest.raises(InvalidInputError, match="600 parts that are not connected, allowed are up to 500"):
        closed(np.array(crumbs.vertices), np.array(crumbs.faces), "mesh")
    assert time.monotonic() - begun < 5.0


def test_arrays_of_a_mesh_are_not_written_to(tmp_path: Path) -> None:
    item, _ = load(tmp_path, l_shape())
    for array in (*item.faces, *item.pieces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_folder_without_locks_costs_no_wait(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(38, "no locks here")

    monkeypatch.setattr(cache.fcntl, "flock", refuse)
    begun = time.monotonic()
    assert kept("key", "name", {"value"}, lambda: {"value": np.array(3.0)})["value"] == 3.0
    assert time.monotonic() - begun < 5.0


def test_modules_in_the_users_folder_are_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "random.py").write_text("raise RuntimeError('the wrong module')")
    monkeypatch.chdir(tmp_path)
    assert apart(TASK, "work", 60.0, what=np.array(["fine"]))["twice"].tolist() == [0, 2, 4]


@pytest.mark.parametrize(
    ("path", "settings", "message"),
    [
        (None, {}, "path must be a path"),
        ("ring.stl", {"scale": "big"}, "scale must"),
        ("ring.stl", {"density": 1000.0, "mass": 0.1}, "not both"),
        ("nowhere.stl", {}, "No such file"),
    ],
)
def test_wrong_arguments_are_told(path: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ObjectDescription.from_mesh(path, **settings)
