"""The grasp planner: distances of convex solids and objects against hulls, the least force against
the conic solver and linprog."""

from __future__ import annotations

import _core_test
import numpy as np
import pytest
from scipy.optimize import linprog, nnls
from scipy.spatial import ConvexHull

from grasp_env import core
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.quality import force_closure

ROUND = 48  # corners that stand for a circle: it is 0.2 % larger
KINDS = ("point", "line", "box", "cylinder", "hull")
EYE = np.eye(3).ravel()


def limb(kind: str, half: np.ndarray, corners: np.ndarray | None = None) -> core.Limb:
    return core.Limb.solid(
        link=-1,
        kind=kind,
        half=half.tolist(),
        center=(0.0,) * 3,
        rotation=EYE.tolist(),
        corners=np.zeros((0, 3)) if corners is None else corners,
        tip=False,
    )


def solid(
    kind: str, rng: np.random.Generator, flat: float = 1.0
) -> tuple[core.Limb, np.ndarray, float]:
    """A limb about the origin, corners of its core, and its radius; `flat` thins boxes and hulls."""
    half = rng.uniform(0.005, 0.03, 3)
    radius = float(rng.uniform(0.002, 0.01))
    half[1] *= flat
    if kind in ("point", "line"):
        end = np.array([0.0, 0.0, 0.0 if kind == "point" else half[2]])
        made = core.Limb.line(
            link=-1, start=(-end).tolist(), end=end.tolist(), radius=radius, tip=False
        )
        return made, np.array([-end, end]), radius
    if kind == "hull":
        corners = rng.normal(size=(12, 3)) * half
        corners -= corners.mean(axis=0)
        return limb(kind, np.zeros(3), corners), corners, 0.0
    if kind == "cylinder":
        half[1] = half[0]
        turn = np.linspace(0.0, 2.0 * np.pi, ROUND, endpoint=False)
        ring = half[0] * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(ROUND)])
        corners = np.vstack([ring + half * [0, 0, 1], ring - half * [0, 0, 1]])
    else:
        corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return limb(kind, half), corners, 0.0


def distance(one: np.ndarray, two: np.ndarray) -> float:
    """Signed distance of the hulls of corners; 0 where their differences span no volume and hold
    the origin."""
    differences = (one[:, None] - two[None]).reshape(-1, 3)
    if np.linalg.matrix_rank(differences - differences.mean(axis=0), tol=1e-9) == 3:
        offsets = ConvexHull(differences, qhull_options="QJ").equations[:, 3]
        if offsets.max() < 0.0:
            return float(offsets.max())
    heavy = 1e3  # of the row that makes the weights add to 1
    rows = np.vstack([differences.T, np.full(len(differences), heavy)])
    weights, _ = nnls(rows, np.array([0.0, 0.0, 0.0, heavy]), maxiter=2000)
    return float(np.linalg.norm(differences.T @ weights / weights.sum()))


@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_random_pairs_of_solids(first, second):
    rng = np.random.default_rng([KINDS.index(first), KINDS.index(second)])
    for trial in range(12):
        a, corners_a, radius_a = solid(first, rng, 1e-4 if trial % 3 == 0 else 1.0)
        b, corners_b, radius_b = solid(second, rng)
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn = q * np.sign(np.linalg.det(q))
        shift = rng.normal(size=3) * (0.0, 0.012, 0.05, 0.05)[trial % 4]
        found = _core_test.limb_gap(a, b, turn.ravel(), shift)
        expected = distance(corners_a, corners_b @ turn.T + shift) - radius_a - radius_b
        # corners instead of circles; QJ and the expanding polytope stop at 1 um
        assert found == pytest.approx(expected, abs=2e-4 if "cylinder" in (first, second) else 2e-6)
        enough = 0.5 * max(found, 1e-3)  # of which a lower bound is enough
        low = _core_test.limb_gap(a, b, turn.ravel(), shift, enough)
        assert min(found, enough) - 2e-6 <= low <= found + 2e-6


@pytest.mark.parametrize("kind", ["cuboid", "cylinder", "sphere", "capsule"])
def test_gaps_of_objects(kind):
    """A box of a nanometre is a point: the object's own nearest point is the oracle. A line is
    sampled."""
    rng = np.random.default_rng(7)
    part = np.linspace(0.0, 1.0, 201)[:, None]
    surface = core.Surface.make(kind, np.array([0.02, 0.03, 0.025 if kind == "cuboid" else 0.0]))
    speck = limb("box", np.full(3, 1e-9))
    for _ in range(30):
        center, end = rng.normal(size=(2, 3)) * 0.03
        assert _core_test.object_gap(surface, speck, EYE, center) == pytest.approx(
            surface.nearest(center)[2], abs=2e-6
        )
        rod = core.Limb.line(
            link=-1, start=(-end).tolist(), end=end.tolist(), radius=0.01, tip=False
        )
        brute = min(surface.nearest(center + at)[2] for at in -end + 2.0 * part * end) - 0.01
        assert _core_test.object_gap(surface, rod, EYE, center) == pytest.approx(brute, abs=1.5e-3)
        enough = brute - 0.005  # any number above it will do where the gap is larger
        assert _core_test.object_gap(surface, rod, EYE, center, enough) > enough
        near = _core_test.object_gap(surface, rod, EYE, center, brute + 0.005)
        assert near == pytest.approx(brute, abs=1.5e-3)


def least_force(points, normals, load, efforts=None, torsion=0.0) -> float:
    none = np.zeros(0) if efforts is None else efforts
    return _core_test.least_force(points, normals, 0.5, 0.05, load, none, torsion)


def test_least_force_against_the_conic_solver():
    rng = np.random.default_rng(4)
    closed = 0
    for _ in range(20):
        count = int(rng.integers(3, 7))
        normals = -rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        points = -0.05 * normals + 0.005 * rng.normal(size=(count, 3))
        grasp = Grasp.from_contacts(points, normals, 0.5)
        wrench = rng.normal(size=6) * ([1.0] * 3 + [0.05] * 3)
        found = least_force(points, normals, -wrench / ([1.0] * 3 + [0.05] * 3))
        if not force_closure(grasp).closed:
            continue
        closed += 1
        best = ForceOptimizer(grasp, method="conic").solve(wrench).objective
        assert best * (1.0 - 1e-6) <= found <= 1.03 * best
    assert closed > 6


def rays(normal: np.ndarray, friction: float) -> np.ndarray:
    """Forces of normal part 1 on and in a friction cone, (R, 3)."""
    side = np.linalg.svd(normal[None])[2][1:]
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = np.cos(turn)[:, None] * side[0] + np.sin(turn)[:, None] * side[1]
    return np.vstack([normal + part * friction * ring for part in (0.0, 0.5, 1.0)])


def test_torques_count_where_they_exceed_the_force():
    """The price of a ray is that of the joint nearest to its limit: never below linprog over rays,
    seldom far above."""
    rng = np.random.default_rng(9)
    ratios = []
    for _ in range(12):
        normals = -rng.normal(size=(4, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        points = -0.05 * normals + 0.005 * rng.normal(size=(4, 3))
        efforts = 2.0 * rng.normal(size=(4, 3, 3))
        load = rng.normal(size=6)
        columns = []
        costs = []
        for point, normal, effort in zip(points, normals, efforts, strict=True):
            for force in rays(normal, 0.5):
                columns.append([*force, *np.cross(point, force) / 0.05])
                costs.append(max(1.0, np.abs(effort @ force).max()))
        best = linprog(costs, A_eq=np.array(columns).T, b_eq=load, method="highs")
        # else barely closed: the rays between those tried decide
        if best.success and best.fun < 100.0:
            ratios.append(least_force(points, normals, load, efforts) / best.fun)
    assert len(ratios) > 5
    # 48 rays miss the round cone by 0.2 %, in costs and in reach by a few times that
    assert min(ratios) >= 0.98
    assert np.median(ratios) < 1.2


@pytest.mark.parametrize(
    ("load", "torsion", "force"),
    [
        ([0, 1, 0, 0, 0, 0], 0.0, 2.0),
        ([0, 0, 0, 0, 0, 1], 0.0, np.inf),
        ([0, 0, 0, 0, 0, 1], 0.005, 10.0),
    ],
)
def test_two_fingers(load, torsion, force):
    """Only soft contacts turn the object about the line: each holds 5 mm times its force, 0.05 N m
    takes 10 N in all."""
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    found = least_force(-0.05 * normals, normals, np.array(load, float), torsion=torsion)
    assert found == pytest.approx(force, rel=0.02)


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.1
FACES = np.array([[0.0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.parametrize(
    ("corners", "faces", "pieces", "message"),
    [
        (CORNERS, FACES[:0], [CORNERS], "faces and pieces"),
        (CORNERS, FACES, [], "faces and pieces"),
        (CORNERS, FACES + 1, [CORNERS], "does not exist"),
        (CORNERS, FACES - 1, [CORNERS], "does not exist"),
        (CORNERS, FACES * np.nan, [CORNERS], "does not exist"),
        (0.0 * CORNERS, FACES, [CORNERS], "area"),
        (np.nan * CORNERS, FACES, [CORNERS], "finite"),
        (CORNERS, FACES, [CORNERS, CORNERS[:0]], "piece has corners"),
    ],
)
def test_a_mesh_needs_faces_and_pieces(corners, faces, pieces, message):
    with pytest.raises(ValueError, match=message):
        core.Surface.mesh(corners, faces, pieces)
