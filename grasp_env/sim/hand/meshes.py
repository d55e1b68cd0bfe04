"""Mesh files of a hand: where they are, and the convex pieces that a hand touches with in their stead."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from grasp_env._check import Array
from grasp_env._files import MEGABYTE, read_bytes
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim import mesh_files
from grasp_env.sim.hand.solids import few_corners, hull_of, principal_axes
from grasp_env.sim.mesh_files import key_lines, key_places, one_newline

DRAWN = (".obj", ".stl", ".dae")
"""Kinds of meshes that Bullet draws."""

_MOST_LOOKS = 20 * MEGABYTE  # bytes of a mesh that is drawn
_MOST_BLOCKS = 10_000
_PARENTS = 5  # folders above the URDF in which its meshes may be
_FULL = 0.9  # of its hull's volume, from which on a mesh counts as convex
_MOST_PIECES = 8
_WORTH = 0.03  # of the whole hull's volume that a cut must take away, or that joining two pieces may add
_CUTS = (0.2, 0.35, 0.5, 0.65, 0.8)  # of a piece's extent
_DEEPEST = 4
_FINE = 5000  # faces, beyond which a mesh that is not convex is taken coarser before it is cut
_GRAINS = 150.0  # then, along its extent
_SMALLEST, _LARGEST = 1e-5, 5.0  # [m] of a mesh
_CRUMBS = 40


def find_mesh(name: str, urdf: Path) -> Path:
    """The file that a URDF means: as it is written, beside the URDF or in a folder above it; a package's name may be left out.

    Raises:
        InvalidInputError: There is none.
    """
    kind, separator, rest = name.partition("://")
    path = Path(unquote(rest) if separator else name)
    if separator and kind not in ("package", "file", "model"):
        raise InvalidInputError(f"mesh {shown(name)}: only file://, package:// and plain paths are read")
    parts = path.parts[1:] if path.is_absolute() else path.parts
    tails = [parts, parts[1:]] if kind in ("package", "model") and separator else [parts]
    folders = list(urdf.absolute().parents)[: _PARENTS + 1]
    try:
        if path.is_absolute() and path.is_file():
            return path
        for folder in folders:
            for tail in tails:
                if tail and (found := folder.joinpath(*tail)).is_file():
                    return found
    except (OSError, ValueError):  # too long, or a zero in it
        pass
    raise InvalidInputError(f"there is no mesh {shown(name)} beside the URDF or in the {_PARENTS} folders above it")


def read_mesh(path: str | Path) -> tuple[Array, Any]:
    """Corners (V, 3), in the file's units, those at one place once, and faces (F, 3) of a mesh.

    Raises:
        InvalidInputError: Not a mesh, or one too large; what is in the file is never run.
    """
    corners, faces = mesh_files.read_mesh(path, f"the mesh {path}")
    _, kept, numbers = np.unique(corners.round(9), axis=0, return_index=True, return_inverse=True)
    return corners[kept], numbers.reshape(-1)[faces]


def why_not_drawn(path: Path) -> str:
    """What keeps Bullet from drawing a mesh, "" for nothing: it would crash where faces name corners that do not exist."""
    kind = path.suffix.lower()
    if kind not in DRAWN:
        return f"are none of {', '.join(DRAWN)}"
    try:
        blob = read_bytes(path, _MOST_LOOKS)
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if kind != ".obj":
        return "" if len(blob) > 84 else "are empty"
    try:
        return "" if _corners_exist(blob) else "are broken"
    except ValueError:
        return "are broken"


def _corners_exist(blob: bytes) -> bool:
    """Whether the faces of an .obj name corners, and textures and normals if any, that stand before them."""
    text = one_newline(blob)
    faces, *others = (np.fromiter(key_places(text, key), np.int64) for key in (b"f", b"v", b"vt", b"vn"))
    known = np.stack([np.searchsorted(other, faces) for other in others], axis=1)
    # blocks of faces that stand behind the same; most files have one
    cuts = (np.flatnonzero((np.diff(known, axis=0) != 0).any(axis=1)) + 1).tolist()
    if len(faces) == 0 or len(cuts) > _MOST_BLOCKS:
        return False
    rows = key_lines(text, b"f")
    for begin, end in zip([0, *cuts], [*cuts, len(rows)], strict=True):
        for word in set(b" ".join(rows[begin:end]).split()):
            numbers = word.split(b"/")
            if len(numbers) > 3 or any(
                number and not 1 <= int(number) <= most for number, most in zip(numbers, known[begin], strict=False)
            ):
                return False
    return True


def convex_pieces(corners: Array, faces: Any) -> list[Array]:
    """Convex pieces that together contain a mesh, each as at most `solids.MOST_CORNERS` corners (K, 3).

    One, where the mesh fills nine tenths of its hull, or is too fine to be cut. Else its parts, cut by planes where that takes
    away some of their hulls, and those joined whose common hull adds little: `_MOST_PIECES` at most.

    Args:
        corners: (V, 3) [m].
        faces: Their numbers, (F, 3).

    Raises:
        InvalidInputError: It is no size for a part of a hand.
    """
    extent = float(np.ptp(corners, axis=0).max())
    if not _SMALLEST <= extent <= _LARGEST:
        raise InvalidInputError(
            f"the mesh is {extent:.3g} m large, allowed are {_SMALLEST:g} to {_LARGEST:g}; of one in millimetres give "
            'scale="0.001 0.001 0.001"'
        )
    hull = hull_of(corners)
    parts = _parts(faces)
    if _volume(corners, faces) >= _FULL * hull.volume and len(parts) == 1:
        return [few_corners(corners)]
    if len(faces) > _FINE:
        corners, faces = _coarser(corners, faces)
        if len(faces) > 2 * _FINE:  # a soup: it would take minutes
            return [few_corners(corners)]
        parts = _parts(faces)
    leaves: list[Array] = []
    worth = _WORTH * hull.volume
    for part in parts:
        around, filled = hull_of(corners[np.unique(part)]), _volume(corners, part)
        if around.volume - filled <= worth and _closed(part):  # no cut can take away more
            leaves.append(around.points)
        else:
            leaves += _cut(corners, part, worth, 2 if filled < 0.85 * around.volume else 0, _DEEPEST)
    return [few_corners(points) for points in _joined(leaves, worth)]


def _coarser(corners: Array, faces: Any) -> tuple[Array, Any]:
    """A mesh whose corners lie on a grid of `_GRAINS` over its extent."""
    grain = float(np.ptp(corners, axis=0).max()) / _GRAINS
    cells, numbers = np.unique(np.round(corners / grain), axis=0, return_inverse=True)
    faces = np.unique(numbers.reshape(-1)[faces], axis=0)
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return cells * grain, faces[distinct]


def _parts(faces: Any) -> list[Any]:
    """The faces of each connected part; all of them where it falls into crumbs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = int(faces.max()) + 1
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][faces[:, 0]]
    names = list(dict.fromkeys(labels.tolist()))
    return [faces] if len(names) > _CRUMBS else [faces[labels == name] for name in names]


def _closed(faces: Any) -> bool:
    """Whether every edge belongs to two faces."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def _volume(corners: Array, faces: Any) -> float:
    """Of a closed mesh."""
    a, b, c = (corners[faces[:, k]] - corners.mean(axis=0) for k in range(3))
    return abs(float(np.einsum("fk,fk->", a, np.cross(b, c)))) / 6.0


def _cut(corners: Array, faces: Any, worth: float, blind: int, deepest: int) -> list[Array]:
    """Points of the pieces of a surface; `blind` cuts may be made that are worth nothing by themselves, as of a ring."""
    from trimesh.intersections import slice_faces_plane

    points = corners[np.unique(faces)]
    whole = hull_of(points)
    if deepest == 0 or whole.volume <= worth:
        return [points]
    best, gain = None, worth
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    axes = principal_axes(points)
    for axis in axes:
        heights = points @ axis
        for part in _CUTS:
            at = heights.min() + part * np.ptp(heights)
            less = sum(_hull_volume(_side(corners, edges, sign * axis, sign * at)) for sign in (1.0, -1.0))
            if whole.volume - less > gain:
                best, gain = (axis, at), whole.volume - less
    if best is None:
        if blind == 0:
            return [points]
        blind -= 1
        axis = axes[np.ptp(points @ axes.T, axis=0).argmax()]
        best = axis, 0.5 * float((points @ axis).min() + (points @ axis).max())
    axis, at = best
    leaves: list[Array] = []
    for sign in (1.0, -1.0):
        half: Any = slice_faces_plane(corners, faces, sign * axis, at * axis)
        if len(half[1]):
            leaves += _cut(np.asarray(half[0]), np.asarray(half[1]), worth, blind, deepest - 1)
    return leaves or [points]


def _side(corners: Array, edges: Any, normal: Array, offset: float) -> Array:
    """The ends of edges (E, 2) above a plane, and where they cross it."""
    heights = corners @ normal - offset
    a, b = heights[edges[:, 0]], heights[edges[:, 1]]
    crossing = a * b < 0.0
    at = (a[crossing] / (a[crossing] - b[crossing]))[:, None]
    cut = corners[edges[crossing, 0]] * (1.0 - at) + corners[edges[crossing, 1]] * at
    return np.vstack([corners[edges[a >= 0.0, 0]], corners[edges[b >= 0.0, 1]], cut])


def _hull_volume(points: Array) -> float:
    return float(hull_of(points).volume) if len(points) else 0.0


def _joined(pieces: list[Array], worth: float) -> list[Array]:
    """Pieces joined, the pair whose common hull adds least first, while that is little or there are too many."""
    pieces = sorted((hull_of(piece).points for piece in pieces), key=_hull_volume, reverse=True)
    volumes = [_hull_volume(piece) for piece in pieces]
    added: dict[tuple[int, int], float] = {}
    alive = list(range(len(pieces)))
    while len(alive) > 1:
        for i, j in ((i, j) for i in alive for j in alive if i < j and (i, j) not in added):
            added[i, j] = _hull_volume(np.vstack([pieces[i], pieces[j]])) - volumes[i] - volumes[j]
        (i, j), least = min(((pair, more) for pair, more in added.items()), key=lambda entry: entry[1])
        if least > worth and len(alive) <= _MOST_PIECES:
            break
        together = hull_of(np.vstack([pieces[i], pieces[j]]))
        pieces.append(together.points[together.vertices])
        volumes.append(float(together.volume))
        alive = [k for k in alive if k not in (i, j)] + [len(pieces) - 1]
        added = {pair: more for pair, more in added.items() if i not in pair and j not in pair}
    return [pieces[k] for k in alive]
