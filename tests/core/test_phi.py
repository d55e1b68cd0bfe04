"""Each formula of one contact, for a number and for registers of 2, 4 and 8, against the plain one in long double."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import phi as oracle

LANES = (1, 2, 4, 8)
EPS = 2.0**-52
LONG = np.longdouble


def rows(number: int = 403, shallowest: float = 1e-10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (n, 3) from the axis to close to the surface, 1e-6 to 1e6 N; weights (n, 2) over decades; 1 - s/u (n,)."""
    rng = np.random.default_rng(number)
    u, angle = 10.0 ** rng.uniform(-6.0, 6.0, number), rng.uniform(0.0, 2.0 * np.pi, number)
    s = u * (1.0 - shallowest ** rng.uniform(0.0, 1.0, number))
    s[:20] = 0.0
    x = np.stack([u, s * np.cos(angle), s * np.sin(angle)], axis=1)
    weights = np.stack([10.0 ** rng.uniform(-1.0, 1.0, number), 10.0 ** rng.uniform(-8.0, 1.0, number)], axis=1)
    return x, weights, 1.0 - np.hypot(x[:, 1], x[:, 2]) / u


# The core takes u^2 - s^2 as it stands: a rounding of u^2, so 1 / depth roundings of the difference, and its square twice that.
X, WEIGHTS, DEPTH = rows()


@pytest.mark.parametrize("lanes", LANES)
def test_phi(lanes: int) -> None:
    found = insides.phi(lanes, X, WEIGHTS)
    wanted = np.array([oracle.phi(x.astype(LONG), w[None]) for x, w in zip(X, WEIGHTS, strict=True)])
    assert (np.abs(found[:, 0] / wanted - 1.0) <= EPS * (4.0 + 2.0 / DEPTH)).all()
    slack = (X[:, 0].astype(LONG) - np.hypot(X[:, 1].astype(LONG), X[:, 2].astype(LONG))).astype(float)
    np.testing.assert_allclose(found[:, 1] / X[:, 0], slack / X[:, 0], rtol=0, atol=2.0 * EPS)


@pytest.mark.parametrize("lanes", LANES)
def test_gradient(lanes: int) -> None:
    found = insides.gradient(lanes, X, WEIGHTS)
    wanted = np.array([oracle.gradient(x.astype(LONG), w[None]) for x, w in zip(X, WEIGHTS, strict=True)]).astype(float)
    # 3 omega and the barrier cancel in the first component: rounding of either
    size = 3.0 * WEIGHTS[:, :1] + np.abs(wanted)
    assert (np.abs(found - wanted) <= EPS * (8.0 + 4.0 / DEPTH[:, None]) * size).all()


@pytest.mark.parametrize("lanes", LANES)
def test_axes_of_the_inverse_hessian(lanes: int) -> None:
    """Each to its own last digits but those of u - s: small ones keep theirs beside large ones."""
    found = insides.axes(lanes, X, WEIGHTS)
    for x, w, row, depth in zip(X.astype(LONG), WEIGHTS, found, DEPTH, strict=True):
        error = EPS * (16.0 + 4.0 / depth)
        axes = oracle.axes(x, w[1])
        for made, axis in zip(row[:9].reshape(3, 3), axes, strict=True):
            assert np.abs(made - axis).max() <= error * np.abs(axis).max()
        parts = [oracle.gradient(x, np.array([[omega, lam]])) for omega, lam in ((w[0], 0.0), (0.0, w[1]))]
        # across there is no slope; the price's is a sum of equal signs, the barrier's too
        for made, (part, axis) in zip(row[9:], ((g, a) for g in parts for a in axes[:2]), strict=True):
            assert abs(made - part @ axis) <= error * np.abs(part) @ np.abs(axis)


@pytest.mark.parametrize("lanes", LANES)
def test_value_with_the_gradient_and_curvature(lanes: int) -> None:
    moves = np.random.default_rng(1).standard_normal(X.shape) * X[:, :1]
    found = insides.along(lanes, X, moves, WEIGHTS)
    for x, move, w, depth, (value, bend) in zip(X.astype(LONG), moves, WEIGHTS, DEPTH, found, strict=True):
        assert abs(value / oracle.phi(x, w[None]) - 1.0) <= EPS * (8.0 + 4.0 / depth)
        # three powers of the difference, and terms that cancel where the move is along the surface: rounding of the largest
        hessian = oracle.hessian(x, w[None])
        size = np.abs(hessian).max() * np.abs(move).max() ** 2
        assert abs(bend - move @ hessian @ move) <= EPS * (32.0 + 16.0 / depth) * size


@pytest.mark.parametrize("lanes", LANES)
def test_inverse_hessian(lanes: int) -> None:
    found = insides.inverse_hessian(lanes, X, WEIGHTS).reshape(-1, 3, 3)
    wanted = np.array([oracle.inverse_hessian(x, *w) for x, w in zip(X.astype(LONG), WEIGHTS, strict=True)])
    wanted = wanted.astype(float)
    # no difference in it cancels but d, whose square is small where it does: rounding of the largest entry
    error = np.abs(found - wanted).max(axis=(1, 2)) / np.abs(wanted).max(axis=(1, 2))
    assert error.max() <= 8.0 * EPS
    # away from the surface every eigenvalue has digits left: it is the inverse of the dense Hessian
    for x, w, block, depth in zip(X, WEIGHTS, found, DEPTH, strict=True):
        if depth > 0.01:
            scale = np.sqrt(np.diag(oracle.hessian(x, w[None])))
            unit = oracle.hessian(x, w[None]) / np.outer(scale, scale) @ (block * np.outer(scale, scale))
            np.testing.assert_allclose(unit, np.eye(3), atol=1e-14 / depth**3)
