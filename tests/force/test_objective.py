"""The description matrix, Phi and its derivatives against their definitions, bounds against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import phi as oracle
from problems import GRASPS, OUTSIDE, WEIGHTS, closure_grasps, inside_cones

from grasp_env.force import Objective, description_matrix, optimize_force
from grasp_env.grasp import wrench as wrenches


def test_eigenvalues_are_u_and_u_plus_minus_s() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        force, friction = rng.standard_normal((4, 3)), rng.uniform(0.1, 1.5, 4)
        u, s = friction * force[:, 0], np.hypot(force[:, 1], force[:, 2])
        expected = np.sort(np.concatenate([u, u - s, u + s]))
        # rounding of a 12 x 12 eigenvalue problem of order one
        np.testing.assert_allclose(np.linalg.eigvalsh(description_matrix(force, friction)), expected, atol=1e-13)
    for normal, inside in ((2.0 + 1e-9, True), (2.0 - 1e-9, False), (-3.0, False)):  # positive definite inside
        force = np.array([[normal, 0.6, 0.8]])
        assert (np.linalg.eigvalsh(description_matrix(force, np.array([0.5])))[0] > 0.0) == inside


def test_cone_coordinates_there_and_back() -> None:
    force, grasp = np.random.default_rng(1).standard_normal((5, 3)), GRASPS["cuboid, 5, uneven"]
    x = grasp.to_cone(force)
    np.testing.assert_array_equal(x.reshape(5, 3), force * np.column_stack([grasp.friction, *np.ones((2, 5))]))
    np.testing.assert_allclose(grasp.to_force(x), force, rtol=3e-16)


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_phi_is_the_trace_of_its_definition_and_its_derivatives_are_the_oracles(omega: float, lam: float) -> None:
    """Those of the oracle are held against differences of its Phi."""
    rng, objective = np.random.default_rng(0), Objective(omega, lam)
    for _ in range(100):
        x, friction = inside_cones(rng, 4), rng.uniform(0.2, 1.2, 4)
        matrix = description_matrix(x.reshape(-1, 3) / np.stack([friction, *np.ones((2, 4))], axis=1), friction)
        expected = omega * np.trace(matrix) + lam * np.trace(np.linalg.inv(matrix))
        # the inverse of P loses digits by its condition number, at most 100 here
        assert objective.value(x) == pytest.approx(expected, rel=1e-12)
        of_each = np.tile([omega, lam], (4, 1))
        for found, want in (
            (objective.gradient(x), oracle.gradient(x, of_each)),
            (objective.hessian(x), blocks(x, of_each)),
        ):
            np.testing.assert_allclose(found, want.astype(float), rtol=0, atol=1e-11 * float(np.abs(want).max()))


def blocks(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, 3, 3) on the diagonal of the Hessian, which has nothing elsewhere."""
    full = oracle.hessian(x, weights).reshape(4, 3, 4, 3)
    return np.array([full[k, :, k] for k in range(4)])


def test_phi_is_infinite_outside_and_on_the_cones() -> None:
    inside = np.array([1.0, 0.2, 0.1])
    for outside in OUTSIDE:
        for x in (np.array([*inside, *outside]), np.array([*outside, *inside])):
            assert Objective().value(x) == np.inf


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_bounds_are_the_oracles(omega: float, lam: float) -> None:
    """No multipliers give more than Phi."""
    rng, objective, bounded = np.random.default_rng(7), Objective(omega, lam), 0
    for grasp in (*GRASPS.values(), *closure_grasps()):
        of_each = np.tile([omega, lam], (grasp.n_contacts, 1))
        for wrench in wrenches.sample_ball(rng, 10):
            multipliers = rng.standard_normal(6) * omega * rng.choice([1e-3, 0.1, 0.5, 2.0])
            multipliers[3:] /= grasp.length
            bound = objective.lower_bound(multipliers, grasp.cone_matrix, wrench)
            want = float(oracle.lower_bound(multipliers, grasp.cone_matrix, wrench, of_each))
            assert bound == pytest.approx(want, rel=1e-11, abs=1e-13)
            assert bound <= optimize_force(grasp, wrench, force_weight=omega, barrier_weight=lam).objective * (
                1.0 + 1e-12
            )
            bounded += np.isfinite(bound)
    assert bounded > 50
