"""Solids from mesh files [m]; centre of mass and principal axes are their origin and axes."""

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
from grasp_env.sim.mesh_shape import connected_parts, volume
from grasp_env.sim.objects.cache import cached
from grasp_env.sim.objects.pieces import FAR, Excess, convex_pieces
from grasp_env.sim.objects.reading import open_mesh, read_mesh

_VERSION = "11"  # part of the cache's key: increase it when the processed arrays change
# excess distance [m] and volume of the pieces above which a warning gives both
_NEAR, _THIN = 0.003, 0.1
# relative difference of moments, or product of inertia, below which axes are not distinguished
_SAME_MOMENT = 1e-6


class Mesh(NamedTuple):
    """A closed mesh, body frame; its arrays are read-only."""

    vertices: Array  # corners [m], (V, 3)
    faces: Any  # indices of their corners, counterclockwise from outside, (F, 3) int64
    pieces: tuple[Array, ...]  # corners (K, 3) [m] of convex pieces that together cover it
    gyration: Array  # squared radii of gyration of the uniform solid about the axes [m^2], (3,)
    rotation: Array  # from the axes of the file to those of the body, (3, 3)
    center: Array  # of mass in the file's frame [m], (3,)
    volume: float  # [m^3]
    extent: tuple[float, float, float]  # sides of its bounding box [m]
    changes: tuple[str, ...]  # descriptions of the repairs that closed it
    parts: int  # number of solids that are not connected
    excess: Excess  # of the pieces; the distance in [m]

    @property
    def coarse(self) -> bool:
        """True if the pieces stand out too far for collisions."""
        return self.excess.distance > FAR * max(self.extent)


def load_mesh(path: str, scale: float, tell: bool = True) -> Mesh:
    """Read and process a mesh file; `scale` is the factor to metres.

    If `tell`, a warning lists repairs. Results are kept in the user's cache folder, and the last
    few in memory until their files change.
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
        warn(
            f"{name} was repaired: {'; '.join(mesh.changes)}. `grasp object show FILE --draw PICTURE` shows the result"
        )
    for remark in remarks(mesh) if tell else ():
        warn(f"{name}: {remark}")
    return mesh


def remarks(mesh: Mesh) -> list[str]:
    """Return sentences on what a user may not expect of a mesh, besides its repairs."""
    found = list[str]()
    if mesh.parts > 1:
        found.append(
            f"it has {mesh.parts} parts that are not connected: they are held and move as one rigid body; give other objects files of "
            "their own"
        )
    distance, more = mesh.excess
    if distance <= _NEAR and more <= _THIN:
        return found
    contacts = (
        "Bullet collides with the faces instead (mesh_contacts)"
        if mesh.coarse
        else "for exact contacts use Bullet with mesh_contacts='faces'"
    )
    found.append(
        f"its convex pieces stand out by up to {1e3 * distance:.1f} mm and have {more:.0%} more volume. Fingers keep away from them; {contacts}, "
        "and MuJoCo always collides with the pieces"
    )
    return found


@lru_cache(maxsize=16)
def _load(path: str, scale: float, _changed: int, _bytes: int, name: str) -> Mesh:
    """Read and process a mesh; `_changed` and `_bytes` make `lru_cache` notice a changed file."""
    file = open_mesh(path, name)
    key = digest(_VERSION.encode(), file.kind.encode(), file.content)
    arrays = cached(
        key,
        os.path.basename(path),
        lambda: _processed(*read_mesh(file), name),
        keep=lambda made: bool(made["in_time"]),
    )
    vertices = np.ascontiguousarray(scale * arrays["vertices"])
    pieces = scale * arrays["pieces"]
    for array in (vertices, arrays["faces"], pieces):  # shared by all objects of this file
        array.setflags(write=False)
    x, y, z = np.ptp(vertices, axis=0).tolist()
    return Mesh(
        vertices,
        arrays["faces"],
        tuple(np.split(pieces, np.cumsum(arrays["counts"])[:-1])),
        scale**2 * arrays["gyration"],
        arrays["rotation"],
        scale * arrays["center"],
        scale**3 * float(arrays["volume"]),
        (x, y, z),
        tuple(arrays["changes"].tolist()),
        int(arrays["parts"]),
        Excess(scale * float(arrays["excess"][0]), float(arrays["excess"][1])),
    )


def _processed(corners: Array, faces: Any, name: str) -> dict[str, Any]:
    """Close, measure and cut a mesh, in the file's units."""
    from grasp_env.sim.objects.closing import close_mesh

    corners, faces, changes = close_mesh(corners, faces, name)
    body = _centred(corners, faces)
    x, y, z = np.sort(body["gyration"]).tolist()
    if not (x > 0.0 and z < (x + y) * (1.0 + 1e-9)):
        raise InvalidInputError(
            f"{name} has impossible moments of inertia, as its faces cross; repair it with `grasp object mend FILE`, or remesh it"
        )
    pieces, excess, in_time = convex_pieces(body["vertices"], faces, name)
    return {
        **body,
        "faces": faces,
        "pieces": np.concatenate(pieces),
        "counts": np.array([len(piece) for piece in pieces]),
        "changes": np.array(changes, dtype=np.str_),
        "excess": np.array(excess),
        "in_time": np.array(in_time),
        "parts": np.array(_count_solids(body["vertices"], faces)),
    }


def _count_solids(corners: Array, faces: Any) -> int:
    """Return the number of connected parts, without cavities."""
    return sum(volume(corners, part) > 0.0 for part in connected_parts(faces))


def _centred(corners: Array, faces: Any) -> dict[str, Any]:
    """Move the corners to the centre of mass and the principal axes, and measure the solid."""
    shift = corners.mean(axis=0)
    a, b, c = (corners[faces[:, k]] - shift for k in range(3))
    # of the tetrahedra between origin and faces
    volumes = np.einsum("fk,fk->f", a, np.cross(b, c)) / 6.0
    volume = volumes.sum()
    total = a + b + c
    center = (total * volumes[:, None]).sum(axis=0) / (4.0 * volume)
    second = sum(np.einsum("f,fi,fj->ij", volumes, p, p) for p in (a, b, c, total))
    second = second / (20.0 * volume) - np.outer(center, center)
    inertia = np.trace(second) * np.eye(3) - second
    rotation = principal_rotation(inertia)
    return {
        "rotation": rotation,
        "center": center + shift,
        "volume": volume,
        "vertices": (corners - shift - center) @ rotation.T,
        "gyration": np.diag(rotation @ inertia @ rotation.T).copy(),
    }


def principal_rotation(inertia: Array) -> Array:
    """Return the smallest rotation (3, 3) to principal axes of `inertia` (3, 3).

    Axes of equal moments, such as those of a cube, are not unique; the nearest ones are taken.

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
    least = np.inf
    for order in permutations(range(3)):
        for x, y in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
            rows = axes[:, order].T * np.array([[x], [y], [1.0]])
            rows[2] *= np.linalg.det(rows)
            turned = _aligned(rows, moments[list(order)], _SAME_MOMENT * size)
            angle = float(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
            if angle < least - 1e-9:
                best, least = turned, angle
    return best


def _aligned(rows: Array, moments: Array, close: float) -> Array:
    """Turn axes with equal moments within their plane, as near to x, y and z as possible."""
    for i, j in ((0, 1), (0, 2), (1, 2)):
        if abs(moments[i] - moments[j]) <= close:
            # the turn of rows i and j that maximises the trace
            turn = np.arctan2(rows[j, i] - rows[i, j], rows[i, i] + rows[j, j])
            sine = np.sin(turn)
            cosine = np.cos(turn)
            rows[i], rows[j] = cosine * rows[i] + sine * rows[j], cosine * rows[j] - sine * rows[i]
    return rows
