"""Convex pieces that together hold a closed mesh: what engines touch and what distances are measured to."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InvalidInputError
from grasp_env.sim.mesh_shape import outermost, volume
from grasp_env.sim.objects.apart import apart

CONVEX = 1e-3
"""Part of its hull's volume that a mesh may lack and count as convex."""
CONCAVITY = 0.03
"""Of a piece, as CoACD measures it on a mesh from -1 to 1: about as far as it may stand out of the mesh, over half the mesh's size."""
MOST_PIECES = 32
"""Of a mesh in one part."""
MOST_CORNERS = 256
"""Of a piece: a ball of 66 mm has its faces within 0.7 mm."""
FINE = 2e-4
"""Of a piece's size, by which its hull may be smaller with fewer corners."""
LONGEST = 60.0
"""[s] that cutting a mesh may take; usual are 1 to 12."""

_FINE = 5000  # faces, beyond which a mesh is taken coarser before it is cut
_SEARCH = {"mcts_iterations": 60, "mcts_max_depth": 2, "resolution": 1000, "preprocess_mode": "off"}
"""A third of CoACD's own search, in a third of the time; its preprocessing puts a shell of a hundredth of the size around a mesh."""


def convex_pieces(corners: Array, faces: Any, name: str) -> list[Array]:
    """Corners (K, 3) of each piece: one of a convex mesh, else those of CoACD (Wei et al. 2022), or of V-HACD where that has no answer.

    Every corner of the mesh is in a piece, but for what the `MOST_CORNERS` of each leave out. Pieces stand out of the mesh where it is
    hollow, by a few hundredths of its size.

    Args:
        corners: (V, 3).
        faces: Of a closed mesh, from outside counterclockwise, (F, 3).
        name: Of the mesh, for messages.

    Raises:
        InvalidInputError: Neither cuts it.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    if volume(corners, faces) >= (1.0 - CONVEX) * hull.volume:
        return [outermost(corners[hull.vertices], MOST_CORNERS, FINE)]
    coarse, said = _coarser(corners, faces), ""
    for task in ("by_coacd", "by_vhacd"):
        try:
            text = f"{name}: cutting it into convex pieces, once for this content"
            made = apart(f"{__name__}:{task}", text, LONGEST, corners=coarse[0], faces=coarse[1])
        except (
            TimeoutError,
            ChildProcessError,
        ) as error:  # CoACD crashes or runs for ever where faces cross, and is not on every machine
            said = str(error).strip().rsplit("\n", 1)[-1]
            continue
        found = _holding(np.split(made["points"], np.cumsum(made["counts"].astype(int))[:-1]), corners)
        if found:
            return found
    raise InvalidInputError(
        f"{name} cannot be cut into convex pieces ({said or 'none was found'}). Where its faces cross, mend it with "
        "`grasp object mend FILE`, or remesh it"
    )


def by_coacd(corners: Array, faces: Any) -> dict[str, Array]:
    """Points (P, 3) of all pieces, and counts (N,) of those of each."""
    import coacd

    coacd.set_log_level("error")
    mesh = coacd.Mesh(corners, faces)
    return _packed(coacd.run_coacd(mesh, threshold=CONCAVITY, max_convex_hull=MOST_PIECES, **_SEARCH))


def by_vhacd(corners: Array, faces: Any) -> dict[str, Array]:
    """The same by V-HACD 4."""
    import vhacdx

    return _packed(
        vhacdx.compute_vhacd(corners, faces.astype(np.uint32), maxConvexHulls=MOST_PIECES, maxNumVerticesPerCH=64)
    )


def _packed(found: list[Any]) -> dict[str, Array]:
    pieces = [np.asarray(points, dtype=float) for points, _ in found]
    return {
        "points": np.concatenate([np.empty((0, 3)), *pieces]),
        "counts": np.array([len(each) for each in pieces], dtype=int),
    }


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
    from scipy.spatial import ConvexHull, QhullError

    hulls: list[Any] = []
    for piece in pieces:
        with suppress(QhullError):  # flat: it holds nothing
            hulls.append(ConvexHull(piece))
    if not hulls:
        return []
    heights = np.array([(corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) for hull in hulls])
    nearest, outside = heights.argmin(axis=0), heights.min(axis=0) > 0.0
    out: list[Array] = []
    for number, hull in enumerate(hulls):
        grown = ConvexHull(np.vstack([hull.points[hull.vertices], corners[outside & (nearest == number)]]))
        out.append(outermost(grown.points[grown.vertices], MOST_CORNERS, FINE))
    return out
