"""From the faces of a file to a closed solid, seen from outside counterclockwise; what is changed on the way is told."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError
from grasp_env.sim.objects.pieces import volume

_GRAINS = 1e-7, 1e-5
"""Of the extent: corners this near are one, as in every .stl; and where seams are open."""
_LEAST = 1e-6  # of the cube about it that a solid fills


def closed(corners: Array, faces: Any, name: str) -> tuple[Array, Any, list[str]]:
    """A closed solid of corners (V, 3) and faces (F, 3), and what was changed, in words; nothing of that where it was closed.

    Corners at one place become one. Then, until it is closed: double faces go, faces are turned alike, seams are welded, holes are
    filled, all by trimesh. Parts that overlap become one solid, by Manifold; a part inside out within another is a hollow.

    Raises:
        InvalidInputError: It cannot be closed, or encloses no volume.
    """
    extent = float(np.ptp(corners, axis=0).max()) or 1.0
    corners, faces = welded(corners, faces, _GRAINS[0] * extent)
    changes: list[str] = []
    if open_edges(faces):
        corners, faces = _repaired(corners, faces, extent, changes)
    if left := open_edges(faces):
        raise InvalidInputError(
            f"{name} is not closed: {left} sides of its {len(faces)} faces have no face on the other side, and filling holes did not "
            "help; mend it with `grasp object mend FILE` and look at the result, or export it as a solid"
        )
    return (*_solid(corners, faces, extent, name, changes), changes)


def welded(corners: Array, faces: Any, grain: float) -> tuple[Array, Any]:
    """One corner where several are within a cell of a grid; faces that become lines, and corners of no face, go."""
    _, kept, numbers = np.unique(np.round(corners / grain), axis=0, return_index=True, return_inverse=True)
    faces = numbers.reshape(-1)[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    used, faces = np.unique(faces, return_inverse=True)
    return corners[kept][used], faces.reshape(-1, 3).astype(np.int64)


def open_edges(faces: Any) -> int:
    """How many sides of faces have no other that runs the opposite way."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = ends[:, 0] < ends[:, 1]
    number = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    return int(np.abs(np.bincount(number, np.where(forward, 1.0, -1.0))).sum())


def _repaired(corners: Array, faces: Any, extent: float, changes: list[str]) -> tuple[Array, Any]:
    """After the first of trimesh's repairs that close it, or all of them."""
    import trimesh

    def drop(mesh: Any) -> str:
        before = len(mesh.faces)
        mesh.update_faces(mesh.unique_faces())
        gone = before - len(mesh.faces)
        return f"{gone} double faces were dropped" if gone else ""

    def turn(mesh: Any) -> str:
        before = mesh.faces.copy()
        trimesh.repair.fix_winding(mesh)
        turned = int((mesh.faces != before).any(axis=1).sum())
        return f"{turned} faces were turned" if turned else ""

    def weld(mesh: Any) -> str:
        points, again = welded(np.asarray(mesh.vertices), np.asarray(mesh.faces), _GRAINS[1] * extent)
        gone = len(mesh.vertices) - len(points)
        if gone:
            mesh.vertices, mesh.faces = points, again
        return f"{gone} corners were joined with others within {_GRAINS[1]:g} of its size" if gone else ""

    def fill(mesh: Any) -> str:
        before = len(mesh.faces)
        trimesh.repair.fill_holes(mesh, use_fan=True)
        return f"holes were filled with {len(mesh.faces) - before} faces" if len(mesh.faces) > before else ""

    mesh = trimesh.Trimesh(corners, faces, process=False)
    for repair in (drop, turn, weld, fill, turn):
        if told := repair(mesh):
            changes.append(told)
        if not open_edges(np.asarray(mesh.faces)):
            break
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def _solid(corners: Array, faces: Any, extent: float, name: str, changes: list[str]) -> tuple[Array, Any]:
    """Parts turned outward, and made one where they overlap."""
    parts = _parts(faces)
    volumes = [volume(corners, part) for part in parts]
    if sum(abs(each) for each in volumes) <= _LEAST * extent**3:
        raise InvalidInputError(f"{name} encloses no volume; it must be a solid, such as a plate with two sides")
    boxes = [(corners[np.unique(part)].min(axis=0), corners[np.unique(part)].max(axis=0)) for part in parts]
    within = [
        any((low > a).all() and (high < b).all() for a, b in boxes) and len(parts) > 1 for low, high in boxes
    ]  # such a part may be a hollow
    turned = [size < 0.0 and not inner for size, inner in zip(volumes, within, strict=True)]
    if any(turned):
        changes.append("faces that looked inward were turned")
    parts = [part[:, ::-1] if flip else part for part, flip in zip(parts, turned, strict=True)]
    return (corners, np.concatenate(parts)) if len(parts) == 1 else _joined(corners, parts, changes)


def _parts(faces: Any) -> list[Any]:
    """The faces of each connected part."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = int(faces.max()) + 1
    labels = connected_components(coo_array((np.ones(len(edges)), edges.T), shape=(count, count)), directed=False)[1]
    order = np.argsort(labels[faces[:, 0]], kind="stable")
    return np.split(faces[order], np.flatnonzero(np.diff(labels[faces[order, 0]])) + 1)


def _joined(corners: Array, parts: list[Any], changes: list[str]) -> tuple[Array, Any]:
    """The union of the parts less the hollows; as they are where Manifold does not take them."""
    import manifold3d

    whole = np.concatenate(parts)
    solids: list[list[Any]] = [[], []]
    for part in parts:
        hollow = volume(corners, part) < 0.0
        points, numbers = welded(corners, part[:, ::-1] if hollow else part, 1e-300)
        mesh = manifold3d.Mesh64(vert_properties=points, tri_verts=numbers.astype(np.uint64))
        solids[hollow].append(manifold3d.Manifold(mesh))
    if any(solid.status() != manifold3d.Error.NoError for solid in (*solids[0], *solids[1])):
        return corners, whole
    one = manifold3d.Manifold.batch_boolean([manifold3d.Manifold.batch_boolean(solids[0], manifold3d.OpType.Add), *solids[1]],
                                            manifold3d.OpType.Subtract)  # fmt: skip
    apart = volume(corners, whole)
    if abs(one.volume() - apart) <= 1e-9 * abs(apart):
        return corners, whole  # they do not overlap
    made = one.to_mesh64()
    changes.append(f"its {len(parts)} parts overlap and were made one")
    return np.asarray(made.vert_properties, dtype=float)[:, :3], np.asarray(made.tri_verts, dtype=np.int64)
