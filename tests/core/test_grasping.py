"""Gaps of segments against a fine grid; the least force against the conic solver."""

from __future__ import annotations

import _core_test
import numpy as np
import pytest

from grasp_env import core
from grasp_env.force import ForceOptimizer, force_closure
from grasp_env.grasp import Grasp


def test_gaps() -> None:
    rng = np.random.default_rng(3)
    part = np.linspace(0.0, 1.0, 201)[:, None]
    cylinder = core.Surface.make("cylinder", np.array([0.04, 0.05, 0.0]), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    for _ in range(40):
        a, b, c, d = rng.normal(size=(4, 3)) * 0.1
        one, two = a + part * (b - a), c + part * (d - c)
        brute = np.linalg.norm(one[:, None] - two[None], axis=2).min()
        found = _core_test.segment_gap(a, b, c, d)
        assert found == pytest.approx(brute, abs=3e-3)
        assert found <= brute + 1e-12
        for point in (a, b):
            brute = np.linalg.norm(point - two, axis=1).min()
            assert brute - 3e-3 < _core_test.segment_gap(point, point, c, d) < brute + 1e-12
            assert _core_test.segment_gap(c, d, point, point) == pytest.approx(
                _core_test.segment_gap(point, point, c, d), abs=1e-12
            )
        assert _core_test.segment_gap(a, a, c, c) == pytest.approx(np.linalg.norm(a - c))
        assert _core_test.segment_gap(a, b, a, b) == pytest.approx(0.0, abs=1e-9)
        brute = min(cylinder.nearest(center)[2] for center in one)
        assert _core_test.surface_gap(cylinder, a, b) == pytest.approx(brute, abs=1.5e-3)
        assert _core_test.surface_gap(cylinder, a, a) == cylinder.nearest(a)[2]


def test_least_force_against_the_conic_solver() -> None:
    rng = np.random.default_rng(4)
    closed = 0
    for _ in range(30):
        count = int(rng.integers(3, 7))
        normals = -rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        points = -0.05 * normals + 0.005 * rng.normal(size=(count, 3))
        grasp = Grasp.from_contacts(points, normals, 0.5)
        wrench = rng.normal(size=6) * ([1.0] * 3 + [0.05] * 3)
        found = _core_test.least_force(points, normals, 0.5, 0.05, -wrench / ([1.0] * 3 + [0.05] * 3))
        if not force_closure(grasp).closed:
            continue
        closed += 1
        best = ForceOptimizer(grasp, method="conic").solve(wrench).objective
        assert best * (1.0 - 1e-6) <= found <= 1.03 * best
    assert closed > 10


def test_no_force_where_none_balances() -> None:
    points, normals = np.array([[0.0, 0.0, -0.05], [0.0, 0.0, 0.05]]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert _core_test.least_force(points, normals, 0.5, 0.05, np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])) < 2.1
    assert _core_test.least_force(points, normals, 0.5, 0.05, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])) == np.inf


@pytest.mark.parametrize("kind", ["cuboid", "sphere", "capsule", "cylinder", "mesh"])
def test_a_surface_needs_its_numbers(kind: str) -> None:
    none = np.zeros((0, 3, 3)), np.zeros((0, 3))
    with pytest.raises(TypeError):
        core.Surface.make(kind, np.zeros(4), *none)
    with pytest.raises(TypeError):
        core.Surface.make(kind, np.zeros(3), np.zeros((1, 3, 3)), np.zeros((2, 3)))
    if kind == "mesh":
        with pytest.raises(ValueError, match="a mesh with faces"):
            core.Surface.make(kind, np.zeros(3), *none)
    with pytest.raises(ValueError, match="cuboid"):
        core.Surface.make(kind + "s", np.zeros(3), *none)
