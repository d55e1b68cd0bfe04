"""The description matrix, Phi and its derivatives against their definitions, bounds against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from problems import (
    GRASPS,
    OUTSIDE,
    WEIGHTS,
    closure_grasps,
    inside_cones,
    pyramid_margin,
)

from grasp_env.force import Objective, description_matrix
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
    rng = np.random.default_rng(1)
    force, grasp = rng.standard_normal((5, 3)), GRASPS["cuboid, 5, uneven"]
    x = grasp.to_cone(force)
    np.testing.assert_array_equal(x.reshape(5, 3)[:, 0], grasp.friction * force[:, 0])
    np.testing.assert_array_equal(x.reshape(5, 3)[:, 1:], force[:, 1:])
    np.testing.assert_allclose(grasp.to_force(x), force, rtol=3e-16)


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_phi_is_the_trace_of_its_definition(omega: float, lam: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        x, friction = inside_cones(rng, 4), rng.uniform(0.2, 1.2, 4)
        matrix = description_matrix(x.reshape(-1, 3) / np.stack([friction, *np.ones((2, 4))], axis=1), friction)
        expected = omega * np.trace(matrix) + lam * np.trace(np.linalg.inv(matrix))
        # the inverse of P loses digits by its condition number, at most 100 here
        assert Objective(omega, lam).value(x) == pytest.approx(expected, rel=1e-12)


def test_phi_is_infinite_outside_and_on_the_cones() -> None:
    inside = np.array([1.0, 0.2, 0.1])
    for outside in OUTSIDE:
        for x in (np.array([*inside, *outside]), np.array([*outside, *inside])):
            assert Objective().value(x) == np.inf


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_derivatives_by_finite_differences(omega: float, lam: float) -> None:
    rng = np.random.default_rng(1)
    objective = Objective(omega, lam)
    for _ in range(50):
        x = inside_cones(rng, 3)
        gradient, blocks = objective.gradient(x), objective.hessian(x)
        for j in range(9):
            slack = x[3 * (j // 3)] - np.hypot(x[3 * (j // 3) + 1], x[3 * (j // 3) + 2])
            h = 1e-4 * slack  # derivatives grow by 1 / slack each: relative truncation is of order (h / slack)^2 = 1e-8
            e = np.zeros(9)
            e[j] = h
            ends = objective.gradient(x + e), objective.gradient(x - e)
            value = (objective.value(x + e) - objective.value(x - e)) / (2.0 * h)
            largest = np.abs(gradient[3 * (j // 3) : 3 * (j // 3) + 3]).max() + lam / slack**2 + 3.0 * omega
            # rounding of Phi: 1e-16 of its value over h
            assert abs(value - gradient[j]) < 1e-6 * largest + 4e-16 * objective.value(x) / h
            column = (ends[0] - ends[1]) / (2.0 * h)
            block = blocks[j // 3]
            own = column.reshape(3, 3)[j // 3]
            np.testing.assert_allclose(own, block[:, j % 3], rtol=0, atol=1e-6 * np.abs(block).max())
            np.testing.assert_array_equal(np.delete(column.reshape(3, 3), j // 3, axis=0), 0.0)


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_weak_duality(omega: float, lam: float) -> None:
    """No multipliers give a bound above Phi of any balanced force inside the cones."""
    rng = np.random.default_rng(7)
    objective = Objective(omega, lam)
    compared = 0
    for grasp in (*GRASPS.values(), *closure_grasps()):
        _, internal = pyramid_margin(grasp, np.zeros(6), inner=True)
        assert internal is not None
        for _ in range(10):
            wrench = wrenches.sample_ball(rng, 1)[0]
            loaded = -(grasp.pseudoinverse @ wrench).reshape(-1, 3)
            squeeze = rng.uniform(1.0, 20.0) * np.abs(loaded).max() / max(np.abs(internal).max(), 1e-9)
            force = loaded + squeeze * internal
            value = objective.value(grasp.to_cone(force))
            multipliers = rng.standard_normal(6) * omega * rng.choice([1e-3, 0.1, 0.5, 2.0])
            multipliers[3:] /= grasp.length
            bound = objective.lower_bound(multipliers, grasp.cone_matrix, wrench)
            if np.isfinite(value) and np.isfinite(bound):
                compared += 1
                assert bound <= value * (1.0 + 1e-12)
    assert compared > 50
