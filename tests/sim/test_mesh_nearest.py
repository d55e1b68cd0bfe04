"""The nearest point of a mesh and its side, against all faces and solid angles."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh import creation

from grasp_env import core

CLOSE = 1e-12
"""Tolerance of distances relative to the mesh's size: corners are rounded by 2e-16 of it, and a
thin face magnifies that 1000 times."""
THIN = 3e-8
"""The same for faces thinner than 1e-4 of their length.

A face of height h is accurate to 2e-16 / h of the size, and the edges of its
neighbours are h away: the worse of the two is at most this."""
THIN_ONES = ("turned needles", "plate")
EDGE = 1e-9
"""Distance from an edge or a corner within which the normal is that of its faces instead of the
direction [m]."""
Solid = tuple[np.ndarray, np.ndarray]


def solid(mesh: Any) -> Solid:
    return np.array(mesh.vertices, dtype=float), np.array(mesh.faces)


def joined(*solids: Solid) -> Solid:
    return solid(
        trimesh.util.concatenate([trimesh.Trimesh(*each, process=False) for each in solids])
    )


def prism(outline: np.ndarray, height: float = 1.0) -> Solid:
    """A prism over an outline (N, 2) that is a fan around its first corner; unlike Manifold it
    keeps all corners."""
    count = len(outline)
    corners = np.vstack([np.column_stack([outline, np.full(count, z)]) for z in (0.0, height)])
    faces = [(0, k + 1, k) for k in range(1, count - 1)] + [
        (count, count + k, count + k + 1) for k in range(1, count - 1)
    ]
    for k in range(count):
        after = (k + 1) % count
        faces += [(k, after, count + after), (k, count + after, count + k)]
    return corners, np.array(faces)


def t_junction(splits: int, sharp: float) -> Solid:
    """A wedge whose upper edge has more corners on one side, with faces without area in between."""
    corners, faces = solid(creation.box((1.0, 1.0, 1.0)))
    corners[corners[:, 2] > 0.0, 1] *= sharp
    upper = np.flatnonzero((corners[:, 2] > 0.0) & (corners[:, 1] > 0.0))
    first = next(face for face in faces if np.isin(upper, face).all())
    k = next(k for k in range(3) if first[k] in upper and first[(k + 1) % 3] in upper)
    begin = first[k]
    end = first[(k + 1) % 3]
    tip = first[(k + 2) % 3]
    parts = np.linspace(0.0, 1.0, splits + 2)[1:-1, None]
    row = [begin, *range(len(corners), len(corners) + splits), end]
    corners = np.vstack([corners, (1.0 - parts) * corners[begin] + parts * corners[end]])
    rest = [tuple(face) for face in faces if tuple(face) != tuple(first)]
    fine = [(one, other, tip) for one, other in pairwise(row)]
    empty = [(begin, row[k + 1], row[k]) for k in range(1, splits + 1)]
    return corners, np.array([*rest, *fine, *empty])


def fan() -> Solid:
    """A pyramid with forty narrow faces on one side of its tip: only weights by angles give its
    normal."""
    angles = np.append(np.linspace(0.0, 0.5 * np.pi, 40), (np.pi, 1.5 * np.pi))
    count = len(angles)
    corners = np.vstack(
        [np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles]), [(0.0, 0.0, 0.3)]]
    )
    sides = [(k, (k + 1) % count, count) for k in range(count)]
    return corners, np.vstack([[(0, k + 1, k) for k in range(1, count - 1)], sides])


def needles() -> Solid:
    """A box whose sides are fans from one corner of the bottom to many points of an edge of the
    top, most near its end."""
    places = np.concatenate([[0.5], 0.5 - np.geomspace(1e-7, 0.9, 30)])
    return prism(np.array([(-0.5, -0.5), (0.5, -0.5), *((x, 0.5) for x in places), (-0.5, 0.5)]))


def turned(given: Solid) -> Solid:
    matrix = trimesh.transformations.random_rotation_matrix(np.random.default_rng(0).random(3))[
        :3, :3
    ]
    return given[0] @ matrix.T, given[1]


def ball(splits: int, radius: float) -> Solid:
    return solid(creation.icosphere(splits, radius))


MESHES: dict[str, Callable[[], Solid]] = {
    "box of many coplanar faces": lambda: solid(
        creation.box((1.0, 0.6, 0.8)).subdivide().subdivide()
    ),
    "rock": lambda: solid(
        trimesh.convex.convex_hull(np.random.default_rng(0).normal(size=(80, 3)))
    ),
    "L-shape": lambda: turned(
        prism(np.array([(0.6, 0.0), (0.0, 0.0), (0.0, -1.0), (1.0, -1.0), (1.0, 0.4), (0.6, 0.4)]))
    ),
    "fan": fan,
    "turned needles": lambda: turned(needles()),
    "long junction": lambda: turned(t_junction(20, 0.1)),
    "plate": lambda: turned(solid(creation.box((1.0, 0.7, 1e-5)))),
    "far away": lambda: solid(
        creation.torus(0.4, 0.15, major_sections=16, minor_sections=8).apply_translation(
            (300.0, -500.0, 200.0)
        )
    ),
    "hollow ball": lambda: joined(ball(2, 0.5), (ball(2, 0.4)[0], ball(2, 0.4)[1][:, ::-1])),
}


@cache
def mesh_of(name: str) -> tuple[np.ndarray, np.ndarray, core.Surface]:
    corners, faces = MESHES[name]()
    return corners, faces, core.Surface.mesh(corners, faces.astype(float), [corners])


def queries(
    corners: np.ndarray, faces: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, int]:
    """Points (about `count`) on faces, on edges, at corners, near these, around and far away; and
    how many are on the surface."""
    rng = np.random.default_rng(seed)
    each = max(count // 8, 1)
    size = np.ptp(corners, axis=0).max()
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    sums = np.cumsum(trimesh.triangles.area(corners[faces]))
    by_area = np.minimum(np.searchsorted(sums, rng.uniform(0.0, sums[-1], each)), len(faces) - 1)
    chosen = np.concatenate([by_area, rng.integers(len(faces), size=2 * each)])
    weights = rng.dirichlet((1.0, 1.0, 1.0), len(chosen))
    weights[2 * each :, 2] = 0.0  # on edges
    weights /= weights.sum(axis=1, keepdims=True)
    inner = np.einsum("pk,pkc->pc", weights, corners[faces[chosen]])
    on = np.vstack([inner, corners[rng.integers(len(corners), size=each)]])
    near = on + size * 10.0 ** rng.uniform(-9.0, -1.0, (len(on), 1)) * rng.normal(size=on.shape)
    near = near[rng.permutation(len(near))[: 2 * each]]
    around = middle + 1.2 * size * rng.uniform(-0.5, 0.5, (each, 3))
    far = middle + 30.0 * size * rng.normal(size=(each // 2 + 1, 3))
    return np.vstack([on, near, around, far]), len(on)


def exact_distances(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances of points (P, 3) to the nearest of triangles (F, 3, 3), in long double."""
    corner = triangles.astype(np.longdouble)
    points = points.astype(np.longdouble)
    first = corner[:, 1] - corner[:, 0]
    second = corner[:, 2] - corner[:, 0]
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
                way = corner[:, (k + 1) % 3] - corner[:, k]
                reach = point - corner[:, k]
                part = np.einsum("fk,fk->f", reach, way) / np.einsum("fk,fk->f", way, way)
                away = reach - np.clip(np.nan_to_num(part), 0.0, 1.0)[:, None] * way
                best = np.fmin(best, np.einsum("fk,fk->f", away, away))
            least[row] = np.sqrt(best.min())
    return least.astype(float)


def winding(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Winding numbers of points (P, 3) from solid angles (Van Oosterom and Strackee 1983)."""
    out = np.empty(len(points))
    for row, point in enumerate(points):
        arms = triangles - point
        a = arms[:, 0]
        b = arms[:, 1]
        c = arms[:, 2]
        one, two, three = np.linalg.norm(arms, axis=2).T
        over = np.einsum("fk,fk->f", a, np.cross(b, c))
        under = one * two * three + three * np.einsum("fk,fk->f", a, b)
        under += one * np.einsum("fk,fk->f", b, c) + two * np.einsum("fk,fk->f", c, a)
        out[row] = np.arctan2(over, under).sum() / (2.0 * np.pi)
    return out


def check(name: str, count: int, seed: int) -> None:
    corners, faces, surface = mesh_of(name)
    points, on = queries(corners, faces, count, seed)
    size = max(np.ptp(corners, axis=0).max(), np.abs(corners).max())
    close = THIN if name in THIN_ONES else CLOSE
    rows = [surface.nearest(point) for point in points]
    nearest, normals, found = (np.array([row[k] for row in rows]) for k in range(3))
    triangles = corners[faces]
    # far points are rounded themselves
    reach = np.maximum(size, np.linalg.norm(points - corners.mean(axis=0), axis=1))
    assert (np.abs(np.abs(found) - exact_distances(triangles, points)) / reach).max() <= close
    assert np.abs(found[:on]).max() <= close * size
    # the point lies on a face, whichever it is
    assert exact_distances(triangles, nearest).max() <= CLOSE * size
    assert np.abs(np.linalg.norm(nearest - points, axis=1) - np.abs(found)).max() <= 1e-12 * size
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    off = np.linalg.norm(points + found[:, None] * normals - nearest, axis=1) / reach
    assert off[np.abs(found) > EDGE].max() <= close
    around = winding(triangles, points)
    # near the surface solid angles are rounded
    clear = (np.abs(found) > max(1e-10, close) * size) & (np.abs(around - np.round(around)) < 0.1)
    assert clear.mean() > 0.3
    np.testing.assert_array_equal(found[clear] < 0.0, around[clear] > 0.5)


@pytest.mark.parametrize("name", MESHES)
def test_nearest_points(name):
    check(name, 100, 0)
