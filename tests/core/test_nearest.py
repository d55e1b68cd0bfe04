"""The nearest balanced forces, against a conic program of another solver."""

from __future__ import annotations

import _core_test as insides
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
    models = grasp.models
    placement = insides.place(
        grasp.positions,
        grasp.normals,
        models.cone_scale,
        np.ones((grasp.n_contacts, 2)),
        torsion=models.torsional_friction,
    )
    force, torsion, count = insides.nearest_forces(placement, wrench, preload, forces)
    return count, force, torsion


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


def near_limit(rng: np.random.Generator) -> tuple[Grasp, np.ndarray, np.ndarray]:
    """Return a grasp, a wrench that is inside what it can balance by 1e-4 of its size, and forces
    that balance it."""
    while True:
        count = int(rng.integers(3, 9))
        points = rng.standard_normal((count, 3))
        points /= np.linalg.norm(points, axis=1)[:, None]
        normals = -points + 0.3 * rng.standard_normal((count, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        model = {"contact_model": "soft", "torsional_friction": 0.01} if count % 2 else {}
        grasp = Grasp.from_contacts(RADIUS * points, normals, float(rng.uniform(0.3, 1.0)), **model)
        ends = rng.standard_normal((2, 6)) * np.repeat([1.0, 0.02], 3)

        def forces(
            share: float, grasp: Grasp = grasp, ends: np.ndarray = ends
        ) -> np.ndarray | None:
            try:
                return optimize_force(grasp, (1.0 - share) * ends[0] + share * ends[1]).force
            except InfeasibleWrenchError:
                return None

        if forces(0.0) is None or forces(1.0) is not None:
            continue
        low, high = 0.0, 1.0
        while high - low > 1e-4:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if forces(middle) is None else (middle, high)
        wrench = (1.0 - low) * ends[0] + low * ends[1]
        inwards = -grasp.matrix[:, ::3].sum(axis=1)
        wrench += 1e-4 * np.linalg.norm(wrench) / np.linalg.norm(inwards) * inwards
        return grasp, wrench, optimize_force(grasp, wrench).force


def test_near_the_limit_of_what_contacts_can_balance():
    """The multipliers of the balance are far larger than the wrench there."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        grasp, wrench, optimal = near_limit(rng)
        given = 0.6 * optimal + rng.standard_normal(optimal.shape)
        count, force, torsion = found(grasp, wrench, given, np.zeros(len(given)))
        assert count >= 0
        left = grasp.matrix @ force.reshape(-1) + grasp.contacts.torsion_matrix @ torsion + wrench
        assert np.abs(left).max() < 1e-9 * (1.0 + np.abs(force).max())


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
