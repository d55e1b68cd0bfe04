"""Repair of a mesh to a closed solid with faces counterclockwise from outside."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.mesh_shape import (
    WELD,
    distinct_faces,
    extent_of,
    grouped,
    numbered,
    open_edges,
    sides_of,
    volume,
    weld,
)
from grasp_env.sim.objects.seams import loop_fillings, split_sides, without_sheets

_SEAM = 1e-5  # distance within which corners of open seams are merged, relative to the extent
_MIN_VOLUME = 1e-6  # least volume of a solid, relative to the cube of its extent
_BOTH = 0.5  # share of the faces that walls leave below which a mesh has two-sided faces
_WALLS = "duplicate faces and faces back to back were dropped"
_FLAT_VOLUME = 1e-12  # volume below which a part is only faces back to back, relative to that cube
_SAME_ANGLE = 1e-6  # angle below which faces lie back to back [rad]
_MAX_PARTS = 500  # they take a second
_SAMPLED = 8  # corners of a part that are tested for being inside another part


def close_mesh(corners: Array, faces: Any, name: str) -> tuple[Array, Any, list[str]]:
    """Return the corners (V, 3) and faces (F, 3) of a closed solid, and a list of the repairs.

    Coincident corners and faces are merged. Then, until the mesh is closed, trimesh orients faces
    alike, seams are welded, sides are split at corners of others, and trimesh fills holes; small
    ones that it leaves are filled by fans, and walls between joined solids are dropped. Manifold
    unites overlapping parts; a part inside out within another is a cavity.
    """
    extent = extent_of(corners)
    corners, faces = weld(corners, faces, WELD * extent)
    changes: list[str] = []
    single = _without_walls(faces)
    if len(single) < len(faces):
        distinct = distinct_faces(faces)
        two_sided = len(single) < _BOTH * len(distinct)
        faces = distinct if two_sided else single
        changes.append("of faces that look both ways one was kept" if two_sided else _WALLS)
    if open_edges(faces):
        corners, faces = _repaired(corners, faces, extent, changes)
    if count := open_edges(faces):
        raise InvalidInputError(
            f"{name} is not closed: {count} edges have a face on one side only, after holes were filled; repair it with `grasp object mend FILE` and look at the result, or export it as a solid"
        )
    return (*_solid(corners, faces, extent, name, changes), changes)


def _repaired(corners: Array, faces: Any, extent: float, changes: list[str]) -> tuple[Array, Any]:
    """Apply repairs in turn until the mesh is closed or none is left."""
    import trimesh

    def turn(mesh: Any) -> str:
        before = mesh.faces.copy()
        trimesh.repair.fix_winding(mesh)
        count = int((mesh.faces != before).any(axis=1).sum())
        return f"{count} faces were turned" if count else ""

    def weld_seams(mesh: Any) -> str:
        points, triangles = weld(np.asarray(mesh.vertices), np.asarray(mesh.faces), _SEAM * extent)
        count = len(mesh.vertices) - len(points)
        if not count:
            return ""
        mesh.vertices, mesh.faces = points, triangles
        return f"{count} corners were joined with others within {_SEAM:g} of its size"

    def split(mesh: Any) -> str:
        faces, count = split_sides(
            np.asarray(mesh.vertices), np.asarray(mesh.faces), _SEAM * extent
        )
        if count:
            mesh.faces = faces
        return (
            f"{count} faces were split where corners of others lie on their sides" if count else ""
        )

    def fill(mesh: Any) -> str:
        before = len(mesh.faces)
        trimesh.repair.fill_holes(mesh, use_fan=True)
        count = len(mesh.faces) - before
        return f"holes were filled with {count} faces" if count > 0 else ""

    def fill_loops(mesh: Any) -> str:
        added = loop_fillings(np.asarray(mesh.vertices), np.asarray(mesh.faces), extent)
        if len(added):
            mesh.faces = np.concatenate([mesh.faces, added])
        return f"small holes were filled with {len(added)} faces" if len(added) else ""

    def drop_sheets(mesh: Any) -> str:
        faces = without_sheets(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        count = len(mesh.faces) - len(faces)
        if count:
            mesh.faces = faces
        return f"{count} faces of inner walls were dropped" if count else ""

    mesh = trimesh.Trimesh(corners, faces, process=False)
    for repair in (turn, weld_seams, split, fill, turn, split, fill_loops, drop_sheets, turn):
        if change := repair(mesh):
            changes.append(change)
        if not open_edges(np.asarray(mesh.faces)):
            break
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def _without_walls(faces: Any) -> Any:
    """Keep one of the faces on the same corners; none if they cancel, as walls between parts do."""
    first = faces.argmin(axis=1)[:, None]
    # start at the smallest index
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    sign = np.where(turned[:, 1] < turned[:, 2], 1.0, -1.0)
    distinct, number = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    if len(distinct) == len(faces):
        return faces
    number = number.reshape(-1)
    surplus = np.bincount(number, sign)
    kept = np.full(len(distinct), -1)
    agrees = np.flatnonzero(sign * surplus[number] > 0.0)
    kept[number[agrees]] = agrees
    return faces[np.sort(kept[kept >= 0])]


def _solid(
    corners: Array, faces: Any, extent: float, name: str, changes: list[str]
) -> tuple[Array, Any]:
    """Make one solid: turn parts outward, subtract cavities, and unite overlapping parts."""
    parts = _parts(corners, faces)
    if len(parts) > _MAX_PARTS:
        raise InvalidInputError(
            f"{name} has {len(parts)} parts that are not connected, allowed are up to {_MAX_PARTS}; delete the fragments, or remesh it"
        )
    volumes = [volume(corners, part) for part in parts]
    if sum(map(abs, volumes)) <= _MIN_VOLUME * extent**3:
        raise InvalidInputError(
            f"{name} encloses no volume; it must be a solid, such as a plate with two sides"
        )
    solid = [k for k, size in enumerate(volumes) if abs(size) > _FLAT_VOLUME * extent**3]
    if len(solid) < len(parts) and _WALLS not in changes:
        changes.append(_WALLS)
    parts = [parts[k] for k in solid]
    volumes = [volumes[k] for k in solid]
    outer = _outer_parts(corners, parts, volumes)
    # the outermost part is solid: if it is inside out, so is everything within it
    outermost = [min([k, *around], key=lambda n: len(outer[n])) for k, around in enumerate(outer)]
    flips = [volumes[k] < 0.0 for k in outermost]
    if any(flips):
        changes.append("faces that pointed inward were turned")
    parts = [part[:, ::-1] if flip else part for part, flip in zip(parts, flips, strict=True)]
    if len(parts) == 1:
        return corners, parts[0]
    return _united(corners, parts, [len(around) for around in outer], changes)


def _outer_parts(corners: Array, parts: list[Any], volumes: list[float]) -> list[list[int]]:
    """Return for each part the indices of those that contain it, judged by a few of its corners."""
    from grasp_env import core

    outer: list[list[int]] = [[] for _ in parts]
    if len(parts) == 1:
        return outer
    points = [corners[np.unique(part)] for part in parts]
    low = np.array([cloud.min(axis=0) for cloud in points])
    high = np.array([cloud.max(axis=0) for cloud in points])
    for k, (part, size) in enumerate(zip(parts, volumes, strict=True)):
        inner = np.flatnonzero((low > low[k]).all(axis=1) & (high < high[k]).all(axis=1)).tolist()
        if inner:
            outward = part if size > 0.0 else part[:, ::-1]
            solid = core.Surface.mesh(corners, outward.astype(float), [points[k]])
            for n in inner:
                samples = points[n][:: max(1, len(points[n]) // _SAMPLED)]
                if all(solid.nearest(point)[2] < 0.0 for point in samples):
                    outer[n].append(k)
    return outer


def _parts(corners: Array, faces: Any) -> list[Any]:
    """Return the faces of each part connected by edges; those of parts that are not closed as one."""
    ends = np.sort(sides_of(faces), axis=1)
    number = numbered(ends)[1]
    sides = np.bincount(number)
    order = np.argsort(number, kind="stable")
    first = np.cumsum(sides) - sides
    plain = first[sides == 2]
    pairs = [np.column_stack([order[plain], order[plain + 1]]) // 3]
    for edge in np.flatnonzero(sides > 2):
        around = order[first[edge] : first[edge] + sides[edge]]
        pairs.append(_pairs_around(corners, faces, around, *ends[around[0]]))
    parts = grouped(faces, np.concatenate(pairs), np.arange(len(faces)))
    whole = [part for part in parts if not open_edges(part)]
    rest = [part for part in parts if open_edges(part)]
    return [*whole, np.concatenate(rest)] if rest else whole


def _pairs_around(corners: Array, faces: Any, around: Any, a: int, b: int) -> Any:
    """Return the pairs (P, 2) of faces around the edge from a to b with the solid between them."""
    edge = corners[b] - corners[a]
    frame = np.linalg.svd(edge[None])[2]
    if frame[0] @ edge < 0.0:
        frame = -frame
    rows, first = np.divmod(around, 3)
    across = (corners[faces[rows, (first + 2) % 3]] - corners[a]) @ frame[1:].T
    turn = 1.0 if np.linalg.det(frame) > 0.0 else -1.0
    angles = (np.arctan2(turn * across[:, 1], across[:, 0]) / _SAME_ANGLE).round()
    # True if the face's solid lies at smaller angles, else at larger ones
    ahead = faces[rows, first] == a
    order = np.lexsort([ahead, angles]).tolist()
    waiting = list[int]()
    pairs = list[tuple[int, int]]()
    done = set[int]()
    for k in [*order, *order]:
        if k in done or (ahead[k] and not waiting):
            continue
        done.add(k)
        if ahead[k]:
            pairs.append((int(rows[waiting.pop()]), int(rows[k])))
        else:
            waiting.append(k)
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _united(
    corners: Array, parts: list[Any], depths: list[int], changes: list[str]
) -> tuple[Array, Any]:
    """Add solid parts and subtract cavities, from outside inward.

    The parts stay as they are if they do not overlap, or if Manifold rejects one.
    """
    import manifold3d

    faces = np.concatenate(parts)
    union = manifold3d.Manifold()
    for depth in sorted(set(depths)):
        for hollow, task in ((False, manifold3d.OpType.Add), (True, manifold3d.OpType.Subtract)):
            solids = [union]
            for part, part_depth in zip(parts, depths, strict=True):
                if part_depth == depth and (volume(corners, part) < 0.0) == hollow:
                    points, numbers = weld(corners, part[:, ::-1] if hollow else part, 1e-300)
                    solids.append(
                        manifold3d.Manifold(manifold3d.Mesh64(points, numbers.astype(np.uint64)))
                    )
            if any(solid.status() != manifold3d.Error.NoError for solid in solids):
                return corners, faces
            if len(solids) > 1:
                union = manifold3d.Manifold.batch_boolean(solids, task)
    total = volume(corners, faces)
    if abs(union.volume() - total) <= 1e-9 * abs(total):
        return corners, faces
    mesh = union.to_mesh64()
    changes.append(f"its {len(parts)} parts overlap and were united")
    points = np.asarray(mesh.vert_properties, dtype=float)[:, :3]
    return points, np.asarray(mesh.tri_verts, dtype=np.int64)
