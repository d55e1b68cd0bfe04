"""Convex pieces that together cover a closed mesh, for collisions and distances."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.mesh_shape import reduce_hull, volume
from grasp_env.sim.objects.apart import apart

CONVEX = 1e-3  # share of its hull's volume that a mesh may lack and still count as convex
CONCAVITY = 0.03
"""Largest concavity of a piece in CoACD: about how far it may protrude, over half the mesh's size."""
MAX_PIECES = 32  # of a connected mesh
MAX_CORNERS = 256  # of a piece: the faces of a ball of 66 mm are then within 0.7 mm
FINE = 2e-4  # distance by which omitted corners may stand out of a piece, relative to its size
LONGEST = 60.0  # longest time to cut a mesh [s]; 1 to 12 s are usual
_MAX_CUT_FACES = 5000  # faces, above which a mesh is simplified before it is cut
# a third of CoACD's default search; preprocessing would add a shell of a hundredth of the size
_SEARCH = {"mcts_iterations": 60, "mcts_max_depth": 2, "resolution": 1000, "preprocess_mode": "off"}


def convex_pieces(corners: Array, faces: Any, name: str) -> list[Array]:
    """Cut a mesh into convex pieces with corners (K, 3); a convex mesh is one piece.

    CoACD (Wei et al. 2022) cuts it, or V-HACD if that fails. The pieces contain all corners of the
    mesh, except for what `MAX_CORNERS` leaves out. In hollows they protrude from the mesh by a few
    hundredths of its size.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    if volume(corners, faces) >= (1.0 - CONVEX) * hull.volume:
        return [reduce_hull(corners[hull.vertices], MAX_CORNERS, FINE)]
    coarse = _simplified(corners, faces)
    reason = ""
    for task in ("by_coacd", "by_vhacd"):
        try:
            text = f"{name}: cutting it into convex pieces, once for this content"
            cut = apart(f"{__name__}:{task}", text, LONGEST, corners=coarse[0], faces=coarse[1])
        except (TimeoutError, ChildProcessError) as error:
            # CoACD crashes or never ends if faces cross, and is not available on every machine
            reason = str(error).strip().rsplit("\n", 1)[-1]
            continue
        ends = np.cumsum(cut["counts"].astype(int))[:-1]
        if pieces := _covering(np.split(cut["points"], ends), corners):
            return pieces
    raise InvalidInputError(
        f"{name} cannot be cut into convex pieces ({reason or 'none was found'}). Where its faces cross, repair it with "
        "`grasp object mend FILE`, or remesh it"
    )


def by_coacd(corners: Array, faces: Any) -> dict[str, Array]:
    """Cut a mesh by CoACD; return "points" (P, 3) of all pieces, and "counts" (N,) for each piece."""
    import coacd

    coacd.set_log_level("error")
    mesh = coacd.Mesh(corners, faces)
    return _packed(
        coacd.run_coacd(mesh, threshold=CONCAVITY, max_convex_hull=MAX_PIECES, **_SEARCH)
    )


def by_vhacd(corners: Array, faces: Any) -> dict[str, Array]:
    """Cut a mesh by V-HACD 4, with the same result as `by_coacd`."""
    import vhacdx

    options = {"maxConvexHulls": MAX_PIECES, "maxNumVerticesPerCH": 64}
    return _packed(vhacdx.compute_vhacd(corners, faces.astype(np.uint32), **options))


def _packed(meshes: list[Any]) -> dict[str, Array]:
    pieces = [np.asarray(points, dtype=float) for points, _ in meshes]
    return {
        "points": np.concatenate([np.empty((0, 3)), *pieces]),
        "counts": np.array([len(piece) for piece in pieces], dtype=int),
    }


def _simplified(corners: Array, faces: Any) -> tuple[Array, Any]:
    if len(faces) <= _MAX_CUT_FACES:
        return corners, faces
    import fast_simplification

    middle = corners.mean(axis=0)
    size = float(np.ptp(corners, axis=0).max())
    unit = ((corners - middle) / size).astype(np.float32)
    points, triangles = fast_simplification.simplify(
        unit, faces.astype(np.int32), target_count=_MAX_CUT_FACES
    )[:2]
    return np.asarray(points, dtype=float) * size + middle, np.asarray(triangles, dtype=np.int32)


def _covering(pieces: list[Array], corners: Array) -> list[Array]:
    """Grow each piece by the mesh's corners nearest to it, until the pieces contain all of them."""
    from scipy.spatial import ConvexHull, QhullError

    hulls: list[Any] = []
    for piece in pieces:
        with suppress(QhullError):  # flat: it has no volume
            hulls.append(ConvexHull(piece))
    if not hulls:
        return []
    heights = np.array(
        [(corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) for hull in hulls]
    )
    nearest = heights.argmin(axis=0)
    outside = heights.min(axis=0) > 0.0
    grown: list[Array] = []
    for number, hull in enumerate(hulls):
        added = corners[outside & (nearest == number)]
        hull = ConvexHull(np.vstack([hull.points[hull.vertices], added]))
        grown.append(reduce_hull(hull.points[hull.vertices], MAX_CORNERS, FINE))
    return grown
