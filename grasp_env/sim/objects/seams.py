"""Repairs at the open edges of a mesh: sides are split, small holes filled, inner sheets dropped."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from grasp_env.inputs.arguments import Array, unit_vectors
from grasp_env.sim.mesh_shape import extent_of, grouped, numbered, sides_of

_HOLE = 0.1  # largest extent of a small hole, relative to the extent
_SHEETS = 0.25  # most of the area that sheets may have
# sides with one face, and corners near them; a soup of triangles has more
_MOST_SIDES, _MOST_NEAR = 20_000, 1_000_000
_LOOKS = 256  # rays from the middle of a sheet
_SAME = 1e-9  # rounding of a place on a face, and of the length of a ray, relative to the extent
_PASSES = 4  # in each a face is split at one of its three sides


def split_sides(corners: Array, faces: Any, grain: float) -> tuple[Any, int]:
    """Split faces where corners of other open edges lie on their open sides, within `grain`.

    Return the faces (F, 3), and how many were split.
    """
    from scipy.spatial import KDTree

    count = 0
    for _ in range(_PASSES):
        sides = sides_of(faces)
        number = numbered(sides)[1]
        lone = np.flatnonzero(np.bincount(number)[number] == 1)
        if not 0 < len(lone) <= _MOST_SIDES:
            break
        nodes = np.unique(sides[lone])
        a, b = corners[sides[lone, 0]], corners[sides[lone, 1]]
        lengths = np.linalg.norm(b - a, axis=1)
        tree = KDTree(corners[nodes])
        balls = 0.5 * (a + b), 0.5 * lengths
        if tree.query_ball_point(*balls, return_length=True).sum() > _MOST_NEAR:
            break
        near = tree.query_ball_point(*balls)
        pieces = list[tuple[int, int, int]]()
        split = set[int]()
        for side, start, end, length, found in zip(lone.tolist(), a, b, lengths, near, strict=True):
            face, first = divmod(side, 3)
            if face in split:
                continue
            away = corners[nodes[found]] - start
            along = away @ (end - start) / length
            off = np.linalg.norm(away - along[:, None] * (end - start) / length, axis=1)
            on = np.flatnonzero((off < grain) & (along > grain) & (along < length - grain))
            if len(on):
                middle = nodes[found][on[np.argsort(along[on])]].tolist()
                chain = [int(sides[side, 0]), *middle, int(sides[side, 1])]
                apex = int(faces[face, (first + 2) % 3])
                pieces += [(low, high, apex) for low, high in pairwise(chain)]
                split.add(face)
        if not split:
            break
        count += len(split)
        faces = np.concatenate([np.delete(faces, list(split), axis=0), np.array(pieces)])
    return faces, count


def loop_fillings(corners: Array, faces: Any, extent: float) -> Any:
    """Return faces (F, 3) that fill all loops of open edges; none if a loop is larger than `_HOLE`.

    The sides of faces without a partner that runs the opposite way form loops, also where more than
    two faces meet.
    """
    sides = sides_of(faces)
    pairs, number = numbered(sides)
    forward = sides[:, 0] < sides[:, 1]
    surplus = np.bincount(number, np.where(forward, 1.0, -1.0)).astype(int)
    after: dict[int, list[int]] = {}  # the corners to which a missing side runs from each corner
    for (low, high), count in zip(pairs[surplus != 0].tolist(), surplus[surplus != 0], strict=True):
        start, end = (high, low) if count > 0 else (low, high)
        after.setdefault(start, []).extend([end] * abs(int(count)))
    added: list[tuple[int, int, int]] = []
    for start in list(after):
        while after[start]:
            path = [start]
            while len(path) == 1 or path[-1] != start:
                path.append(after[path[-1]].pop())
                if path[-1] in path[:-1]:
                    first = path.index(path[-1])
                    loop = path[first:-1]
                    if np.ptp(corners[loop], axis=0).max() > _HOLE * extent:
                        return np.empty((0, 3), np.int64)
                    added += [(loop[0], *side) for side in pairwise(loop[1:])]
                    path = path[: first + 1]
                    if first == 0:
                        break
    return np.array(added, np.int64).reshape(-1, 3)


def without_sheets(corners: Array, faces: Any) -> Any:
    """Drop the smallest sheets that end where three or five faces meet; return the other faces.

    Such a sheet is a wall between joined solids if no way in a straight line leads outside from it.
    Together they have at most `_SHEETS` of the area.
    """
    number = numbered(sides_of(faces))[1]
    counts = np.bincount(number)
    odd = (counts % 2 == 1) & (counts > 1)
    shared = np.argsort(number, kind="stable")
    shared = shared[counts[number[shared]] == 2].reshape(-1, 2) // 3
    rows = np.arange(len(faces))
    patches = grouped(rows, np.concatenate([shared, np.column_stack([rows, rows])]), rows)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    left = _SHEETS * areas.sum()
    kept = np.ones(len(faces), dtype=bool)
    for patch in sorted(patches, key=lambda patch: areas[patch].sum()):
        edges, uses = np.unique(number.reshape(-1, 3)[patch], return_counts=True)
        border = edges[uses % 2 == 1]
        left -= areas[patch].sum()
        if left < 0.0:
            break
        middle = patch[areas[patch].argmax()]
        if len(border) and odd[border].all() and _is_enclosed(corners, faces[kept], faces[middle]):
            kept[patch] = False
            odd[border] = False
    return faces[kept]


def _is_enclosed(corners: Array, faces: Any, face: Any) -> bool:
    """Return True if every ray from the middle of a face meets another one.

    Moeller and Trumbore (1997) intersect a ray with triangles.
    """
    start = corners[face].mean(axis=0)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    across, along, away = b - a, c - a, start - a
    turned = np.cross(away, across)
    reached = np.einsum("fk,fk->f", along, turned)
    for ray in unit_vectors(np.random.default_rng(0).standard_normal((_LOOKS, 3))):
        normal = np.cross(ray, along)
        with np.errstate(divide="ignore", invalid="ignore"):  # faces along the ray
            scale = 1.0 / np.einsum("fk,fk->f", across, normal)
            u = scale * np.einsum("fk,fk->f", away, normal)
            v = scale * (turned @ ray)
            ahead = scale * reached > _SAME * extent_of(corners)
            if not (ahead & (u >= -_SAME) & (v >= -_SAME) & (u + v <= 1.0 + _SAME)).any():
                return False
    return True
