"""Repair of torn meshes by MeshFix (Attene 2010), for `grasp object mend`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.extras import need
from grasp_env.sim.mesh_files import obj_text
from grasp_env.sim.mesh_shape import (
    connected_parts,
    distinct_faces,
    extent_of,
    open_edges,
    used_corners,
    volume,
    weld,
)
from grasp_env.sim.objects.apart import apart
from grasp_env.sim.objects.closing import close_mesh
from grasp_env.sim.objects.reading import MeshFile, read_mesh

LONGEST = 180.0
"""Longest run of MeshFix [s].

80,000 faces with a twentieth of them missing take 8 s; on some inputs it never ends.
"""
_GRAIN = 1e-5  # share of the extent within which corners are welded
_FEWEST = 3  # a solid has more faces
_REMAINS = 0.5  # least share of the volume after MeshFix has removed crossing faces
_REMESH = (
    "remesh it in Blender (modifier Remesh, mode Voxel) or in MeshLab (filter Surface Reconstruction: Screened Poisson), and export it "
    "as .obj"
)


class RepairedMesh(NamedTuple):
    """Closed mesh, in the units and axes of its file.

    Attributes:
        corners: (V, 3).
        faces: (F, 3) int64 indices of corners, counterclockwise from outside.
        parts: number of parts.
        left_out: number of parts that enclose no volume and are left out.
        changes: further changes that make it one solid, in words.
    """

    corners: Array
    faces: Any
    parts: int
    left_out: int
    changes: list[str]


def repair_mesh(corners: Array, faces: Any, name: str) -> RepairedMesh:
    """Close every part of a mesh and return them as one solid that an object can have.

    MeshFix runs in a process of its own, since it may never end.

    Args:
        corners: (V, 3).
        faces: (F, 3).
        name: name of the mesh, for messages.

    Raises:
        InvalidInputError: the mesh cannot be closed; the message says what to do.
    """
    need("mend")
    work = f"{__name__}:closed_parts"
    try:
        parts = apart(work, f"{name}: repairing it", LONGEST, corners=corners, faces=faces)
    except TimeoutError:
        raise InvalidInputError(
            f"{name} cannot be repaired: MeshFix did not end within {LONGEST:.0f} s; simplify it, or {_REMESH}"
        ) from None
    except ChildProcessError as error:
        raise InvalidInputError(
            f"{name} cannot be repaired: MeshFix broke off; {_REMESH}"
        ) from error
    count = int(parts["parts"])
    if count == 0:
        raise InvalidInputError(
            f"{name} cannot be repaired: no part of it encloses a volume; {_REMESH}"
        )
    try:
        corners, faces, changes = close_mesh(parts["corners"], parts["faces"], name)
    except InvalidInputError:
        raise InvalidInputError(
            f"{name} cannot be repaired: the result of MeshFix is no solid; {_REMESH}"
        ) from None
    return RepairedMesh(corners, faces, count, int(parts["left_out"]), changes)


def as_obj(mesh: RepairedMesh, name: str) -> bytes:
    """Return the text of an .obj file with all digits, checked to read back as a solid.

    Raises:
        InvalidInputError: the text is too large to be read, or is not a solid when read back.
    """
    text = obj_text([(mesh.corners, mesh.faces)]).encode()
    name = f"the result of MeshFix for {name}"
    close_mesh(*read_mesh(MeshFile(text, ".obj", name)), name)
    return text


def closed_parts(corners: Array, faces: Any) -> dict[str, Any]:
    """Close all parts; return corners, faces, and counts of parts and of those left out.

    Parts that are closed already stay as they are. If all are, MeshFix checks each for faces that
    cross.
    """
    corners, faces = weld(corners, faces, _GRAIN * extent_of(corners))
    parts = [used_corners(corners, part) for part in connected_parts(distinct_faces(faces))]
    closed = [not open_edges(indices) for _, indices in parts]
    all_corners = [np.empty((0, 3))]
    all_faces = [np.empty((0, 3), np.int64)]
    for part, is_closed in zip(parts, closed, strict=True):
        points, indices = part if is_closed and not all(closed) else _closed_part(*part)
        if len(indices) > _FEWEST and not open_edges(indices):
            all_faces.append(indices + sum(map(len, all_corners)))
            all_corners.append(points)
    count = len(all_faces) - 1
    return {
        "corners": np.concatenate(all_corners),
        "faces": np.concatenate(all_faces),
        "parts": count,
        "left_out": len(parts) - count,
    }


def _closed_part(corners: Array, faces: Any) -> tuple[Array, Any]:
    """Fill holes and remove crossing faces, as far as MeshFix can; faces keep their orientation.

    MeshFix cuts a part where holes meet in a corner; the pieces are joined again.
    """
    from pymeshfix import PyTMesh

    if len(faces) < _FEWEST:
        return corners, faces
    fix = PyTMesh()
    fix.set_quiet(1)
    fix.load_array(
        np.ascontiguousarray(corners, dtype=float), np.ascontiguousarray(faces, dtype=np.int32)
    )
    fix.join_closest_components()
    fix.fill_small_boundaries(0, True)
    filled = _arrays(fix)
    fix.clean(10, 3)
    cleaned = _arrays(fix)
    # it may leave only a fragment
    if open_edges(cleaned[1]) or _size(cleaned) < _REMAINS * _size(filled):
        cleaned = filled
    if len(cleaned[1]) and volume(corners, faces) * volume(*cleaned) < 0.0:
        return cleaned[0], cleaned[1][:, ::-1]
    return cleaned


def _arrays(fix: Any) -> tuple[Array, Any]:
    points, faces = (np.asarray(array) for array in fix.return_arrays())
    return points, faces.astype(np.int64).reshape(-1, 3)


def _size(part: tuple[Array, Any]) -> float:
    return abs(volume(*part)) if len(part[1]) else 0.0
