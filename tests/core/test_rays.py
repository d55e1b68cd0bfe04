"""Where rays enter and leave the cones: exact scans on integers, roots on real numbers."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import boundary as oracle
from oracles.interior_point import scaling

LANES = (1, 2, 4, 8)
EPS = 2.0**-52
GRID = np.arange(0, 64 * 64) / 64.0  # dyadic: with small integers the scan has no rounding at all
integers = st.integers(-3, 3)


@settings(max_examples=800, deadline=None, derandomize=True)
@given(st.tuples(integers, integers, integers), st.tuples(integers, integers, integers))
def test_interval_against_an_exact_scan(point: tuple, ray: tuple) -> None:
    """Integers hit every degenerate case: zero rays and points, those on the cone, through the apex, along the surface."""
    p, d = np.array(point, float), np.array(ray, float)
    low, high = insides.inside(p, d)
    u, o, t = (p + GRID[:, None] * d).T
    scan = (u > 0.0) & (u * u > o * o + t * t)
    # roots of quadratics with integer coefficients: grid points at them are left out
    clear = (np.abs(GRID - low) > 1e-9 * (1 + GRID)) & (np.abs(GRID - high) > 1e-9 * (1 + GRID))
    assert (((low < GRID) & (high > GRID)) == scan)[clear].all()
    if scan.any():
        assert low < high


def test_rays_through_the_apex() -> None:
    """The discriminant is zero there and rounds to either side."""
    rng = np.random.default_rng(0)
    for _ in range(500):
        x, factor = np.array([1.0, *rng.uniform(-0.6, 0.6, 2)]), rng.uniform(0.1, 3.0)
        low, high = insides.inside(-factor * x, x)
        assert low == pytest.approx(factor, rel=1e-6)  # a double root: half the digits
        assert high == np.inf
        low, high = insides.inside(factor * x, -x)
        assert (low, high) == (0.0, pytest.approx(factor, rel=1e-6))
    for bad in np.where(np.eye(3) > 0.0, np.nan, [0.3, 0.2, 0.1]):
        for low, high in (insides.inside(bad, np.ones(3)), insides.inside(np.array([2.0, 0.5, 0.1]), bad)):
            assert not low < high


def moves(rng: np.random.Generator, number: int, shallow: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points strictly inside (n, 3), their relative depth, and moves of about their size."""
    u, angle = 10.0 ** rng.uniform(-4, 4, number), rng.uniform(0, 6.3, number)
    s = u * (1.0 - shallow * rng.uniform(0.5, 1.0, number))
    x = np.stack([u, s * np.cos(angle), s * np.sin(angle)], axis=1)
    move = rng.standard_normal((number, 3)) * u[:, None]
    into = rng.random(number) < 0.3
    move[into, 0] = 1.5 * np.hypot(move[into, 1], move[into, 2])
    return x, 1.0 - np.hypot(x[:, 1], x[:, 2]) / u, move


@pytest.mark.parametrize("shallow", [1.0, 1e-2, 1e-5, 1e-9])
@pytest.mark.parametrize("lanes", LANES)
def test_steps_end_on_the_surface(lanes: int, shallow: float) -> None:
    x, depth, move = moves(np.random.default_rng(lanes), 500, shallow)
    away, along, per = insides.boundary(lanes, x, move).T
    longest = np.array([oracle.longest_step(p, d) for p, d in zip(x, move, strict=True)])
    # x . J x keeps 1 - EPS / depth of its digits, and 1 / step is of the order of move / (u depth)
    near = EPS * 40.0 * np.abs(move).max(axis=1) / x[:, 0] / depth**2
    ends = longest < np.inf
    assert ends.sum() > 100
    assert (np.abs(per[ends] - 1.0 / longest[ends]) <= near[ends]).all()
    assert (per[~ends] <= near[~ends]).all()
    assert (~ends).sum() > 50
    # and what is said about the way back
    back = np.array([oracle.longest_step(p, -d) for p, d in zip(x, move, strict=True)])
    assert (np.abs((away + along) - 1.0 / back) <= near)[back < np.inf].all()
    assert (away + along <= near)[back == np.inf].all()
    if shallow == 1.0:  # it ends on the surface itself, to rounding
        ends = per > 1e-6
        end = x[ends] + move[ends] / per[ends, None]
        size = np.abs(x[ends]).max(axis=1) + np.abs(move[ends]).max(axis=1) / per[ends]
        assert (np.abs(end[:, 0] - np.hypot(end[:, 1], end[:, 2])) <= 1e-12 * size).all()


def inside(rng: np.random.Generator, number: int) -> np.ndarray:
    """(n, 3) over decades, down to 1e-4 from the surface."""
    x = rng.standard_normal((number, 3))
    x[:, 0] = np.hypot(x[:, 1], x[:, 2]) + 10.0 ** rng.uniform(-4.0, 0.0, number)
    return x * 10.0 ** rng.uniform(-3.0, 3.0, (number, 1))


@pytest.mark.parametrize("lanes", LANES)
def test_the_scaling_is_nesterov_and_todds(lanes: int) -> None:
    rng, j = np.random.default_rng(lanes), np.array([1.0, -1.0, -1.0])
    x, s, d = inside(rng, 203), inside(rng, 203), rng.standard_normal((203, 3))
    for p, q, e, row in zip(x, s, d, insides.scaling(lanes, x, s, d), strict=True):
        v, eta, shrink, root, scaled, twice = row[:3], *row[3:6], row[6:9], row[9:]
        w = scaling(p, q)
        # x . J x and s . J s keep 1 - EPS / depth of their digits, W^2 the square of what is lost
        lost = 1e-15 * max(p[0] ** 2 / (p @ (j * p)), q[0] ** 2 / (q @ (j * q)))
        assert eta == pytest.approx(np.sqrt((p @ (j * p)) / (q @ (j * q))), rel=lost)
        assert v @ (j * v) == pytest.approx(1.0, rel=10.0 * lost * v[0] ** 2)
        assert shrink == pytest.approx(1.0 / (1.0 + v[0]), rel=1e-14)
        assert root == pytest.approx((q @ (j * q)) ** -0.5, rel=lost)
        size = np.abs(w).max() * np.abs(e).max()
        np.testing.assert_allclose(np.sqrt(eta) * scaled, w @ e, rtol=0, atol=100.0 * lost * size)
        np.testing.assert_allclose(twice, w @ w @ e, rtol=0, atol=100.0 * lost * size * np.abs(w).max())
        # what it is for: it takes s to x
        both = insides.scaling(lanes, p[None], q[None], q[None])[0]
        np.testing.assert_allclose(both[9:], p, rtol=0, atol=100.0 * lost * np.abs(w).max() ** 2 * q[0])
