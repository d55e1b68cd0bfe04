"""Distances of convex solids against the hull of their differences, apart, touching, deep in one another and flat."""

from __future__ import annotations

import _core_test
import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from grasp_env import core

ROUND = 48  # corners that stand for a circle: it is 0.2 % larger
KINDS = ("point", "line", "box", "cylinder", "hull")


def solid(kind: str, rng: np.random.Generator, flat: float = 1.0) -> tuple[core.Limb, np.ndarray, float]:
    """A limb about the origin, corners of its core, and its radius; `flat` thins boxes and hulls."""
    half, radius = rng.uniform(0.005, 0.03, 3), float(rng.uniform(0.002, 0.01))
    half[1] *= flat
    if kind in ("point", "line"):
        end = np.array([0.0, 0.0, 0.0 if kind == "point" else half[2]])
        limb = core.Limb.line(link=-1, start=(-end).tolist(), end=end.tolist(), radius=radius, tip=False)
        return limb, np.array([-end, end]), radius
    none, eye = np.zeros((0, 3)), np.eye(3).ravel().tolist()
    if kind == "hull":
        corners = rng.normal(size=(12, 3)) * half
        corners -= corners.mean(axis=0)
        limb = core.Limb.solid(
            link=-1, kind=kind, half=(0.0,) * 3, center=(0.0,) * 3, rotation=eye, corners=corners, tip=False
        )
        return limb, corners, 0.0
    if kind == "cylinder":
        half[1] = half[0]
        turn = np.linspace(0.0, 2.0 * np.pi, ROUND, endpoint=False)
        ring = half[0] * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(ROUND)])
        up = np.array([0.0, 0.0, half[2]])
        corners = np.vstack([ring + up, ring - up])
    else:
        corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    limb = core.Limb.solid(
        link=-1, kind=kind, half=half.tolist(), center=(0.0,) * 3, rotation=eye, corners=none, tip=False
    )
    return limb, corners, 0.0


def distance(one: np.ndarray, two: np.ndarray) -> float:
    """Signed, of the hulls of corners; 0 where their differences span no volume and hold the origin."""
    differences = (one[:, None] - two[None]).reshape(-1, 3)
    if np.linalg.matrix_rank(differences - differences.mean(axis=0), tol=1e-9) == 3:
        offsets = ConvexHull(differences, qhull_options="QJ").equations[:, 3]
        if offsets.max() < 0.0:
            return float(offsets.max())
    heavy = 1e3  # of the row that makes the weights add to 1
    rows = np.vstack([differences.T, np.full(len(differences), heavy)])
    weights, _ = nnls(rows, np.array([0.0, 0.0, 0.0, heavy]), maxiter=2000)
    return float(np.linalg.norm(differences.T @ weights / weights.sum()))


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_random_pairs(first: str, second: str) -> None:
    rng = np.random.default_rng([KINDS.index(first), KINDS.index(second)])
    for trial in range(12):
        flat = 1e-4 if trial % 3 == 0 else 1.0
        a, corners_a, radius_a = solid(first, rng, flat)
        b, corners_b, radius_b = solid(second, rng)
        turn = rotation(rng)
        shift = rng.normal(size=3) * (
            0.0 if trial % 4 == 0 else 0.012 if trial % 4 == 1 else 0.05
        )  # concentric, deep, apart
        found = _core_test.limb_gap(a, b, turn.ravel(), shift)
        wanted = distance(corners_a, corners_b @ turn.T + shift) - radius_a - radius_b
        inexact = (
            2e-4 if "cylinder" in (first, second) else 2e-6
        )  # corners instead of circles; QJ and the expanding polytope stop at 1 um
        assert found == pytest.approx(wanted, abs=inexact)


@pytest.mark.parametrize("kind", ["cuboid", "cylinder", "sphere", "capsule"])
def test_objects_have_the_same_surface(kind: str) -> None:
    rng = np.random.default_rng(7)
    numbers = np.array([0.02, 0.03, 0.025]) if kind == "cuboid" else np.array([0.02, 0.03, 0.0])
    item = core.Surface.make(kind, numbers)
    tiny = np.full(3, 1e-9).tolist()
    none, eye = np.zeros((0, 3)), np.eye(3)
    speck = core.Limb.solid(
        link=-1, kind="box", half=tiny, center=(0.0,) * 3, rotation=eye.ravel().tolist(), corners=none, tip=False
    )
    for _ in range(60):
        center = rng.normal(size=3) * 0.03
        # a box of a nanometre is a point: the object's own nearest point is the oracle; depths are exact to 1 um
        assert _core_test.object_gap(item, speck, eye.ravel(), center) == pytest.approx(
            item.nearest(center)[2], abs=2e-6
        )


def test_touching_and_early_answers() -> None:
    rng = np.random.default_rng(2)
    eye = np.eye(3).ravel()
    box, _, _ = solid("box", rng)
    half = _half(box)
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = 2.0 * half[axis]
        assert _core_test.limb_gap(box, box, eye, shift) == pytest.approx(0.0, abs=1e-6)
        shift[axis] += 0.004
        assert _core_test.limb_gap(box, box, eye, shift) == pytest.approx(0.004, abs=1e-9)
        low = _core_test.limb_gap(box, box, eye, shift, 0.001)
        assert 0.001 < low <= 0.004 + 1e-9  # a lower bound is enough
    assert _core_test.limb_gap(box, box, eye, np.zeros(3)) == pytest.approx(-2.0 * min(half), abs=2e-6)


def _half(box: core.Limb) -> list[float]:
    """Half the sides of a box, by points that come from far away."""
    point = core.Limb.line(link=-1, start=(0.0,) * 3, end=(0.0,) * 3, radius=1e-12, tip=False)
    return [1.0 - _core_test.limb_gap(box, point, np.eye(3).ravel(), np.eye(3)[axis]) for axis in range(3)]
