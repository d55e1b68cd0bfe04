"""Geometry of meshes as arrays: volume, welding, open edges, connected parts, hulls."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from grasp_env.inputs.arguments import Array

WELD = 1e-7
"""Distance within which corners are merged, relative to the extent; an .stl repeats all corners."""
UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0}
"""Units of mesh files, each with its length [m]."""
_DIRECTIONS = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))


def extent_of(corners: Array) -> float:
    """Return the longest side of the bounding box of corners (V, 3); 1 if all coincide."""
    return float(np.ptp(corners, axis=0).max()) or 1.0


def scale_advice(extent: float, most: float) -> str:
    """Return the factors that make an extent 5 mm to `most` [m], in words; "" if no unit fits."""
    options = [
        f"{length:g} if the file is in {unit} ({1e3 * length * extent:.3g} mm large)"
        for unit, length in UNITS.items()
        if 5e-3 <= length * extent <= most
    ]
    return ", ".join(options)


def volume(corners: Array, faces: Any) -> float:
    """Return the volume of a closed mesh, negative if its faces look inward."""
    # any corner of the mesh: near it, fewer digits cancel
    origin = corners[faces[:1, 0]].sum(axis=0)
    a, b, c = (corners[faces[:, k]] - origin for k in range(3))
    return float(np.einsum("fk,fk->", a, np.cross(b, c))) / 6.0


def weld(corners: Array, faces: Any, grain: float) -> tuple[Array, Any]:
    """Merge corners in the same cell of a grid; drop flat faces and unused corners."""
    kept, numbers = _distinct(np.round(corners / grain))
    faces = numbers[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return used_corners(corners[kept], faces)


def used_corners(corners: Array, faces: Any) -> tuple[Array, Any]:
    """Drop the corners that no face has, and number the others anew."""
    used, faces = np.unique(faces, return_inverse=True)
    return corners[used], faces.reshape(-1, 3).astype(np.int64)


def _distinct(cells: Array) -> tuple[Any, Any]:
    """Return the first indices and inverse of the unique rows of `cells` (V, 3), V < 2^21.

    This is five times as fast as `np.unique`.
    """
    key = np.zeros(len(cells), np.int64)
    for column in cells.T:
        values, number = np.unique(column, return_inverse=True)
        key = key * len(values) + number
    _, kept, numbers = np.unique(key, return_index=True, return_inverse=True)
    return kept, numbers


def distinct_faces(faces: Any) -> Any:
    """Keep one of the faces (F, 3) on the same corners."""
    first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    return faces[np.sort(first)]


def open_edges(faces: Any) -> int:
    """Count the sides of faces without a partner that runs the opposite way."""
    ends = sides_of(faces)
    forward = ends[:, 0] < ends[:, 1]
    return int(np.abs(np.bincount(numbered(ends)[1], np.where(forward, 1.0, -1.0))).sum())


def sides_of(faces: Any) -> Any:
    """Return the corners (3 F, 2) of the sides of faces (F, 3)."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def numbered(ends: Any) -> tuple[Any, Any]:
    """Return the unordered pairs among `ends` (S, 2), and the index of each row's pair."""
    ends = np.asarray(ends, np.int64)
    low = ends.min(axis=1)
    high = ends.max(axis=1)
    count = int(ends.max(initial=0)) + 1
    keys, number = np.unique(low * count + high, return_inverse=True)
    return np.column_stack(np.divmod(keys, count)), number


def connected_parts(faces: Any) -> list[Any]:
    """Return the faces of each part of a mesh; parts share no corner."""
    return grouped(faces, faces[:, [0, 1, 1, 2]].reshape(-1, 2), faces[:, 0]) if len(faces) else []


def grouped(faces: Any, links: Any, of_face: Any) -> list[Any]:
    """Return the faces of each connected part of a graph.

    `links` (E, 2) are its edges, and `of_face` (F,) is the node of each face.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = int(max(links.max(initial=0), of_face.max(initial=0))) + 1
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][of_face]
    order = np.argsort(labels, kind="stable")
    return np.split(faces[order], np.flatnonzero(np.diff(labels[order])) + 1)


def farthest(points: Array) -> Any:
    """Return the indices of points (K, 3) that are farthest along axes and diagonals, and of one."""
    return np.unique((points @ _DIRECTIONS.T).argmax(axis=0))


def reduce_hull(corners: Array, most: int, fine: float) -> Array:
    """Choose at most `most` corners (K, 3) of a hull, the most important first.

    It ends when all corners are within `fine` times the hull's size of the chosen ones' hull.
    """
    from scipy.spatial import ConvexHull

    if len(corners) <= most:
        return corners
    chosen = farthest(corners)
    while len(chosen) < most:
        planes = ConvexHull(corners[chosen]).equations
        heights = corners @ planes[:, :3].T + planes[:, 3]
        outside = heights.max(axis=1)
        outside[chosen] = 0.0
        face = heights.argmax(axis=1)
        order = np.argsort(-outside, kind="stable")
        order = order[outside[order] > fine * np.ptp(corners, axis=0).max()]
        if len(order) == 0:
            break
        worst = order[np.unique(face[order], return_index=True)[1]]  # the farthest beyond each face
        worst = worst[np.argsort(-outside[worst], kind="stable")][: most - len(chosen)]
        chosen = np.append(chosen, worst)
    return corners[chosen]


def hull_faces(points: Array) -> tuple[Array, Any]:
    """Return the points (K, 3) and the faces (F, 3) of their hull, counterclockwise from outside."""
    from scipy.spatial import ConvexHull  # slow to import, and only hulls need it

    hull = ConvexHull(points)
    faces = hull.simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("fk,fk->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    return points, np.where(inward[:, None], faces[:, ::-1], faces)
