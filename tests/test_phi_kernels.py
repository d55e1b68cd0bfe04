"""The control tick's twins of the core: Phi, its derivatives and the 6 x 6 algebra, against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from problems import GRASPS, OUTSIDE, WEIGHTS, inside_cones, weights

from grasp_env import phi_kernels as kernels
from grasp_env.force import Objective


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_kernels_are_the_twin(omega: float, lam: float) -> None:
    rng = np.random.default_rng(2)
    objective = Objective(omega, lam)
    for _ in range(100):
        x = inside_cones(rng, 4)
        # the factors (u^2 - s^2) lose a factor of 50 of the rounding at a margin of 2 %, its cube thrice that
        assert kernels.phi(x, weights(x, omega, lam)) == pytest.approx(objective.value(x), rel=1e-13)
        gradient = np.empty(12)
        kernels.gradient(x, weights(x, omega, lam), gradient)
        np.testing.assert_allclose(gradient, objective.gradient(x), rtol=1e-11, atol=1e-12 * np.abs(gradient).max())
        inverse = np.empty((4, 3, 3))
        kernels.inverse_hessian(x, weights(x, omega, lam), inverse)
        blocks = objective.hessian(x)
        for one, other in zip(inverse, blocks, strict=True):
            np.testing.assert_allclose(one @ other, np.eye(3), atol=1e-8)  # condition numbers reach 1e4


def test_phi_is_infinite_outside_and_on_the_cones() -> None:
    inside = np.array([1.0, 0.2, 0.1])
    for outside in OUTSIDE:
        for x in (np.array([*inside, *outside]), np.array([*outside, *inside])):
            assert kernels.phi(x, weights(x, 1.0, 0.01)) == np.inf


def test_inverse_hessian_on_the_axis_of_the_cone() -> None:
    x = np.array([2.0, 0.0, 0.0])
    inverse = np.empty((1, 3, 3))
    kernels.inverse_hessian(x, weights(x, 1.0, 0.5), inverse)
    np.testing.assert_allclose(inverse[0] @ Objective(1.0, 0.5).hessian(x)[0], np.eye(3), atol=1e-15)


@pytest.mark.parametrize("name", GRASPS)
def test_schur_complement_and_cholesky_are_numpys(name: str) -> None:
    rng = np.random.default_rng(3)
    grasp = GRASPS[name]
    count = grasp.n_contacts
    root = rng.standard_normal((count, 3, 3))
    blocks = np.einsum("nij,nkj->nik", root, root) + 0.1 * np.eye(3)
    half, s = np.empty((3 * count, 6)), np.empty((6, 6))
    kernels.schur(grasp.cone_matrix.copy(), blocks, half, s)
    g = grasp.cone_matrix
    dense = np.zeros((3 * count, 3 * count))
    for k in range(count):
        dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = blocks[k]
    expected = g @ dense @ g.T
    np.testing.assert_allclose(half, dense @ g.T, atol=1e-13)
    np.testing.assert_allclose(np.tril(s), np.tril(expected), atol=1e-12)
    b = rng.standard_normal(6)
    solved = b.copy()
    assert kernels.cholesky(s)
    np.testing.assert_allclose(np.tril(s), np.linalg.cholesky(expected), atol=1e-12)
    kernels.cholesky_solve(s, solved)
    # forces of order 1 and moments of order 0.05 m squared: a condition number of about 1e4
    np.testing.assert_allclose(expected @ solved, b, atol=1e-11)


def test_cholesky_refuses_what_is_not_positive_definite() -> None:
    assert not kernels.cholesky(np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]))
    assert not kernels.cholesky(np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0]))
    assert not kernels.cholesky(np.diag([1.0, 1.0, np.nan, 1.0, 1.0, 1.0]))
