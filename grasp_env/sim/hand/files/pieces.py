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
from grasp_env.sim.hand.files.meshes import CACHE_VERSION, Job, run_jobs
from grasp_env.sim.hand.solids import few_corners, hull_of, hull_shape, principal_axes
from grasp_env.sim.hand.tree import Geometry, Vector3
from grasp_env.sim.objects.cache import cached

_CONVEX = 0.9  # share of its hull's volume from which on a mesh counts as convex
_MAX_PIECES = 8
# share of the whole hull's volume that a cut must remove, or that joining two pieces may add
_LEAST_GAIN = 0.03
_CUTS = (0.2, 0.35, 0.5, 0.65, 0.8)  # positions of cuts within a piece's extent
_MAX_DEPTH = 4  # cuts one after another
_FINE = 5000  # number of faces above which a mesh is simplified before it is cut
_GRAINS = 150.0  # number of grid cells along the extent of a simplified mesh
SMALLEST, LARGEST = 1e-5, 5.0  # [m] extent of a mesh
PLAUSIBLE = 0.4  # largest extent of a hand's link [m]
_MAX_FRAGMENTS = 40  # number of connected parts above which a mesh is cut as a whole
_VISUAL_CORNERS = 256  # of the hull of a visual mesh in which a tip is fitted
_VISUAL_ERROR = 2e-4  # relative error of that hull


@dataclass(frozen=True)
class MeshUse:
    """A mesh of a <collision> or <visual> that has not been read."""

    name: str  # in the hand's file
    path: Path
    scale: Vector3
    origin: Vector3
    rotation: Vector3
    color: Vector3 | None


def solids_of(
    shapes: Mapping[str, Sequence[Geometry | MeshUse]], file: str
) -> dict[str, list[Geometry]]:
    """Return the collision shapes by link, with meshes replaced by convex pieces.

    The progress line names `file`.
    """
    uses = dict[tuple[Path, Vector3], tuple[str, str]]()  # first link and name of each mesh
    for link, link_shapes in shapes.items():
        for shape in link_shapes:
            if isinstance(shape, MeshUse):
                uses.setdefault((shape.path, shape.scale), (link, shape.name))
    jobs = [
        Job(path, np.array(scale).tobytes(), partial(_pieces_of, scale)) for path, scale in uses
    ]
    results = run_jobs(jobs, f"{file}: convex pieces of meshes")
    pieces = dict[tuple[Path, Vector3], list[Array]]()
    with AllFaults() as check:
        for (mesh, (link, name)), result in zip(uses.items(), results, strict=True):
            if isinstance(result, InvalidInputError):
                check.add(f"link {link!r}, <collision>, {shown(name)}: {result}")
            else:
                pieces[mesh] = _split(result)

    def solids(shape: Geometry | MeshUse) -> list[Geometry]:
        if isinstance(shape, Geometry):
            return [shape]
        return [
            hull_shape(piece, shape.origin, shape.rotation)
            for piece in pieces[shape.path, shape.scale]
        ]

    return {
        link: [solid for shape in link_shapes for solid in solids(shape)]
        for link, link_shapes in shapes.items()
    }


def extents_of(uses: Sequence[MeshUse]) -> list[float]:
    """Return the largest extent of each mesh [m]; 0 for one that cannot be read."""
    jobs = [Job(use.path, b"extents", _extents_of) for use in uses]
    return [
        0.0
        if isinstance(result, InvalidInputError)
        else float(np.abs(result["extents"] * use.scale).max())
        for use, result in zip(uses, run_jobs(jobs, "sizes of meshes"), strict=True)
    ]


def _extents_of(corners: Array, _: Any) -> dict[str, Any]:
    return {"extents": np.ptp(corners, axis=0)}


def _pieces_of(scale: Vector3, corners: Array, faces: Any) -> dict[str, Any]:
    return _packed(convex_pieces(corners * scale, faces))


def hulls_of_files(files: Iterable[str]) -> dict[str, Array]:
    """Return at most `_VISUAL_CORNERS` hull corners (K, 3) of each mesh file, in its units."""
    names = list(dict.fromkeys(files))
    hulls = dict[str, Array]()
    results = run_jobs([Job(Path(name), b"hull", _hull_of) for name in names], "hulls of meshes")
    with AllFaults() as check:
        for name, result in zip(names, results, strict=True):
            if isinstance(result, InvalidInputError):
                check.add(result)
            else:
                hulls[name] = result["corners"]
    return hulls


def _hull_of(corners: Array, _: Any) -> dict[str, Any]:
    hull = hull_of(corners)
    points = hull.points[hull.vertices]
    return {"corners": mesh_shape.reduce_hull(points, _VISUAL_CORNERS, _VISUAL_ERROR)}


def cached_pieces(corners: Array, faces: Any, name: str) -> list[Array]:
    """Return the `convex_pieces` of corners (V, 3) [m] and faces (F, 3).

    They come from the cache if possible, which lists them under `name`.
    """
    corners = np.ascontiguousarray(corners, dtype=float)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    key = digest(CACHE_VERSION.encode(), b"arrays", corners.tobytes(), faces.tobytes())

    def make() -> dict[str, Any]:
        size = mesh_shape.WELD * mesh_shape.extent_of(corners)
        return _packed(convex_pieces(*mesh_shape.weld(corners, faces, size)))

    return _split(cached(key, name, make, use="hand"))


def _packed(pieces: list[Array]) -> dict[str, Any]:
    return {"pieces": np.concatenate(pieces), "counts": np.array([len(piece) for piece in pieces])}


def _split(packed: dict[str, Any]) -> list[Array]:
    return np.split(packed["pieces"], np.cumsum(packed["counts"])[:-1])


def convex_pieces(corners: Array, faces: Any) -> list[Array]:
    """Return convex pieces (K, 3) that contain a mesh, each of up to `solids.MAX_CORNERS` corners.

    A mesh that fills nine tenths of its hull, or is too fine to be cut, is one piece. Otherwise its
    connected parts are cut by planes that reduce the volume of the hulls. Pieces whose common hull
    adds little are joined, until at most `_MAX_PIECES` are left.

    Raises:
        InvalidInputError: The size is implausible for a part of a hand.
    """
    extent = float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0
    if not SMALLEST <= extent <= LARGEST:
        factor = mesh_shape.scale_advice(extent, PLAUSIBLE) or "the length of the file's unit [m]"
        raise InvalidInputError(
            f"the mesh is {extent:.3g} m large, allowed are {SMALLEST:g} to {LARGEST:g}; multiply scale= of its <mesh> by {factor}"
        )
    hull = hull_of(corners)
    parts = _parts(faces)
    if abs(mesh_shape.volume(corners, faces)) >= _CONVEX * hull.volume and len(parts) == 1:
        return [few_corners(corners)]
    if len(faces) > _FINE:
        corners, faces = mesh_shape.weld(corners, faces, extent / _GRAINS)
        corners = (extent / _GRAINS) * np.round(corners * (_GRAINS / extent))
        faces = np.unique(faces, axis=0)
        if len(faces) > 2 * _FINE:  # a soup of triangles: cutting would take minutes
            return [few_corners(corners)]
        parts = _parts(faces)
    pieces: list[Array] = []
    least = _LEAST_GAIN * hull.volume
    for part in parts:
        around = hull_of(corners[np.unique(part)])
        filled = abs(mesh_shape.volume(corners, part))
        # no cut can remove more
        if around.volume - filled <= least and not mesh_shape.open_edges(part):
            pieces.append(around.points)
        else:
            blind = 2 if filled < 0.85 * around.volume else 0
            pieces += _cut(corners, part, least, blind, _MAX_DEPTH)
    return [few_corners(points) for points in _joined(pieces, least)]


def _cut(corners: Array, faces: Any, least: float, blind: int, depth: int) -> list[Array]:
    """Return points of the pieces of a surface after up to `depth` cuts that gain `least` [m^3].

    `blind` cuts need not reduce the volume, such as the first cut of a ring.
    """
    from trimesh.intersections import slice_faces_plane

    points = corners[np.unique(faces)]
    whole = hull_of(points)
    if depth == 0 or whole.volume <= least:
        return [points]
    edges = mesh_shape.numbered(mesh_shape.sides_of(faces))[0]
    axes = principal_axes(points)
    heights = points @ axes.T
    low = heights.min(axis=0)
    extent = np.ptp(heights, axis=0)
    planes = [
        (axis, start + share * size)
        for axis, start, size in zip(axes, low, extent, strict=True)
        for share in _CUTS
    ]
    bounds = [
        sum(
            _hull_volume(half[mesh_shape.farthest(half)])
            for half in _halves(corners, edges, *plane)
        )
        for plane in planes
    ]
    best, gain = None, least
    for k in np.argsort(bounds, kind="stable"):
        # later cuts gain less, as the hull of all points is larger than that of few
        if whole.volume - bounds[k] <= gain:
            break
        left = sum(_hull_volume(half) for half in _halves(corners, edges, *planes[k]))
        if whole.volume - left > gain:
            best, gain = planes[k], whole.volume - left
    if best is None:
        if blind == 0:
            return [points]
        blind -= 1
        longest = int(extent.argmax())
        best = axes[longest], low[longest] + 0.5 * extent[longest]
    axis, height = best
    pieces: list[Array] = []
    for sign in (1.0, -1.0):
        half: Any = slice_faces_plane(corners, faces, sign * axis, height * axis)
        if len(half[1]):
            pieces += _cut(np.asarray(half[0]), np.asarray(half[1]), least, blind, depth - 1)
    return pieces or [points]


def _halves(corners: Array, edges: Any, axis: Array, height: float) -> list[Array]:
    """Return the ends of edges (E, 2) on either side of a plane, with the edges' points in it."""
    heights = corners @ axis - height
    a, b = heights[edges].T
    crossing = a * b < 0.0
    share = (a[crossing] / (a[crossing] - b[crossing]))[:, None]
    cut = corners[edges[crossing, 0]] * (1.0 - share) + corners[edges[crossing, 1]] * share
    used = np.zeros(len(corners), bool)
    used[edges] = True
    return [np.vstack([corners[used & (sign * heights >= 0.0)], cut]) for sign in (1.0, -1.0)]


def _hull_volume(points: Array) -> float:
    return float(hull_of(points).volume) if len(points) else 0.0


def _parts(faces: Any) -> list[Any]:
    """Return the faces of each connected part; if there are too many, all faces as one part."""
    parts = mesh_shape.connected_parts(faces)
    return [faces] if len(parts) > _MAX_FRAGMENTS else parts


def _joined(pieces: list[Array], least: float) -> list[Array]:
    """Join pairs that add least volume, up to `least` [m^3], until `_MAX_PIECES` are left."""
    largest_first = sorted(map(hull_of, pieces), key=lambda hull: hull.volume, reverse=True)
    hulls = dict(enumerate(largest_first))
    pairs: dict[tuple[int, int], tuple[float, Any]] = {}  # added volume and common hull
    while len(hulls) > 1:
        for i, j in combinations(hulls, 2):
            if (i, j) not in pairs:
                hull = hull_of(np.vstack([hulls[k].points[hulls[k].vertices] for k in (i, j)]))
                added = float(hull.volume) - float(hulls[i].volume) - float(hulls[j].volume)
                pairs[i, j] = added, hull
        (i, j), (added, hull) = min(pairs.items(), key=lambda entry: entry[1][0])
        if added > least and len(hulls) <= _MAX_PIECES:
            break
        hulls[max(hulls) + 1] = hull
        del hulls[i], hulls[j]
        pairs = {pair: value for pair, value in pairs.items() if not {i, j} & {*pair}}
    return [hull.points[hull.vertices] for hull in hulls.values()]
