"""Solids from mesh files in metres, with their centre of mass as origin and their principal axes as axes."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from grasp_env._check import Array, warn
from grasp_env._files import digest
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.mesh_files import KINDS, mesh_bytes, read_mesh_bytes
from grasp_env.sim.objects.cache import cached

_VERSION = "6"
"""Version of the processed arrays, part of the cache's key: increase it when they change."""
_ARRAYS = frozenset(("vertices", "faces", "pieces", "counts", "gyration", "rotation", "center", "volume", "changes"))
_SAME_MOMENT = 1e-6  # relative difference of moments, or product of inertia, below which axes are not distinguished


class Mesh(NamedTuple):
    """A closed mesh, body frame, not to be written to.

    Attributes:
        vertices: Corners [m], (V, 3).
        faces: Indices of their corners, counterclockwise from outside, (F, 3) int64.
        pieces: Corners (K, 3) [m] of convex pieces that together cover it.
        gyration: Squared radii of gyration of the uniform solid about the axes [m^2], (3,).
        rotation: Rotation from the axes of the file to those of the body, (3, 3).
        center: Centre of mass in the file's frame [m], (3,).
        volume: Volume [m^3].
        extent: Sides of its bounding box [m].
        changes: Descriptions of the repairs that closed it.
    """

    vertices: Array
    faces: Any
    pieces: tuple[Array, ...]
    gyration: Array
    rotation: Array
    center: Array
    volume: float
    extent: tuple[float, float, float]
    changes: tuple[str, ...]


def load_mesh(path: str, scale: float, tell: bool = True) -> Mesh:
    """Read and process a mesh. Results are kept in the user's cache folder, and the last few in memory until their files change.

    Args:
        path: Path of a file of one of the `KINDS`.
        scale: Factor from its coordinates to metres.
        tell: Warn of repairs.

    Raises:
        InvalidInputError: There is no such file, or it is not a mesh, has too many faces or cannot be closed.
    """
    if not isinstance(path, str | os.PathLike) or os.path.splitext(path)[1].lower() not in KINDS:
        raise InvalidInputError(f"mesh={shown(path)} must be a file of type {', '.join(KINDS)}; convert it")
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInputError(f"mesh={path!r} cannot be read: {reason}; give the path of a mesh file") from None
    mesh = _load(os.path.abspath(path), scale, status.st_mtime_ns, status.st_size, f"mesh={path!r}")
    if mesh.changes and tell:
        warn(
            f"mesh={path!r} was repaired: {'; '.join(mesh.changes)}. `grasp object show FILE --draw PICTURE` shows the result"
        )
    return mesh


@lru_cache(maxsize=16)
def _load(path: str, scale: float, _changed: int, _bytes: int, name: str) -> Mesh:
    """Read and process a mesh; `_changed` and `_bytes` make the in-memory cache notice a changed file."""
    kind = Path(path).suffix.lower()
    blob = mesh_bytes(path, name)
    key = digest(_VERSION.encode(), kind.encode(), blob)
    made = cached(key, os.path.basename(path), _ARRAYS, lambda: _processed(*read_mesh_bytes(blob, kind, name), name))
    ends = np.cumsum(made["counts"])[:-1]
    vertices, pieces = np.ascontiguousarray(scale * made["vertices"]), scale * made["pieces"]
    for array in (vertices, made["faces"], pieces):  # shared by all objects of this file
        array.setflags(write=False)
    x, y, z = np.ptp(vertices, axis=0).tolist()
    return Mesh(
        vertices, made["faces"], tuple(np.split(pieces, ends)), scale**2 * made["gyration"], made["rotation"],
        scale * made["center"], scale**3 * float(made["volume"]), (x, y, z), tuple(made["changes"].tolist()),
    )  # fmt: skip


def _processed(corners: Array, faces: Any, name: str) -> dict[str, Any]:
    """Close, measure and cut a mesh: everything that takes time, in the file's units."""
    from grasp_env.sim.objects.closing import close_mesh
    from grasp_env.sim.objects.pieces import convex_pieces

    corners, faces, changes = close_mesh(corners, faces, name)
    body = _centred(corners, faces)
    x, y, z = np.sort(body["gyration"]).tolist()
    if not (x > 0.0 and z < (x + y) * (1.0 + 1e-9)):
        raise InvalidInputError(
            f"{name} has impossible moments of inertia, as its faces cross; mend it with `grasp object mend FILE`, or remesh it"
        )
    pieces = convex_pieces(body["vertices"], faces, name)
    return {
        **body, "faces": faces, "pieces": np.concatenate(pieces), "counts": np.array([len(piece) for piece in pieces]),
        "changes": np.array(changes, dtype=np.str_),
    }  # fmt: skip


def _centred(corners: Array, faces: Any) -> dict[str, Any]:
    """Move the corners to the centre of mass and the principal axes, and measure the solid."""
    shift = corners.mean(axis=0)
    a, b, c = (corners[faces[:, k]] - shift for k in range(3))
    volumes = np.einsum("fk,fk->f", a, np.cross(b, c)) / 6.0  # of the tetrahedra between origin and faces
    volume = volumes.sum()
    center = ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * volume)
    total = a + b + c
    seconds = sum(np.einsum("f,fi,fj->ij", volumes, part, part) for part in (a, b, c, total)) / (20.0 * volume)
    seconds = seconds - np.outer(center, center)
    inertia = np.trace(seconds) * np.eye(3) - seconds
    rotation = principal_rotation(inertia)
    return {
        "vertices": (corners - shift - center) @ rotation.T,
        "gyration": np.diag(rotation @ inertia @ rotation.T).copy(),
        "rotation": rotation,
        "center": center + shift,
        "volume": volume,
    }


def principal_rotation(inertia: Array) -> Array:
    """Return the smallest rotation (3, 3) to principal axes of `inertia` (3, 3).

    If moments are equal, as those of a cube, the axes are not unique; the nearest to the present ones are taken.

    Example:
        >>> principal_rotation(np.diag([1.0, 1.0, 2.0]))
        array([[1., 0., 0.],
               [0., 1., 0.],
               [0., 0., 1.]])
    """
    size = np.trace(inertia)
    if np.abs(inertia - np.diag(np.diag(inertia))).max() <= _SAME_MOMENT * size:
        return np.eye(3)
    moments, axes = np.linalg.eigh(inertia)
    best, angle = np.eye(3), np.inf
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        turned = np.empty((3, 3))
        for signs in range(4):
            rows = axes[:, order].T * np.array([1 - 2 * (signs & 1), 1 - (signs & 2), 1.0])[:, None]
            rows[2] *= np.linalg.det(rows)
            turned[:] = rows
            turned = _aligned(turned, moments[list(order)], _SAME_MOMENT * size)
            found = float(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
            if found < angle - 1e-9:
                best, angle = turned.copy(), found
    return best


def _aligned(rows: Array, moments: Array, close: float) -> Array:
    """Turn axes with equal moments within their plane until they are nearest to x, y and z."""
    for i, j in ((0, 1), (0, 2), (1, 2)):
        if abs(moments[i] - moments[j]) <= close:
            # the turn of rows i and j that maximises the trace
            turn = np.arctan2(rows[j, i] - rows[i, j], rows[i, i] + rows[j, j])
            sine, cosine = np.sin(turn), np.cos(turn)
            rows = rows.copy()
            rows[i], rows[j] = cosine * rows[i] + sine * rows[j], cosine * rows[j] - sine * rows[i]
    return rows
