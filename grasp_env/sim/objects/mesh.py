"""Solids from mesh files in metres, with their centre of mass as origin and their principal axes as
axes.
"""

from __future__ import annotations

import os
from functools import lru_cache
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import Array, warn
from grasp_env.inputs.files import digest
from grasp_env.sim.mesh_files import KINDS
from grasp_env.sim.objects.cache import cached
from grasp_env.sim.objects.reading import open_mesh, read_mesh

_VERSION = (
    "6"  # version of the processed arrays, part of the cache's key: increase it when they change
)
# relative difference of moments, or product of inertia, below which axes are not distinguished
_SAME_MOMENT = 1e-6


class Mesh(NamedTuple):
    """A closed mesh, body frame, not to be written to."""

    vertices: Array  # corners [m], (V, 3)
    faces: Any  # indices of their corners, counterclockwise from outside, (F, 3) int64
    pieces: tuple[Array, ...]  # corners (K, 3) [m] of convex pieces that together cover it
    gyration: Array  # squared radii of gyration of the uniform solid about the axes [m^2], (3,)
    rotation: Array  # from the axes of the file to those of the body, (3, 3)
    center: Array  # of mass in the file's frame [m], (3,)
    volume: float  # [m^3]
    extent: tuple[float, float, float]  # sides of its bounding box [m]
    changes: tuple[str, ...]  # descriptions of the repairs that closed it


def load_mesh(path: str, scale: float, tell: bool = True) -> Mesh:
    """Read and process a mesh file; `scale` is the factor to metres.

    Unless `tell` is False, a warning tells of repairs.

    Results are kept in the user's cache folder, and the last few in memory until their files
    change.
    """
    if not isinstance(path, str | os.PathLike) or os.path.splitext(path)[1].lower() not in KINDS:
        raise InvalidInputError(
            f"mesh={shown(path)} must be a file of type {', '.join(KINDS)}; convert it"
        )
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInputError(
            f"mesh={path!r} cannot be read: {reason}; give the path of a mesh file"
        ) from None
    name = f"mesh={path!r}"
    mesh = _load(os.path.abspath(path), scale, status.st_mtime_ns, status.st_size, name)
    if mesh.changes and tell:
        changes = "; ".join(mesh.changes)
        warn(
            f"{name} was repaired: {changes}. `grasp object show FILE --draw PICTURE` shows the result"
        )
    return mesh


@lru_cache(maxsize=16)
def _load(path: str, scale: float, _changed: int, _bytes: int, name: str) -> Mesh:
    """Read and process a mesh; `_changed` and `_bytes` make the in-memory cache notice a changed
    file.
    """
    file = open_mesh(path, name)
    key = digest(_VERSION.encode(), file.kind.encode(), file.content)
    made = cached(key, os.path.basename(path), lambda: _processed(*read_mesh(file), name))
    ends = np.cumsum(made["counts"])[:-1]
    vertices = np.ascontiguousarray(scale * made["vertices"])
    pieces = scale * made["pieces"]
    for array in (vertices, made["faces"], pieces):  # shared by all objects of this file
        array.setflags(write=False)
    x, y, z = np.ptp(vertices, axis=0).tolist()
    return Mesh(
        vertices,
        made["faces"],
        tuple(np.split(pieces, ends)),
        scale**2 * made["gyration"],
        made["rotation"],
        scale * made["center"],
        scale**3 * float(made["volume"]),
        (x, y, z),
        tuple(made["changes"].tolist()),
    )


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
        **body,
        "faces": faces,
        "pieces": np.concatenate(pieces),
        "counts": np.array([len(piece) for piece in pieces]),
        "changes": np.array(changes, dtype=np.str_),
    }


def _centred(corners: Array, faces: Any) -> dict[str, Any]:
    """Move the corners to the centre of mass and the principal axes, and measure the solid."""
    shift = corners.mean(axis=0)
    a, b, c = (corners[faces[:, k]] - shift for k in range(3))
    # of the tetrahedra between origin and faces
    volumes = np.einsum("fk,fk->f", a, np.cross(b, c)) / 6.0
    volume = volumes.sum()
    center = ((a + b + c) * volumes[:, None]).sum(axis=0) / (4.0 * volume)
    total = a + b + c
    seconds = sum(np.einsum("f,fi,fj->ij", volumes, part, part) for part in (a, b, c, total)) / (
        20.0 * volume
    )
    seconds = seconds - np.outer(center, center)
    inertia = np.trace(seconds) * np.eye(3) - seconds
    rotation = principal_rotation(inertia)
    body = {"rotation": rotation, "center": center + shift, "volume": volume}
    gyration = np.diag(rotation @ inertia @ rotation.T).copy()
    return {**body, "vertices": (corners - shift - center) @ rotation.T, "gyration": gyration}


def principal_rotation(inertia: Array) -> Array:
    """Return the smallest rotation (3, 3) to principal axes of `inertia` (3, 3).

    If moments are equal, as those of a cube, the axes are not unique; the nearest to the present
    ones are taken.

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
    best = np.eye(3)
    angle = np.inf
    for order in permutations(range(3)):
        for x, y in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
            rows = axes[:, order].T * np.array([[x], [y], [1.0]])
            rows[2] *= np.linalg.det(rows)
            turned = _aligned(rows, moments[list(order)], _SAME_MOMENT * size)
            found = float(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
            if found < angle - 1e-9:
                best, angle = turned, found
    return best


def _aligned(rows: Array, moments: Array, close: float) -> Array:
    """Turn axes with equal moments within their plane until they are nearest to x, y and z."""
    for i, j in ((0, 1), (0, 2), (1, 2)):
        if abs(moments[i] - moments[j]) <= close:
            # the turn of rows i and j that maximises the trace
            turn = np.arctan2(rows[j, i] - rows[i, j], rows[i, i] + rows[j, j])
            sine = np.sin(turn)
            cosine = np.cos(turn)
            rows[i], rows[j] = cosine * rows[i] + sine * rows[j], cosine * rows[j] - sine * rows[i]
    return rows
