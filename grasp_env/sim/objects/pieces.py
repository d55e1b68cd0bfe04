"""Convex pieces that together cover a closed mesh, for collisions and distances."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.mesh_shape import extent_of, reduce_hull, volume
from grasp_env.sim.objects.apart import apart

CONVEX = 1e-3  # share of its hull's volume that a mesh may lack and still count as convex
MAX_PIECES = 64  # of a connected mesh
MAX_CORNERS = 256  # of a piece: the faces of a ball of 66 mm are then within 0.7 mm
FINE = 2e-4  # distance by which omitted corners may stand out of a piece, relative to its size
LONGEST = 30.0
"""Most processor time of one cut [s]; 1 to 10 s are usual."""
FAR = 0.1
"""Excess distance over the size of the mesh above which a finer cut is tried."""
# greedy cuts: a search two cuts ahead takes up to ten times as long and is hardly better;
# preprocessing would add a shell of a hundredth of the size
_SEARCH = {"mcts_iterations": 30, "mcts_max_depth": 1, "resolution": 1000, "preprocess_mode": "off"}
_SAMPLES = 10_000  # points of the pieces' surface at which the excess is measured


class Cut(NamedTuple):
    """A way to cut a mesh."""

    task: str  # function of this module
    faces: int  # number to which the mesh is simplified
    concavity: float  # largest one of a piece: its protrusion over half the mesh's size, about
    if_none: bool  # only if no other cut succeeds


CUTS = (
    Cut("by_coacd", 2000, 0.03, if_none=False),
    Cut("by_coacd", 4000, 0.02, if_none=False),
    Cut("by_coacd", 2000, 0.06, if_none=True),
    Cut("by_vhacd", 4000, 0.02, if_none=True),
)
"""Cuts that are tried in turn, until the pieces stand out by at most `FAR`."""


class Excess(NamedTuple):
    """How far convex pieces stand out of their mesh."""

    distance: float  # largest one from the mesh to the surface of the pieces
    volume: float  # that the pieces have more than the mesh, as a share of the mesh's


class Pieces(NamedTuple):
    """Convex pieces of a mesh."""

    corners: list[Array]  # (K, 3) of each piece
    excess: Excess
    in_time: bool = True  # False if a cut exceeded its time, which other machines may finish


def convex_pieces(corners: Array, faces: Any, name: str) -> Pieces:
    """Cut a mesh into convex pieces; a convex mesh is one piece.

    CoACD (Wei et al. 2022) cuts it. If the pieces stand out by more than `FAR`, it cuts once more
    and finer; if it takes too long, once more and coarser; and V-HACD if it fails. The pieces that
    stand out least are kept. They contain all corners of the mesh, except for what `MAX_CORNERS`
    leaves out.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    if volume(corners, faces) >= (1.0 - CONVEX) * hull.volume:
        whole = [reduce_hull(corners[hull.vertices], MAX_CORNERS, FINE)]
        return Pieces(whole, Excess(0.0, 0.0))
    best: Pieces | None = None
    in_time = True
    reason = ""
    for cut in CUTS:
        if best and (cut.if_none or best.excess.distance <= FAR * extent_of(corners)):
            break
        if not (in_time or cut.if_none):  # a finer cut takes longer
            continue
        try:
            pieces = _cut(corners, faces, name, cut)
        except TimeoutError as error:
            in_time = False
            reason = str(error)
            continue
        except ChildProcessError as error:
            # CoACD crashes or never ends if faces cross, and is not available on every machine
            reason = str(error).strip().rsplit("\n", 1)[-1]
            continue
        if not pieces:
            continue
        excess = measured_excess(pieces, corners, faces)
        if best is None or excess.distance < best.excess.distance:
            best = Pieces(pieces, excess)
    if best is None:
        raise InvalidInputError(
            f"{name} cannot be cut into convex pieces ({reason or 'none was found'}). Where its faces cross, repair it with "
            "`grasp object mend FILE`, or remesh it"
        )
    return best._replace(in_time=in_time)


def _cut(corners: Array, faces: Any, name: str, cut: Cut) -> list[Array]:
    points, triangles = _simplified(corners, faces, cut.faces)
    packed = apart(
        f"{__name__}:{cut.task}",
        f"{name}: cutting it into convex pieces, once for this content",
        LONGEST,
        corners=points,
        faces=triangles,
        concavity=np.array(cut.concavity),
    )
    ends = np.cumsum(packed["counts"].astype(int))[:-1]
    return _covering(np.split(packed["points"], ends), corners)


def measured_excess(pieces: Sequence[Array], corners: Array, faces: Any) -> Excess:
    """Measure how far pieces (K, 3) stand out of a closed mesh, at points of their surface."""
    import manifold3d
    import trimesh

    from grasp_env import core

    hulls = [manifold3d.Manifold.hull_points(np.ascontiguousarray(piece)) for piece in pieces]
    union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
    mesh = union.to_mesh64()
    surface = trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False
    )
    points = trimesh.sample.sample_surface(surface, _SAMPLES, seed=0)[0]
    solid = core.Surface.mesh(corners, faces.astype(float), list(pieces))
    distance = max(solid.nearest(point)[2] for point in np.vstack([surface.vertices, points]))
    inside = volume(corners, faces)
    return Excess(max(0.0, distance), max(0.0, union.volume() / inside - 1.0))


def by_coacd(corners: Array, faces: Any, concavity: Array) -> dict[str, Array]:
    """Cut a mesh by CoACD; return "points" (P, 3) of all pieces, and "counts" (N,) for each piece."""
    import coacd

    coacd.set_log_level("error")
    mesh = coacd.Mesh(corners, faces)
    return _packed(
        coacd.run_coacd(mesh, threshold=float(concavity), max_convex_hull=MAX_PIECES, **_SEARCH)
    )


def by_vhacd(corners: Array, faces: Any, concavity: Array) -> dict[str, Array]:
    """Cut a mesh by V-HACD 4, which knows no concavity, with the same result as `by_coacd`."""
    import vhacdx

    options = {"maxConvexHulls": MAX_PIECES, "maxNumVerticesPerCH": 64}
    return _packed(vhacdx.compute_vhacd(corners, faces.astype(np.uint32), **options))


def _packed(meshes: list[Any]) -> dict[str, Array]:
    pieces = [np.asarray(points, dtype=float) for points, _ in meshes]
    return {
        "points": np.concatenate([np.empty((0, 3)), *pieces]),
        "counts": np.array([len(piece) for piece in pieces], dtype=int),
    }


def _simplified(corners: Array, faces: Any, most: int) -> tuple[Array, Any]:
    if len(faces) <= most:
        return corners, faces
    import fast_simplification

    middle = corners.mean(axis=0)
    size = float(np.ptp(corners, axis=0).max())
    unit = ((corners - middle) / size).astype(np.float32)
    points, triangles = fast_simplification.simplify(
        unit, faces.astype(np.int32), target_count=most
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
