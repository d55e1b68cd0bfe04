"""The nearest balanced forces, against a conic program of another solver."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.nearest import nearest_forces

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp

RADIUS = 0.05


def problem(seed: int, soft: bool, fingers: int) -> tuple[Grasp, np.ndarray, np.ndarray]:
    """Return a grasp around a ball, a wrench that it can balance, and forces near balanced ones."""
    rng = np.random.default_rng(seed)
    while True:
        points = rng.standard_normal((fingers, 3))
        points /= np.linalg.norm(points, axis=1)[:, None]
        model = {"contact_model": "soft", "torsional_friction": 0.01} if soft else {}
        grasp = Grasp.from_contacts(RADIUS * points, -points, float(rng.uniform(0.3, 1.0)), **model)
        wrench = rng.standard_normal(6) * np.repeat([2.0, 0.05], 3)
        try:
            forces = optimize_force(grasp, wrench).force
        except InfeasibleWrenchError:
            continue
        break
    return grasp, wrench, forces + rng.standard_normal(forces.shape) * rng.choice([0.1, 1.0, 10.0])


def found(grasp: Grasp, wrench: np.ndarray, forces: np.ndarray, preload: np.ndarray) -> tuple:
    """Return the number of iterations, forces and torsions of the core."""
    force = forces.copy()
    torsion = np.zeros(len(forces))
    return grasp.contacts.nearest(wrench, preload, force, torsion), force, torsion


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("fingers", [3, 4, 6])
def test_the_nearest_forces(soft, fingers):
    """The oracle reaches 1e-5 of the forces."""
    rng = np.random.default_rng(fingers)
    for seed in range(6):
        grasp, wrench, forces = problem(seed, soft, fingers)
        preload = rng.uniform(0.0, 1.0, fingers) * (seed % 2)
        count, force, torsion = found(grasp, wrench, forces, preload)
        assert 0 <= count <= 40
        size = 1.0 + np.abs(force).max()
        left = grasp.matrix @ force.reshape(-1) + grasp.contacts.torsion_matrix @ torsion + wrench
        assert np.abs(left).max() < 1e-9 * size
        expected, turned = nearest_forces(grasp, wrench, forces, preload)
        np.testing.assert_allclose(force, expected, atol=1e-4 * size)
        np.testing.assert_allclose(torsion, turned, atol=1e-4 * size * RADIUS)


def test_forces_that_fit_stay_as_they_are():
    grasp, wrench, _ = problem(0, False, 4)
    inside = optimize_force(grasp, wrench).force
    count, force, _ = found(grasp, wrench, inside, np.zeros(4))
    assert count == 0
    np.testing.assert_array_equal(force, inside)


def test_without_balanced_forces_nothing_changes():
    """All contacts on one side push upwards only."""
    points = np.array([[0.03, -0.02, 0.0], [-0.02, -0.02, 0.02], [-0.02, -0.02, -0.02]])
    normals = np.tile([0.0, 1.0, 0.0], (3, 1))
    grasp = Grasp.from_contacts(points, normals, 0.5)
    forces = np.ones((3, 3))
    count, force, _ = found(grasp, np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]), forces, np.zeros(3))
    assert count == -1
    np.testing.assert_array_equal(force, forces)
