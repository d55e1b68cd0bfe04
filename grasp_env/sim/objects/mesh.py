"""Convex meshes from files, in metres, about their centre of mass and along their principal axes."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.mesh_files import KINDS, read_mesh

FILE_TYPES = tuple(KINDS)
MOST_FACES = 400
"""Of a mesh: the nearest point is sought on all of them, for every fingertip at every control step."""

_MOST_BYTES = 5_000_000
_CONVEX = 1e-5  # of the extent, by which a corner may stand out of the plane of a face
_ROUND = 1e-6  # relative difference of moments, or product of inertia, that tells no axis from another


class Mesh(NamedTuple):
    """A closed convex mesh, body frame; to be read only.

    Attributes:
        vertices: [m], (V, 3).
        faces: Numbers of their corners, counterclockwise from outside, (F, 3) int64.
        triangles: Their corners [m], (F, 3, 3).
        normals: Their outward unit normals, (F, 3).
        gyration: Squared radii of gyration of the uniform solid about the axes [m^2], (3,).
        rotation: From the axes of the file to those of the body, (3, 3).
        center: Centre of mass in the file's frame [m], (3,).
    """

    vertices: Array
    faces: Any
    triangles: Array
    normals: Array
    gyration: Array
    rotation: Array
    center: Array


def load_mesh(path: str, scale: float) -> Mesh:
    """Read a mesh; the last few are remembered until their files change.

    Args:
        path: Of a file of one of `FILE_TYPES`.
        scale: What its coordinates are multiplied by to give metres.

    Raises:
        InvalidInputError: No such file, not a mesh, not closed, not convex, or too many faces.
    """
    if not isinstance(path, str | os.PathLike) or os.path.splitext(path)[1].lower() not in FILE_TYPES:
        raise InvalidInputError(f"mesh={shown(path)} must be a file of type {', '.join(FILE_TYPES)}; convert it")
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInputError(f"mesh={path!r} cannot be read: {reason}; give the path of a mesh file") from None
    if not os.path.isfile(path) or status.st_size > _MOST_BYTES:
        raise InvalidInputError(
            f"mesh={path!r} must be a file of at most {_MOST_BYTES // 1_000_000} MB, which {MOST_FACES} faces never "
            "need; simplify it, for example to its convex hull"
        )
    return _load(os.path.abspath(path), scale, status.st_mtime_ns, status.st_size, path)


@lru_cache(maxsize=16)
def _load(path: str, scale: float, _changed: int, _bytes: int, name: str) -> Mesh:
    """`_changed` and `_bytes` tell one state of the file from another."""
    corners, faces, _ = read_mesh(path, f"mesh={name!r}")
    if len(faces) > MOST_FACES:
        raise InvalidInputError(
            f"mesh={name!r} has {len(faces)} faces, allowed are up to {MOST_FACES}; simplify it, for example with "
            "trimesh's simplify_quadric_decimation or in a mesh editor"
        )
    corners = corners * scale
    extent = float(np.ptp(corners, axis=0).max())
    corners, faces = _weld(corners, faces, extent)
    _check_closed(faces, name)
    faces = _outward(corners, faces, extent, name)
    corners, faces = _check_convex(corners, faces, extent, name)
    return _centred(corners, faces)


def _weld(corners: Array, faces: Any, extent: float) -> tuple[Array, Any]:
    """One corner where several are at the same place, as in every .stl; faces without area go."""
    grain = 1e-7 * extent if extent > 0.0 else 1.0
    _, kept, numbers = np.unique(np.round(corners / grain), axis=0, return_index=True, return_inverse=True)
    faces = numbers.reshape(-1)[faces]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return corners[kept], faces[distinct]


def _check_closed(faces: Any, name: str) -> None:
    """Every edge belongs to two faces."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    uses = np.unique(edges, axis=0, return_counts=True)[1]
    if len(faces) < 4 or (uses != 2).any():
        raise InvalidInputError(
            f"mesh={name!r} is not closed: {int((uses != 2).sum())} of its {len(uses)} edges do not belong to exactly "
            "two faces; fill its holes, remove inner faces, or take its convex hull"
        )


def _outward(corners: Array, faces: Any, extent: float, name: str) -> Any:
    """Faces turned so that their corners are counterclockwise from outside."""
    inside = corners[np.unique(faces)].mean(axis=0)
    a, b, c = (corners[faces[:, k]] - inside for k in range(3))
    volumes = np.einsum("fk,fk->f", a, np.cross(b, c))
    # a flat mesh, or one that is folded so that a face points through the middle
    if np.abs(volumes).sum() <= 1e-6 * extent**3:
        raise InvalidInputError(f"mesh={name!r} encloses no volume; it must be a solid")
    return np.where((volumes < 0.0)[:, None], faces[:, ::-1], faces)


def _check_convex(corners: Array, faces: Any, extent: float, name: str) -> tuple[Array, Any]:
    """No corner stands out of the plane of a face, and the faces cover the convex hull once."""
    from scipy.spatial import ConvexHull

    used, faces = np.unique(faces, return_inverse=True)
    corners, faces = corners[used], faces.reshape(-1, 3).astype(np.int64)
    crossed = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
    doubled = np.linalg.norm(crossed, axis=1)
    broad = doubled > 1e-9 * extent**2  # the normal of a sliver is rounding
    normals = crossed[broad] / doubled[broad, None]
    heights = normals @ corners.T - np.einsum("fk,fk->f", normals, corners[faces[broad, 0]])[:, None]
    worst = float(heights.max())
    volume = (
        float(np.einsum("fk,fk->f", corners[faces[:, 0]], np.cross(corners[faces[:, 1]], corners[faces[:, 2]])).sum())
        / 6
    )
    hull = ConvexHull(corners)
    missing = hull.volume - volume
    if worst > _CONVEX * extent or abs(missing) > 1e-4 * hull.volume:
        raise InvalidInputError(
            f"mesh={name!r} is not convex: a corner stands {worst / extent:.2g} of its size out of a face's "
            f"plane, and it fills {100.0 * volume / hull.volume:.1f} % of its convex hull; split it, or take the hull"
        )
    return corners, faces[broad]


def _centred(corners: Array, faces: Any) -> Mesh:
    """The mesh about its centre of mass, turned to its principal axes."""
    a, b, c = (corners[faces[:, k]] for k in range(3))
    shift = corners.mean(axis=0)
    a, b, c = a - shift, b - shift, c - shift
    volumes = np.einsum("fk,fk->f", a, np.cross(b, c)) / 6.0  # of the tetrahedra over the faces
    volume = volumes.sum()
    center = ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * volume)
    total = a + b + c
    seconds = sum(np.einsum("f,fi,fj->ij", volumes, part, part) for part in (a, b, c, total)) / (20.0 * volume)
    seconds = seconds - np.outer(center, center)
    inertia = np.trace(seconds) * np.eye(3) - seconds
    rotation = principal_rotation(inertia)
    vertices = np.ascontiguousarray((corners - shift - center) @ rotation.T)
    triangles = np.ascontiguousarray(vertices[faces])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    gyration = np.diag(rotation @ inertia @ rotation.T).copy()
    return Mesh(vertices, faces, triangles, normals, gyration, rotation, center + shift)


def principal_rotation(inertia: Array) -> Array:
    """The rotation (3, 3) by the smallest angle after which the axes are principal axes of `inertia` (3, 3).

    Where moments are equal, as of a cube, any axes do: those nearest to the present ones are taken.

    Example:
        >>> principal_rotation(np.diag([1.0, 1.0, 2.0]))
        array([[1., 0., 0.],
               [0., 1., 0.],
               [0., 0., 1.]])
    """
    size = np.trace(inertia)
    if np.abs(inertia - np.diag(np.diag(inertia))).max() <= _ROUND * size:
        return np.eye(3)
    moments, axes = np.linalg.eigh(inertia)
    best, angle = np.eye(3), np.inf
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        turned = np.empty((3, 3))
        for signs in range(4):
            rows = axes[:, order].T * np.array([1 - 2 * (signs & 1), 1 - (signs & 2), 1.0])[:, None]
            rows[2] *= np.linalg.det(rows)
            turned[:] = rows
            turned = _aligned(turned, moments[list(order)], _ROUND * size)
            found = float(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
            if found < angle - 1e-9:
                best, angle = turned.copy(), found
    return best


def _aligned(rows: Array, moments: Array, close: float) -> Array:
    """Axes whose moments are equal, turned within their plane to lie nearest to x, y and z."""
    for i, j in ((0, 1), (0, 2), (1, 2)):
        if abs(moments[i] - moments[j]) <= close:
            # the turn of rows i and j that maximises the trace
            turn = np.arctan2(rows[j, i] - rows[i, j], rows[i, i] + rows[j, j])
            sine, cosine = np.sin(turn), np.cos(turn)
            rows = rows.copy()
            rows[i], rows[j] = cosine * rows[i] + sine * rows[j], cosine * rows[j] - sine * rows[i]
    return rows
