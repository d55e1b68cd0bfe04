"""Convex pieces that together hold a closed mesh: what engines touch and what distances are measured to."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError

CONVEX = 1e-3
"""Part of its hull's volume that a mesh may lack and count as convex."""
CONCAVITY = 0.03
"""Of a piece, as CoACD measures it on a mesh from -1 to 1: about as far as it may stand out of the mesh, over half the mesh's size."""
MOST_PIECES = 32
MOST_CORNERS = 256
"""Of a piece: a ball of 66 mm has its faces within 0.3 mm."""
FINE = 2e-4
"""Of a piece's size, by which its hull may be smaller with fewer corners."""

_FINE = 5000  # faces, beyond which a mesh is taken coarser before it is cut
_SEARCH = {"mcts_iterations": 60, "mcts_max_depth": 2, "resolution": 1000, "preprocess_mode": "off"}
"""A third of CoACD's own search, in a third of the time; its preprocessing puts a shell of a hundredth of the size around a mesh."""
_PATIENCE = 1.0  # [s] after which long work is told of on a terminal

_FIRST = np.array([(x, y, z) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for z in (-1.0, 0.0, 1.0)])

T = TypeVar("T")


def convex_pieces(corners: Array, faces: Any, name: str) -> list[Array]:
    """Corners (K, 3) of each piece: one of a convex mesh, else those of CoACD (Wei et al. 2022), on ARM and Linux of V-HACD, at most `MOST_PIECES`.

    Every corner of the mesh is in a piece, but for what the `MOST_CORNERS` of each leave out. Pieces stand out of the mesh where it is hollow, by a few hundredths of its size.

    Args:
        corners: (V, 3).
        faces: Of a closed mesh, from outside counterclockwise, (F, 3).
        name: Of the mesh, for the line on a terminal.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    if volume(corners, faces) >= (1.0 - CONVEX) * hull.volume:
        return [_outermost(corners[hull.vertices])]
    coarse = _coarser(corners, faces)
    found = watched(lambda: _cut(*coarse), f"{name}: cutting it into convex pieces, once for this content")
    pieces = [np.asarray(points, dtype=float) for points, _ in found]
    if not pieces:
        raise InvalidInputError(f"{name} cannot be cut into convex pieces; mend it with `grasp object mend`")
    return _holding(pieces, corners)


def volume(corners: Array, faces: Any) -> float:
    """Of a closed mesh."""
    a, b, c = (corners[faces[:, k]] - corners.mean(axis=0) for k in range(3))
    return float(np.einsum("fk,fk->", a, np.cross(b, c))) / 6.0


def watched(work: Callable[[], T], text: str) -> T:
    """What `work` returns; on a terminal a line with its time, and Ctrl-C ends the wait for it."""
    done: list[Any] = []

    def run() -> None:
        try:
            done.append((True, work()))
        except BaseException as error:  # told to who waits
            done.append((False, error))

    worker, begun, told = threading.Thread(target=run, daemon=True), time.monotonic(), False
    worker.start()
    while worker.is_alive():
        worker.join(0.1)
        if sys.stderr is not None and sys.stderr.isatty() and time.monotonic() - begun > _PATIENCE:
            told = True
            print(f"\r{text}, {time.monotonic() - begun:.0f} s", end="", file=sys.stderr, flush=True)
    if told:
        print(file=sys.stderr)
    good, value = done[0]
    if not good:
        raise value
    return value


def _cut(corners: Array, faces: Any) -> list[Any]:
    """Corners and faces of each piece."""
    if find_spec("coacd") is None:  # ARM and Linux
        import vhacdx

        return vhacdx.compute_vhacd(
            corners, faces.astype(np.uint32), maxConvexHulls=MOST_PIECES, maxNumVerticesPerCH=MOST_CORNERS
        )
    import coacd

    coacd.set_log_level("error")
    return coacd.run_coacd(coacd.Mesh(corners, faces), threshold=CONCAVITY, max_convex_hull=MOST_PIECES, **_SEARCH)


def _coarser(corners: Array, faces: Any) -> tuple[Array, Any]:
    if len(faces) <= _FINE:
        return corners, faces
    import fast_simplification

    middle, size = corners.mean(axis=0), float(np.ptp(corners, axis=0).max())
    unit = ((corners - middle) / size).astype(np.float32)
    points, triangles = fast_simplification.simplify(unit, faces.astype(np.int32), target_count=_FINE)[:2]
    return np.asarray(points, dtype=float) * size + middle, np.asarray(triangles, dtype=np.int32)


def _holding(pieces: list[Array], corners: Array) -> list[Array]:
    """The pieces, each with the corners of the mesh that lie in none and nearest to it."""
    from scipy.spatial import ConvexHull

    hulls = [ConvexHull(piece) for piece in pieces]
    heights = np.array([(corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) for hull in hulls])
    nearest, outside = heights.argmin(axis=0), heights.min(axis=0) > 0.0
    out: list[Array] = []
    for number, hull in enumerate(hulls):
        grown = ConvexHull(np.vstack([hull.points[hull.vertices], corners[outside & (nearest == number)]]))
        out.append(_outermost(grown.points[grown.vertices]))
    return out


def _outermost(corners: Array) -> Array:
    """Of many corners (K, 3) of a hull those without which it would lose most, until it loses less than `FINE` of its size."""
    from scipy.spatial import ConvexHull

    if len(corners) <= MOST_CORNERS:
        return corners
    chosen = np.unique((corners @ _FIRST.T).argmax(axis=0))
    while len(chosen) < MOST_CORNERS:
        planes = ConvexHull(corners[chosen]).equations
        heights = corners @ planes[:, :3].T + planes[:, 3]
        outside, face = heights.max(axis=1), heights.argmax(axis=1)
        outside[chosen] = 0.0
        order = np.argsort(-outside, kind="stable")
        order = order[outside[order] > FINE * np.ptp(corners, axis=0).max()]
        if len(order) == 0:
            break
        worst = order[np.unique(face[order], return_index=True)[1]]  # of each face the furthest
        worst = worst[np.argsort(-outside[worst], kind="stable")][: MOST_CORNERS - len(chosen)]
        chosen = np.append(chosen, worst)
    return corners[chosen]
