"""From the faces of a file to a closed solid, seen from outside counterclockwise; what is changed on the way is told."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError
from grasp_env.sim.mesh_shape import WELD, extent_of, open_edges, volume, welded

_SEAM = 1e-5  # of the extent: corners this near are one where seams are open
_LEAST = 1e-6  # of the cube about it that a solid fills
_WALLS = "faces that lay back to back or twice were dropped"
_FLAT = 1e-12  # the same of a part that is nothing but walls back to back
_ALIKE = 1e-6  # [rad] between faces that lie back to back
_MOST_PARTS = 500  # which take a second
_TRIED = 8  # corners of a part, to see whether it lies in another


def closed(corners: Array, faces: Any, name: str) -> tuple[Array, Any, list[str]]:
    """A closed solid of corners (V, 3) and faces (F, 3), and what was changed, in words; nothing of that where it was closed.

    Corners at one place become one, and faces on the same corners. Then, until it is closed, faces are turned alike, seams are welded
    and holes are filled, by trimesh. Parts that overlap become one solid, by Manifold; a part inside out within another is a hollow.

    Raises:
        InvalidInputError: It cannot be closed, or encloses no volume.
    """
    extent = extent_of(corners)
    corners, faces = welded(corners, faces, WELD * extent)
    changes: list[str] = []
    count = len(faces)
    faces = _without_walls(faces)
    if len(faces) < count:
        changes.append(_WALLS)
    if open_edges(faces):
        corners, faces = _repaired(corners, faces, extent, changes)
    if left := open_edges(faces):
        raise InvalidInputError(
            f"{name} is not closed: {left} edges have a face on one side alone, after filling what holes there were; mend it with `grasp object mend FILE` and look at the result, or export it as a solid"
        )
    return (*_solid(corners, faces, extent, name, changes), changes)


def _repaired(corners: Array, faces: Any, extent: float, changes: list[str]) -> tuple[Array, Any]:
    """After the first of trimesh's repairs that close it, or all of them."""
    import trimesh

    def turn(mesh: Any) -> str:
        before = mesh.faces.copy()
        trimesh.repair.fix_winding(mesh)
        turned = int((mesh.faces != before).any(axis=1).sum())
        return f"{turned} faces were turned" if turned else ""

    def weld(mesh: Any) -> str:
        points, again = welded(np.asarray(mesh.vertices), np.asarray(mesh.faces), _SEAM * extent)
        gone = len(mesh.vertices) - len(points)
        if gone:
            mesh.vertices, mesh.faces = points, again
        return f"{gone} corners were joined with others within {_SEAM:g} of its size" if gone else ""

    def fill(mesh: Any) -> str:
        before = len(mesh.faces)
        trimesh.repair.fill_holes(mesh, use_fan=True)
        return f"holes were filled with {len(mesh.faces) - before} faces" if len(mesh.faces) > before else ""

    mesh = trimesh.Trimesh(corners, faces, process=False)
    for repair in (turn, weld, fill, turn):
        if told := repair(mesh):
            changes.append(told)
        if not open_edges(np.asarray(mesh.faces)):
            break
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def _without_walls(faces: Any) -> Any:
    """Faces on the same corners once; none of them where as many look one way as the other: a wall between parts that touch."""
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)  # the least corner first
    ahead = turned[:, 1] < turned[:, 2]
    _, kept, number = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    number = number.reshape(-1)
    surplus = np.bincount(number, np.where(ahead, 1.0, -1.0))
    if len(kept) == len(faces):
        return faces
    right = np.full(len(kept), -1)
    agrees = np.flatnonzero(np.where(ahead, 1.0, -1.0) * surplus[number] > 0.0)
    right[number[agrees]] = agrees
    return faces[np.sort(right[right >= 0])]


def _solid(corners: Array, faces: Any, extent: float, name: str, changes: list[str]) -> tuple[Array, Any]:
    """One solid: parts turned outward, hollows taken away, the rest united where it overlaps."""
    parts = _parts(corners, faces)
    if len(parts) > _MOST_PARTS:
        raise InvalidInputError(
            f"{name} has {len(parts)} parts that are not connected, allowed are up to {_MOST_PARTS}; delete the crumbs, or remesh it"
        )
    volumes = [volume(corners, part) for part in parts]
    if sum(abs(each) for each in volumes) <= _LEAST * extent**3:
        raise InvalidInputError(f"{name} encloses no volume; it must be a solid, such as a plate with two sides")
    solid = [k for k, size in enumerate(volumes) if abs(size) > _FLAT * extent**3]
    if len(solid) < len(parts) and _WALLS not in changes:
        changes.append(_WALLS)
    parts, volumes = [parts[k] for k in solid], [volumes[k] for k in solid]
    within = _nested(corners, parts, volumes)
    # what lies outermost is solid: where it is inside out, so is all that it holds
    flips = [
        volumes[min([number, *around], key=lambda k: len(within[k]))] < 0.0 for number, around in enumerate(within)
    ]
    if any(flips):
        changes.append("faces that looked inward were turned")
    parts = [part[:, ::-1] if flip else part for part, flip in zip(parts, flips, strict=True)]
    if len(parts) == 1:
        return corners, parts[0]
    return _united(corners, parts, [len(around) for around in within], changes)


def _nested(corners: Array, parts: list[Any], volumes: list[float]) -> list[list[int]]:
    """Of each part the numbers of those that hold some of its corners, all that are tried."""
    from grasp_env import core

    out: list[list[int]] = [[] for _ in parts]
    if len(parts) == 1:
        return out
    used = [np.unique(part) for part in parts]
    boxes = [(corners[each].min(axis=0), corners[each].max(axis=0)) for each in used]
    for outer, (part, size) in enumerate(zip(parts, volumes, strict=True)):
        inner = [
            k for k, (low, high) in enumerate(boxes) if (low > boxes[outer][0]).all() and (high < boxes[outer][1]).all()
        ]
        if inner:
            outward = part if size > 0.0 else part[:, ::-1]
            solid = core.Surface.mesh(corners, outward.astype(float), [corners[used[outer]]])
            for k in inner:
                tried = corners[used[k][:: max(1, len(used[k]) // _TRIED)]]
                if all(solid.nearest(point)[2] < 0.0 for point in tried):
                    out[k].append(outer)
    return out


def _parts(corners: Array, faces: Any) -> list[Any]:
    """The faces of each part, connected by edges; parts that are not closed by themselves are one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    number = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1)
    sides, order = np.bincount(number), np.argsort(number, kind="stable")
    first = np.cumsum(sides) - sides
    plain = first[sides == 2]
    pairs = [np.column_stack([order[plain], order[plain + 1]]) // 3]
    for edge in np.flatnonzero(sides > 2):
        around = order[first[edge] : first[edge] + sides[edge]]
        pairs.append(_around(corners, faces, around, *ends[around[0]]))
    one, other = np.concatenate(pairs).T
    labels = connected_components(coo_array((np.ones(len(one)), (one, other)), shape=(count, count)), directed=False)[1]
    sorts = np.argsort(labels, kind="stable")
    parts = np.split(faces[sorts], np.flatnonzero(np.diff(labels[sorts])) + 1)
    whole = [part for part in parts if not open_edges(part)]
    rest = [part for part in parts if open_edges(part)]
    return [*whole, np.concatenate(rest)] if rest else whole


def _around(corners: Array, faces: Any, around: Any, a: int, b: int) -> Any:
    """Pairs (P, 2) of faces between which the solid lies, of those around an edge from corner a to b; walls back to back are one."""
    away = corners[b] - corners[a]
    frame = np.linalg.svd(away[None])[2]
    if frame[0] @ away < 0.0:
        frame = -frame
    third = np.array([faces[side // 3, (side % 3 + 2) % 3] for side in around])
    across = (corners[third] - corners[a]) @ frame[1:].T
    turn = 1.0 if np.linalg.det(frame) > 0.0 else -1.0
    angles = (np.arctan2(turn * across[:, 1], across[:, 0]) / _ALIKE).round()
    ahead = np.array(
        [faces[side // 3, side % 3] == a for side in around]
    )  # its solid lies at smaller angles, else at larger ones
    order = np.lexsort([ahead, angles])
    waiting: list[int] = []
    pairs: list[tuple[int, int]] = []
    done: set[int] = set()
    for k in [*order.tolist(), *order.tolist()]:
        if k in done:
            continue
        if ahead[k] and waiting:
            pairs.append((int(around[waiting.pop()]) // 3, int(around[k]) // 3))
            done.add(k)
        elif not ahead[k] and k not in waiting:
            waiting.append(k)
            done.add(k)
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _united(corners: Array, parts: list[Any], depths: list[int], changes: list[str]) -> tuple[Array, Any]:
    """From outside inward what is solid is added and what is hollow taken away; as they are where Manifold does not take them."""
    import manifold3d

    whole = np.concatenate(parts)
    one = manifold3d.Manifold()
    for depth in sorted(set(depths)):
        for hollow, task in ((False, manifold3d.OpType.Add), (True, manifold3d.OpType.Subtract)):
            solids = [one]
            for part in (part for part, at in zip(parts, depths, strict=True) if at == depth):
                if (volume(corners, part) < 0.0) == hollow:
                    points, numbers = welded(corners, part[:, ::-1] if hollow else part, 1e-300)
                    solids.append(manifold3d.Manifold(manifold3d.Mesh64(points, numbers.astype(np.uint64))))
            if any(solid.status() != manifold3d.Error.NoError for solid in solids):
                return corners, whole
            if len(solids) > 1:
                one = manifold3d.Manifold.batch_boolean(solids, task)
    apart = volume(corners, whole)
    if abs(one.volume() - apart) <= 1e-9 * abs(apart):
        return corners, whole  # they do not overlap
    made = one.to_mesh64()
    changes.append(f"its {len(parts)} parts overlap and were made one")
    return np.asarray(made.vert_properties, dtype=float)[:, :3], np.asarray(made.tri_verts, dtype=np.int64)
