"""The nearest point of a mesh and its side against all of its faces one by one, and against solid angles."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import manifold3d
import numpy as np
import pytest
import trimesh
from trimesh import creation

from grasp_env import core

CLOSE = 1e-12
"""Of the size of a mesh, by which distances may be off: corners hold 2e-16 of it, a thousandth of a thin face."""
THIN = 3e-8
"""The same where faces are thinner than 1e-4 of their length. A face of height h has its points to 2e-16 / h of the size, and the edges
of its neighbours are h away: the worse of the two is this at most."""
THIN_ONES = (
    "needles",
    "turned needles",
    "strip of 1e-9",
    "strip of 1e-11",
    "strip of 1e-13",
    "strip of 1e-15",
    "plate",
    "triangles of 1e-7",
)
EDGE = 1e-9
"""[m] from an edge or a corner, within which the normal is that of the faces there instead of the direction."""
Solid = tuple[np.ndarray, np.ndarray]


def solid(mesh: Any) -> Solid:
    return np.array(mesh.vertices, dtype=float), np.array(mesh.faces)


def joined(*solids: Solid) -> Solid:
    return solid(trimesh.util.concatenate([trimesh.Trimesh(*each, process=False) for each in solids]))


def manifold(mesh: trimesh.Trimesh) -> Any:
    points, faces = solid(mesh)
    return manifold3d.Manifold(manifold3d.Mesh64(points, faces.astype(np.uint64)))


def of_manifold(made: Any) -> Solid:
    mesh = made.to_mesh64()
    return np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(int)


def extruded(outline: np.ndarray, height: float = 0.5) -> Solid:
    return of_manifold(manifold3d.Manifold.extrude(manifold3d.CrossSection([outline]), height))


def prism(outline: np.ndarray, height: float = 1.0) -> Solid:
    """Over an outline (N, 2) that the first corner sees all of; a fan at each end, so that no corner is left out."""
    count = len(outline)
    corners = np.vstack([np.column_stack([outline, np.full(count, z)]) for z in (0.0, height)])
    faces = [(0, k + 1, k) for k in range(1, count - 1)] + [
        (count, count + k, count + k + 1) for k in range(1, count - 1)
    ]
    for k in range(count):
        after = (k + 1) % count
        faces += [(k, after, count + after), (k, count + after, count + k)]
    return corners, np.array(faces)


def mug() -> Solid:
    cup = manifold(creation.cylinder(0.4, 1.0, sections=24)) - manifold(
        creation.cylinder(0.35, 1.0, sections=24).apply_translation((0.0, 0.0, 0.1))
    )
    handle = creation.torus(0.3, 0.05, major_sections=16, minor_sections=8)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1.0, 0.0, 0.0)))
    handle.apply_translation((0.42, 0.0, 0.0))
    return of_manifold(cup + (manifold(handle) - manifold(creation.cylinder(0.38, 1.0, sections=24))))


def gear(teeth: int, inner: float) -> Solid:
    angles = np.arange(2 * teeth) * np.pi / teeth
    radii = np.where(np.arange(2 * teeth) % 2, inner, 0.5)
    return extruded(np.column_stack([radii * np.cos(angles), radii * np.sin(angles)]), 0.2)


def spiky() -> Solid:
    """A ball whose every fourth corner stands out in a needle."""
    corners, faces = solid(creation.icosphere(1, 0.5))
    corners[::4] *= 3.0
    corners[1::4] *= 0.3
    return corners, faces


def sliver(width: float) -> Solid:
    """A box with a strip of this width on its top, and thin faces from it to a far corner at both ends."""
    return prism(np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (width, 0.5), (0.0, 0.5), (-0.5, 0.5)]))


def t_junction(splits: int, sharp: float = 1.0) -> Solid:
    """A wedge whose upper edge has corners more on one side only, with faces without area between."""
    corners, faces = solid(creation.box((1.0, 1.0, 1.0)))
    corners[corners[:, 2] > 0.0, 1] *= sharp
    upper = np.flatnonzero((corners[:, 2] > 0.0) & (corners[:, 1] > 0.0))
    around = [face for face in faces if np.isin(upper, face).all()]
    first = around[0]
    k = next(k for k in range(3) if first[k] in upper and first[(k + 1) % 3] in upper)
    begin, end, tip = first[k], first[(k + 1) % 3], first[(k + 2) % 3]
    parts = np.linspace(0.0, 1.0, splits + 2)[1:-1, None]
    row = [begin, *range(len(corners), len(corners) + splits), end]
    corners = np.vstack([corners, (1.0 - parts) * corners[begin] + parts * corners[end]])
    rest = [tuple(face) for face in faces if tuple(face) != tuple(first)]
    fine = [(one, other, tip) for one, other in pairwise(row)]
    empty = [(begin, row[k + 1], row[k]) for k in range(1, splits + 1)]
    return corners, np.array([*rest, *fine, *empty])


def tiny(side: float) -> Solid:
    """A tetrahedron with a triangle of this side in the middle of a face."""
    corners, faces = solid(creation.icosahedron())
    a, b, c = faces[0]
    middle = corners[faces[0]].mean(axis=0)
    corners = np.vstack([corners, middle + side * (corners[faces[0]] - middle)])
    d, e, f = range(len(corners) - 3, len(corners))
    more = [(d, e, f), (a, b, d), (b, e, d), (b, c, e), (c, f, e), (c, a, f), (a, d, f)]
    return corners, np.vstack([faces[1:], more])


def fan() -> Solid:
    """A pyramid whose tip has forty narrow faces on one side: only angles weigh them rightly."""
    angles = np.append(np.linspace(0.0, 0.5 * np.pi, 40), (np.pi, 1.5 * np.pi))
    around = prism(np.column_stack([np.cos(angles), np.sin(angles)]))
    count = len(angles)
    corners = np.vstack([around[0][:count], [(0.0, 0.0, 0.3)]])
    sides = [(k, (k + 1) % count, count) for k in range(count)]
    return corners, np.vstack([[(0, k + 1, k) for k in range(1, count - 1)], sides])


def turned(given: Solid, seed: int = 0) -> Solid:
    matrix = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))[:3, :3]
    return given[0] @ matrix.T, given[1]


def moved(given: Solid, by: tuple[float, float, float], times: float = 1.0) -> Solid:
    return times * given[0] + by, given[1]


def lattice() -> Solid:
    grid = np.linspace(-0.5, 0.5, 4)
    points = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3)
    return solid(trimesh.convex.convex_hull(points))


def needles() -> Solid:
    """A box, whose sides are cut from one corner of the bottom to a thousand places of one edge of the top, all near its end."""
    places = np.concatenate([[0.5], 0.5 - np.geomspace(1e-7, 0.9, 30)])
    return prism(np.array([(-0.5, -0.5), (0.5, -0.5), *((x, 0.5) for x in places), (-0.5, 0.5)]))


ball = creation.icosphere
MESHES: dict[str, Callable[[], Solid]] = {
    "tetrahedron": lambda: (np.vstack([np.zeros(3), np.eye(3)]), np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])),
    "box": lambda: solid(creation.box((1.0, 0.6, 0.8))),
    "box of many coplanar faces": lambda: solid(creation.box((1.0, 0.6, 0.8)).subdivide().subdivide()),
    "ball": lambda: solid(ball(3, 0.5)),
    "coarse ball": lambda: turned(solid(ball(1, 0.5))),
    "rock": lambda: solid(trimesh.convex.convex_hull(np.random.default_rng(0).normal(size=(80, 3)))),
    "lattice": lattice,
    "cylinder": lambda: solid(creation.cylinder(0.4, 1.0, sections=48)),
    "torus": lambda: solid(creation.torus(0.4, 0.15, major_sections=24, minor_sections=12)),
    "annulus": lambda: turned(solid(creation.annulus(0.2, 0.5, 0.3, sections=24))),
    "capsule": lambda: solid(creation.capsule(0.6, 0.2, count=[12, 12])),
    "L-shape": lambda: turned(prism(np.array([(0.6, 0.0), (0.0, 0.0), (0.0, -1.0), (1.0, -1.0), (1.0, 0.4), (0.6, 0.4)]))),
    "mug": mug,
    "gear": lambda: gear(16, 0.4),
    "star": lambda: turned(gear(5, 0.1)),
    "spikes": spiky,
    "fan": fan,
    "needles": needles,
    "turned needles": lambda: turned(needles()),
    "strip of 1e-9": lambda: turned(sliver(1e-9)),
    "strip of 1e-11": lambda: turned(sliver(1e-11)),
    "strip of 1e-13": lambda: sliver(1e-13),
    "strip of 1e-15": lambda: sliver(1e-15),
    "junction": lambda: t_junction(1),
    "sharp junction": lambda: turned(t_junction(3, 0.1)),
    "long junction": lambda: turned(t_junction(20, 0.1)),
    "triangles of 1e-7": lambda: tiny(1e-7),
    "plate": lambda: turned(solid(creation.box((1.0, 0.7, 1e-5)))),
    "millimetres": lambda: moved(mug(), (0.0, 0.0, 0.0), 1e-3),
    "ten metres": lambda: moved(gear(9, 0.3), (0.0, 0.0, 0.0), 10.0),
    "far away": lambda: moved(solid(creation.torus(0.4, 0.15, major_sections=16, minor_sections=8)), (300.0, -500.0, 200.0)),
    "hollow ball": lambda: joined(solid(ball(2, 0.5)), (solid(ball(2, 0.4))[0], solid(ball(2, 0.4))[1][:, ::-1])),
    "apart": lambda: joined(solid(ball(1, 0.3)), moved(solid(creation.box((0.5, 0.5, 0.5))), (0.9, 0.1, 0.0))),
}  # fmt: skip


@cache
def mesh_of(name: str) -> tuple[np.ndarray, np.ndarray, core.Surface]:
    corners, faces = MESHES[name]()
    return corners, faces, core.Surface.mesh(corners, faces.astype(float), [corners])


def queries(corners: np.ndarray, faces: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, int]:
    """Points (about `count`) of all kinds, those on the surface first, and how many these are."""
    rng, each = np.random.default_rng(seed), max(count // 8, 1)
    size, middle = np.ptp(corners, axis=0).max(), 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    sums = np.cumsum(trimesh.triangles.area(corners[faces]))
    by_area = np.minimum(np.searchsorted(sums, rng.uniform(0.0, sums[-1], each)), len(faces) - 1)
    by_number = rng.integers(len(faces), size=2 * each)
    chosen = np.concatenate([by_area, by_number])
    weights = rng.dirichlet((1.0, 1.0, 1.0), len(chosen))
    weights[2 * each :, 2] = 0.0  # on edges
    weights /= weights.sum(axis=1, keepdims=True)
    on = np.vstack(
        [np.einsum("pk,pkc->pc", weights, corners[faces[chosen]]), corners[rng.integers(len(corners), size=each)]]
    )
    off = size * 10.0 ** rng.uniform(-9.0, -1.0, (len(on), 1))
    near = on + off * rng.normal(size=on.shape)
    near = near[rng.permutation(len(near))[: 2 * each]]
    around = middle + 1.2 * size * rng.uniform(-0.5, 0.5, (each, 3))
    far = middle + 30.0 * size * rng.normal(size=(each // 2 + 1, 3))
    return np.vstack([on, near, around, far]), len(on)


def exact_distances(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Of points (P, 3) to the nearest of triangles (F, 3, 3), in as many digits as numpy has."""
    corner, points = triangles.astype(np.longdouble), points.astype(np.longdouble)
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    across = np.cross(first, second)
    area = np.einsum("fk,fk->f", across, across)
    least = np.full(len(points), np.inf, dtype=np.longdouble)
    with np.errstate(divide="ignore", invalid="ignore"):
        for row, point in enumerate(points):
            arm = point - corner[:, 0]
            v = np.einsum("fk,fk->f", np.cross(arm, second), across) / area
            w = np.einsum("fk,fk->f", np.cross(first, arm), across) / area
            height = np.einsum("fk,fk->f", arm, across) ** 2 / area
            best = np.where((v >= 0.0) & (w >= 0.0) & (v + w <= 1.0), height, np.inf)
            for k in range(3):
                way, reach = corner[:, (k + 1) % 3] - corner[:, k], point - corner[:, k]
                length = np.einsum("fk,fk->f", way, way)
                part = np.clip(np.nan_to_num(np.einsum("fk,fk->f", reach, way) / length), 0.0, 1.0)
                away = reach - part[:, None] * way
                best = np.fmin(best, np.einsum("fk,fk->f", away, away))
            least[row] = np.sqrt(best.min())
    return least.astype(float)


def distances(triangles: np.ndarray, points: np.ndarray, found: np.ndarray, close: float) -> np.ndarray:
    """By trimesh; anew in more digits where that is not what was found, since thin faces cost it some."""
    chunk, out = max(1, 400_000 // len(triangles)), np.empty(len(points))
    for begin in range(0, len(points), chunk):
        some = points[begin : begin + chunk]
        with np.errstate(divide="ignore", invalid="ignore"):
            each = trimesh.triangles.closest_point(
                np.tile(triangles, (len(some), 1, 1)), np.repeat(some, len(triangles), axis=0)
            ).reshape(len(some), -1, 3)
        out[begin : begin + chunk] = np.nanmin(np.linalg.norm(each - some[:, None], axis=2), axis=1)
    wrong = ~(np.abs(out - found) <= 0.5 * close)
    out[wrong] = exact_distances(triangles, points[wrong])
    return out


def winding(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often the surface goes around points (P, 3), by solid angles (Van Oosterom and Strackee 1983)."""
    chunk, out = max(1, 200_000 // len(triangles)), np.empty(len(points))
    for begin in range(0, len(points), chunk):
        arms = triangles[None] - points[begin : begin + chunk, None, None]
        a, b, c = arms[:, :, 0], arms[:, :, 1], arms[:, :, 2]
        one, two, three = np.linalg.norm(arms, axis=3).transpose(2, 0, 1)
        over = np.einsum("pfk,pfk->pf", a, np.cross(b, c))
        under = one * two * three + three * np.einsum("pfk,pfk->pf", a, b)
        under += one * np.einsum("pfk,pfk->pf", b, c) + two * np.einsum("pfk,pfk->pf", c, a)
        out[begin : begin + chunk] = np.arctan2(over, under).sum(axis=1) / (2.0 * np.pi)
    return out


def errors(name: str, count: int, seed: int) -> dict[str, float]:
    """The largest errors over the size of the mesh, and how many signs are wrong."""
    corners, faces, surface = mesh_of(name)
    points, on = queries(corners, faces, count, seed)
    size = max(np.ptp(corners, axis=0).max(), np.abs(corners).max())
    rows = [surface.nearest(point) for point in points]
    nearest, normals, found = (np.array([row[k] for row in rows]) for k in range(3))
    triangles = corners[faces]
    reach = np.maximum(size, np.linalg.norm(points - corners.mean(axis=0), axis=1))  # far points are rounded themselves
    true = distances(triangles, points, np.abs(found), CLOSE * size)
    around = winding(triangles, points)
    clear = np.abs(found) > 1e-10 * size
    clear &= np.abs(around - np.round(around)) < 0.1  # very near, solid angles are rounded, of faces without area most
    sharp = np.abs(found) > EDGE
    inside = around > 0.5
    lengths = np.linalg.norm(normals, axis=1)
    close = THIN if name in THIN_ONES else CLOSE
    clear &= np.abs(found) > close * size
    out = {
        "distance": (np.abs(np.abs(found) - true) / reach).max(),
        "on the surface": np.abs(found[:on]).max() / size,
        "point": exact_distances(triangles, nearest).max() / size,
        "length": np.abs(np.linalg.norm(nearest - points, axis=1) - np.abs(found)).max() / size,
        "unit": np.abs(lengths - 1.0).max(),
        "way": (np.linalg.norm(points + found[:, None] * normals - nearest, axis=1) / reach)[sharp].max(),
        "signs": float((clear & ((found < 0.0) != inside)).sum()),
        "signs asked": float(clear.mean()),
    }
    return {key: float(value) for key, value in out.items()}


def check(name: str, count: int, seed: int) -> dict[str, float]:
    found, close = errors(name, count, seed), THIN if name in THIN_ONES else CLOSE
    for kind in ("distance", "on the surface", "way"):
        assert found[kind] <= close, (kind, found)
    assert found["point"] <= CLOSE, found  # whatever is found lies on a face
    assert found["length"] <= 1e-12, found
    assert found["signs"] == 0.0, found
    assert found["signs asked"] > 0.3, found
    return found


@pytest.mark.parametrize("name", MESHES)
def test_nearest_points(name: str) -> None:
    check(name, 100, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_ten_thousand_nearest_points(name: str) -> None:
    found = check(name, 10_000, 1)
    print(f"{name}: " + ", ".join(f"{kind} {value:.1e}" for kind, value in found.items()))


def test_every_mesh_is_closed() -> None:
    """Else the solid angles say nothing; each side of a face has as many that run the opposite way."""
    for name in MESHES:
        corners, faces, _ = mesh_of(name)
        ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        number = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
        assert not np.bincount(number, np.sign(ends[:, 1] - ends[:, 0])).any(), name
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        outside = middle + 3.0 * np.ptp(corners, axis=0).max() * np.ones(3)
        assert winding(corners[faces], outside[None])[0] == pytest.approx(0.0, abs=1e-9), name


def test_normals_have_length_one_near_edges() -> None:
    corners, _, surface = mesh_of("ten metres")
    rng = np.random.default_rng(0)
    for point in corners + 3e-9 * rng.normal(size=corners.shape):
        assert np.linalg.norm(surface.nearest(point)[1]) == pytest.approx(1.0, abs=1e-12)


def test_pieces_and_faces_that_no_mesh_has_are_refused() -> None:
    corners, faces, _ = mesh_of("tetrahedron")
    for wrong in (faces + 1, faces - 1):
        with pytest.raises(ValueError, match="does not exist"):
            core.Surface.mesh(corners, wrong.astype(float), [corners])
    with pytest.raises(ValueError, match="faces and pieces"):
        core.Surface.mesh(corners, faces.astype(float), [])
    with pytest.raises(ValueError, match="has area"):
        core.Surface.mesh(0.0 * corners, faces.astype(float), [corners])
