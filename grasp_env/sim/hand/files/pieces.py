"""Decompose a hand's meshes into convex collision pieces, cached by content in the user's cache."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import AllFaults, Array
from grasp_env.inputs.files import digest
from grasp_env.sim import mesh_shape
from grasp_env.sim.hand.files.meshes import MADE, Job, made_of_files
from grasp_env.sim.hand.solids import few_corners, hull_of, hull_shape, principal_axes
from grasp_env.sim.hand.tree import Geometry, Vector3
from grasp_env.sim.objects.cache import cached

_FULL = 0.9  # share of its hull's volume from which on a mesh counts as convex
_MAX_PIECES = 8
# share of the whole hull's volume that a cut must remove, or that joining two pieces may add
_WORTH = 0.03
_CUTS = (0.2, 0.35, 0.5, 0.65, 0.8)  # positions of cuts within a piece's extent
_DEEPEST = 4  # cuts one after another
_FINE = 5000  # number of faces above which a mesh is simplified before it is cut
_GRAINS = 150.0  # number of grid cells along the extent of a simplified mesh
_SMALLEST, _LARGEST = 1e-5, 5.0  # [m] extent of a mesh
_CRUMBS = 40  # number of parts above which a mesh is cut as a whole
_VISUAL_CORNERS = 256  # of the hull of a visual mesh in which a tip is fitted
_VISUAL_ERROR = 2e-4  # relative error of that hull


@dataclass(frozen=True)
class MeshUse:
    """A mesh of a <collision> or <visual> that has not been read: its name in the hand's file, its
    path and its pose.
    """

    name: str
    path: Path
    scale: Vector3
    origin: Vector3
    rotation: Vector3
    color: Vector3 | None


def solids_of(
    shapes: Mapping[str, Sequence[Geometry | MeshUse]], file: str
) -> dict[str, list[Geometry]]:
    """Return the collision shapes by link, with meshes replaced by convex pieces; `file` is named
    on the progress line.
    """
    first = dict[tuple[Path, Vector3], tuple[str, str]]()
    for link, parts in shapes.items():
        for part in parts:
            if isinstance(part, MeshUse):
                first.setdefault((part.path, part.scale), (link, part.name))
    jobs = [
        Job(path, np.array(scale).tobytes(), partial(_pieces_of, scale)) for path, scale in first
    ]
    pieces = dict[tuple[Path, Vector3], list[Array]]()
    with AllFaults() as check:
        for use, made in zip(
            first, made_of_files(jobs, f"{file}: convex pieces of meshes"), strict=True
        ):
            if isinstance(made, InvalidInputError):
                link, name = first[use]
                check.add(f"link {link!r}, <collision>, {shown(name)}: {made}")
            else:
                pieces[use] = _split(made)

    def solids(part: Geometry | MeshUse) -> list[Geometry]:
        if isinstance(part, Geometry):
            return [part]
        return [
            hull_shape(piece, part.origin, part.rotation) for piece in pieces[part.path, part.scale]
        ]

    return {
        link: [solid for part in parts for solid in solids(part)] for link, parts in shapes.items()
    }


def _pieces_of(scale: Vector3, corners: Array, faces: Any) -> dict[str, Any]:
    """Return the `convex_pieces` of a mesh, packed; `scale` are factors to metres."""
    return _packed(convex_pieces(corners * scale, faces))


def hulls_of_files(files: Iterable[str]) -> dict[str, Array]:
    """Return at most `_VISUAL_CORNERS` corners (K, 3) of the hull of each mesh file, in its units,
    or raise an InvalidInputError.
    """
    names = list(dict.fromkeys(files))
    hulls = dict[str, Array]()
    with AllFaults() as check:
        jobs = [Job(Path(name), b"hull", _hull_of) for name in names]
        for name, made in zip(names, made_of_files(jobs, "hulls of meshes"), strict=True):
            if isinstance(made, InvalidInputError):
                check.add(made)
            else:
                hulls[name] = made["corners"]
    return hulls


def _hull_of(corners: Array, _: Any) -> dict[str, Any]:
    hull = hull_of(corners)
    return {
        "corners": mesh_shape.reduce_hull(
            hull.points[hull.vertices], _VISUAL_CORNERS, _VISUAL_ERROR
        )
    }


def kept_pieces(corners: Array, faces: Any, name: str) -> list[Array]:
    """Return the `convex_pieces` of corners (V, 3) [m] and faces (F, 3), from the cache if
    possible, which lists them under `name`.
    """
    corners = np.ascontiguousarray(corners, dtype=float)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    key = digest(MADE.encode(), b"arrays", corners.tobytes(), faces.tobytes())

    def make() -> dict[str, Any]:
        return _packed(
            convex_pieces(
                *mesh_shape.weld(corners, faces, mesh_shape.WELD * mesh_shape.extent_of(corners))
            )
        )

    return _split(cached(key, name, make, use="hand"))


def _packed(pieces: list[Array]) -> dict[str, Any]:
    return {"pieces": np.concatenate(pieces), "counts": np.array([len(piece) for piece in pieces])}


def _split(made: dict[str, Any]) -> list[Array]:
    return np.split(made["pieces"], np.cumsum(made["counts"])[:-1])


def convex_pieces(corners: Array, faces: Any) -> list[Array]:
    """Return convex pieces that together contain a mesh, each as at most `solids.MAX_CORNERS`
    corners (K, 3).

    A mesh that fills nine tenths of its hull, or is too fine to be cut, is one piece. Otherwise its
    parts are cut by planes that reduce the volume of the hulls. Pieces whose common hull adds
    little are joined, until at most `_MAX_PIECES` are left. A size that is implausible for a part
    of a hand is refused.
    """
    extent = float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0
    if not _SMALLEST <= extent <= _LARGEST:
        raise InvalidInputError(
            f"the mesh is {extent:.3g} m large, allowed are {_SMALLEST:g} to {_LARGEST:g}; of one in millimetres give "
            'scale="0.001 0.001 0.001"'
        )
    hull = hull_of(corners)
    parts = _parts(faces)
    if abs(mesh_shape.volume(corners, faces)) >= _FULL * hull.volume and len(parts) == 1:
        return [few_corners(corners)]
    if len(faces) > _FINE:
        corners, faces = mesh_shape.weld(corners, faces, extent / _GRAINS)
        corners = (extent / _GRAINS) * np.round(corners * (_GRAINS / extent))
        faces = np.unique(faces, axis=0)
        if len(faces) > 2 * _FINE:  # a soup of triangles: cutting would take minutes
            return [few_corners(corners)]
        parts = _parts(faces)
    leaves: list[Array] = []
    worth = _WORTH * hull.volume
    for part in parts:
        around = hull_of(corners[np.unique(part)])
        filled = abs(mesh_shape.volume(corners, part))
        # no cut can remove more
        if around.volume - filled <= worth and not mesh_shape.open_edges(part):
            leaves.append(around.points)
        else:
            leaves += _cut(
                corners, part, worth, 2 if filled < 0.85 * around.volume else 0, _DEEPEST
            )
    return [few_corners(points) for points in _joined(leaves, worth)]


def _cut(corners: Array, faces: Any, worth: float, blind: int, deepest: int) -> list[Array]:
    """Return points of the pieces of a surface; `blind` cuts need not reduce the volume, such as
    the first cut of a ring.
    """
    from trimesh.intersections import slice_faces_plane

    points = corners[np.unique(faces)]
    whole = hull_of(points)
    if deepest == 0 or whole.volume <= worth:
        return [points]
    edges = mesh_shape.numbered(mesh_shape.sides_of(faces))[0]
    axes = principal_axes(points)
    heights = points @ axes.T
    low = heights.min(axis=0)
    extent = np.ptp(heights, axis=0)
    tried = [
        (axis, start + part * size)
        for axis, start, size in zip(axes, low, extent, strict=True)
        for part in _CUTS
    ]
    few = [
        sum(_hull_volume(half[mesh_shape.farthest(half)]) for half in _halves(corners, edges, *cut))
        for cut in tried
    ]
    best, gain = None, worth
    for k in np.argsort(few, kind="stable"):
        # later cuts gain less, as the hull of all points is larger than that of few
        if whole.volume - few[k] <= gain:
            break
        less = sum(_hull_volume(half) for half in _halves(corners, edges, *tried[k]))
        if whole.volume - less > gain:
            best = tried[k]
            gain = whole.volume - less
    if best is None:
        if blind == 0:
            return [points]
        blind -= 1
        longest = int(extent.argmax())
        best = axes[longest], low[longest] + 0.5 * extent[longest]
    axis, at = best
    leaves: list[Array] = []
    for sign in (1.0, -1.0):
        half: Any = slice_faces_plane(corners, faces, sign * axis, at * axis)
        if len(half[1]):
            leaves += _cut(np.asarray(half[0]), np.asarray(half[1]), worth, blind, deepest - 1)
    return leaves or [points]


def _halves(corners: Array, edges: Any, axis: Array, at: float) -> list[Array]:
    """Return the ends of edges (E, 2) on either side of a plane, with the points where edges cross
    it.
    """
    heights = corners @ axis - at
    a = heights[edges[:, 0]]
    b = heights[edges[:, 1]]
    crossing = a * b < 0.0
    part = (a[crossing] / (a[crossing] - b[crossing]))[:, None]
    cut = corners[edges[crossing, 0]] * (1.0 - part) + corners[edges[crossing, 1]] * part
    used = np.zeros(len(corners), bool)
    used[edges] = True
    return [np.vstack([corners[used & (sign * heights >= 0.0)], cut]) for sign in (1.0, -1.0)]


def _hull_volume(points: Array) -> float:
    return float(hull_of(points).volume) if len(points) else 0.0


def _parts(faces: Any) -> list[Any]:
    """Return the faces of each connected part, or all faces as one part if there are too many
    parts.
    """
    parts = mesh_shape.connected_parts(faces)
    return [faces] if len(parts) > _CRUMBS else parts


def _joined(pieces: list[Array], worth: float) -> list[Array]:
    """Join pairs of pieces, smallest added volume first, while it is below `worth` or there are too
    many pieces.
    """
    hulls = dict(
        enumerate(sorted(map(hull_of, pieces), key=lambda hull: hull.volume, reverse=True))
    )
    together: dict[tuple[int, int], tuple[float, Any]] = {}  # added volume and common hull of pairs
    while len(hulls) > 1:
        for i, j in combinations(hulls, 2):
            if (i, j) not in together:
                hull = hull_of(np.vstack([hulls[k].points[hulls[k].vertices] for k in (i, j)]))
                together[i, j] = (
                    float(hull.volume) - float(hulls[i].volume) - float(hulls[j].volume),
                    hull,
                )
        (i, j), (least, hull) = min(together.items(), key=lambda entry: entry[1][0])
        if least > worth and len(hulls) <= _MAX_PIECES:
            break
        hulls[max(hulls) + 1] = hull
        hulls = {k: hull for k, hull in hulls.items() if k not in (i, j)}
        together = {
            pair: each for pair, each in together.items() if i not in pair and j not in pair
        }
    return [hull.points[hull.vertices] for hull in hulls.values()]
