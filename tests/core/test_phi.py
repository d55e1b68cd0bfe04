"""Formulas of one contact for a number and for registers of 2, 4 and 8: Phi and its derivatives,
the dual bound, the cone's boundary."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import boundary
from oracles import phi as oracle

each_width = pytest.mark.parametrize("lanes", [1, 2, 4, 8])
EPS = 2.0**-52
LONG = np.longdouble


def rows(number: int = 203, shallowest: float = 1e-10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (n, 3) from the axis to close to the surface, 1e-6 to 1e6 N; weights (n, 2) over decades; 1
    - s/u (n,)."""
    rng = np.random.default_rng(number)
    u = 10.0 ** rng.uniform(-6.0, 6.0, number)
    angle = rng.uniform(0.0, 2.0 * np.pi, number)
    s = u * (1.0 - shallowest ** rng.uniform(0.0, 1.0, number))
    s[:20] = 0.0
    x = np.stack([u, s * np.cos(angle), s * np.sin(angle)], axis=1)
    weights = np.stack(
        [10.0 ** rng.uniform(-1.0, 1.0, number), 10.0 ** rng.uniform(-8.0, 1.0, number)], axis=1
    )
    return x, weights, 1.0 - np.hypot(x[:, 1], x[:, 2]) / u


# The core computes u^2 - s^2 as it stands: a rounding of u^2, so 1 / depth roundings of the
# difference, and its square twice that.
X, WEIGHTS, DEPTH = rows()


@each_width
def test_phi_and_its_gradient(lanes):
    found = insides.phi(lanes, X, WEIGHTS)
    slope = insides.gradient(lanes, X, WEIGHTS)
    expected = np.array(
        [oracle.phi(x.astype(LONG), w[None]) for x, w in zip(X, WEIGHTS, strict=True)]
    )
    assert (np.abs(found[:, 0] / expected - 1.0) <= EPS * (4.0 + 2.0 / DEPTH)).all()
    gradient = np.array(
        [oracle.gradient(x.astype(LONG), w[None]) for x, w in zip(X, WEIGHTS, strict=True)]
    )
    # 3 omega and the barrier cancel in the first component: rounding of either
    size = 3.0 * WEIGHTS[:, :1] + np.abs(gradient)
    assert (np.abs(slope - gradient) <= EPS * (8.0 + 4.0 / DEPTH[:, None]) * size).all()


@each_width
def test_curvature_and_inverse_hessian(lanes):
    moves = np.random.default_rng(1).standard_normal(X.shape) * X[:, :1]
    found = insides.along(lanes, X, moves, WEIGHTS)
    inverse = insides.inverse_hessian(lanes, X, WEIGHTS)
    for x, move, w, depth, (value, bend) in zip(
        X.astype(LONG), moves, WEIGHTS, DEPTH, found, strict=True
    ):
        assert abs(value / oracle.phi(x, w[None]) - 1.0) <= EPS * (8.0 + 4.0 / depth)
        hessian = oracle.hessian(x, w[None])
        # three powers of the difference: rounding of the largest
        size = np.abs(hessian).max() * np.abs(move).max() ** 2
        assert abs(bend - move @ hessian @ move) <= EPS * (32.0 + 16.0 / depth) * size
    for x, w, depth, block in zip(X, WEIGHTS, DEPTH, inverse.reshape(-1, 3, 3), strict=True):
        expected = oracle.inverse_hessian(x.astype(LONG), *w)
        assert np.abs(block - expected).max() <= 8.0 * EPS * np.abs(expected).max()
        if depth > 0.01:  # it is the inverse of the dense Hessian
            scale = np.sqrt(np.diag(oracle.hessian(x, w[None])))
            unit = (
                oracle.hessian(x, w[None])
                / np.outer(scale, scale)
                @ (block * np.outer(scale, scale))
            )
            np.testing.assert_allclose(unit, np.eye(3), atol=1e-14 / depth**3)


# --- the dual bound: the least of the Lagrangian of one contact


def pulls(number: int = 1603) -> tuple[np.ndarray, np.ndarray]:
    """y (n, 3) with k = (a - b)/(a + b) from 1 down to 1e-14, and weights (n, 2)."""
    rng = np.random.default_rng(number)
    omega = 10.0 ** rng.uniform(-1.0, 1.0, number)
    lam = 10.0 ** rng.uniform(-8.0, 1.0, number)
    k = 10.0 ** rng.uniform(-14.0, 0.0, number)
    high = 10.0 ** rng.uniform(-3.0, 3.0, number)
    angle = rng.uniform(0, 6.3, number)
    k[:40] = 1.0
    b = 0.5 * high * (1.0 - k)
    y = np.stack(
        [3.0 * omega - 0.5 * high * (1.0 + k), b * np.cos(angle), b * np.sin(angle)], axis=1
    )
    return y, np.stack([omega, lam], axis=1)


Y, WEIGHED = pulls()
LEAST, RATIO = np.array(
    [oracle.least_of_lagrangian(y, *w) for y, w in zip(Y, WEIGHED, strict=True)]
).T
FINITE = np.isfinite(LEAST)
B = np.hypot(Y[:, 1], Y[:, 2])
A = 3.0 * WEIGHED[:, 0] - Y[:, 0]
TERMS = 3.0 * WEIGHED[:, 0] + np.abs(Y[:, 0]) + B
# the core knows a - b to a rounding of its terms, which moves the value by sqrt(k) of its part of a
# + b
ROUNDING = (
    8.0 * EPS * np.maximum(1.0, TERMS / (A + B)) / np.sqrt(np.maximum((A - B) / (A + B), 1e-16))
)


@each_width
def test_dual_is_the_least_of_the_lagrangian(lanes):
    value, room = insides.dual(lanes, Y, WEIGHED).T
    clear = np.abs(A - B) > 4.0 * EPS * TERMS
    assert ((room > 0.0) == FINITE)[clear].all()
    both = FINITE & clear
    assert both.sum() > 1000
    assert (np.abs(value / LEAST - 1.0) <= ROUNDING)[both].all()


def near_forces(rng: np.random.Generator, decades: float) -> np.ndarray:
    """x (n, 3) whose ratio (u - s)/(u + s) misses that of the optimum by up to so many decades, in
    any direction."""
    r = np.minimum(RATIO * 10.0 ** rng.uniform(-decades, decades, len(Y)), 1.0)
    r[~FINITE] = 0.5
    u = 10.0 ** rng.uniform(-3.0, 3.0, len(Y))
    angle = rng.uniform(0.0, 6.3, len(Y))
    s = u * (1.0 - r) / (1.0 + r)
    return np.stack([u, s * np.cos(angle), s * np.sin(angle)], axis=1)


@pytest.mark.parametrize("tight", [1e-2, 1e-3, 3e-4])  # at tolerances 1e-4, 1e-8 and 1e-10
@each_width
def test_dual_near_claims_no_more_than_the_least(lanes, tight):
    rng = np.random.default_rng(lanes)
    claimed = 0
    for decades in (0.0, 0.01, 0.05, 0.2, 1.0, 4.0):
        value, room = insides.dual_near(lanes, Y, WEIGHED, near_forces(rng, decades), tight).T
        good = (room > 0.0) & FINITE
        # a claim where the oracle has none is one of rounding: a - b is zero to its last digit
        assert not ((room > 4.0 * EPS * TERMS) & ~FINITE).any()
        excess = value[good] / LEAST[good] - 1.0
        # the last change is below `tight` r, which leaves 0.19 tight^4 of the value at most; the
        # core subtracts 0.25 tight^4
        assert (excess <= ROUNDING[good]).all()
        assert (excess >= -0.25 * tight**4 - 4.0 * ROUNDING[good]).all()
        assert decades > 0.0 or good.sum() > 0.95 * FINITE.sum()
        claimed += good.sum()
    assert claimed > 2 * FINITE.sum()


@each_width
def test_numbers_without_room_claim_nothing(lanes):
    y = np.array(
        [
            [3.0, 0.0, 0.0],
            [3.1, 0, 0],
            [0, 3.0, 0],
            [np.nan, 0, 0],
            [0, np.nan, 0],
            [-1.0, 1.0, 1.0],
        ]
    )
    w = np.tile([1.0, 0.01], (6, 1))
    x = np.tile([1.0, 0.2, 0.1], (6, 1))
    for found in (insides.dual(lanes, y, w), insides.dual_near(lanes, y, w, x, 1e9)):
        assert ((found[:, 1] > 0.0) == [False] * 5 + [True]).all()
    for bad in (np.nan, np.inf, -1.0, 0.0):
        assert not (insides.dual_near(lanes, y, w, np.full((6, 3), bad), 1e-2)[:, 1] > 0.0).any()


# --- the longest step inside a cone


@pytest.mark.parametrize("shallow", [1.0, 1e-2, 1e-5])
@each_width
def test_steps_end_on_the_surface(lanes, shallow):
    rng = np.random.default_rng(lanes)
    number = 300
    x = rng.standard_normal((number, 3))
    x[:, 0] = np.hypot(x[:, 1], x[:, 2]) * (1.0 + shallow * rng.uniform(0.1, 1.0, number))
    depth = 1.0 - np.hypot(x[:, 1], x[:, 2]) / x[:, 0]
    move = rng.standard_normal((number, 3)) * x[:, :1]
    inward = rng.random(number) < 0.3
    move[inward, 0] = 1.5 * np.hypot(move[inward, 1], move[inward, 2])
    away, along, per = insides.boundary(lanes, x, move).T
    # x . J x keeps 1 - EPS / depth of its digits, and 1 / step is of the order of move / (u depth)
    near = EPS * 40.0 * np.abs(move).max(axis=1) / x[:, 0] / depth**2
    for found, way in ((per, move), (away + along, -move)):
        longest = np.array([boundary.longest_step(p, d) for p, d in zip(x, way, strict=True)])
        ends = longest < np.inf
        assert (np.abs(found[ends] - 1.0 / longest[ends]) <= near[ends]).all()
        assert (found[~ends] <= near[~ends]).all()
        assert ends.sum() > 60
        assert (~ends).sum() > 10
