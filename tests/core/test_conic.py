"""The least sum of normal forces: the scaling, one to four iterations against the dense oracle, certificates in every layout."""

from __future__ import annotations

from itertools import pairwise

import _core_test as insides
import numpy as np
import pytest
from oracles import conic as oracle
from oracles.interior_point import per_boundary, scaling
from samples import COUNTS, LAYOUTS, Sample, layouts, sample, wrenches

from grasp_env.force.record import FORCE

CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED = range(5)
CODE, ITERATIONS, TRIALS, OBJECTIVE, BOUND, RESIDUAL, MARGIN = range(7)
J = np.array([1.0, -1.0, -1.0])


def solver(s: Sample, layout: tuple[int, int], tolerance: float = 1e-6, limit: int = 60):
    return insides.AnyConic.make(*layout, s.placement, tolerance, limit, s.rest)


def inside(rng: np.random.Generator, number: int) -> np.ndarray:
    x = rng.standard_normal((number, 3))
    x[:, 0] = np.hypot(x[:, 1], x[:, 2]) + 10.0 ** rng.uniform(-4.0, 0.0, number)
    return x * 10.0 ** rng.uniform(-3.0, 3.0, (number, 1))


@pytest.mark.parametrize("lanes", [1, 2, 4, 8])
def test_the_scaling_is_nesterov_and_todds(lanes: int) -> None:
    rng = np.random.default_rng(lanes)
    x, s, d = inside(rng, 203), inside(rng, 203), rng.standard_normal((203, 3))
    found = insides.scaling(lanes, x, s, d)
    for p, q, e, row in zip(x, s, d, found, strict=True):
        v, eta, shrink, root, scaled, twice = row[:3], *row[3:6], row[6:9], row[9:]
        w = scaling(p, q)
        # x . J x and s . J s keep 1 - EPS / depth of their digits, W^2 the square of what is lost
        lost = 1e-15 * max(p[0] ** 2 / (p @ (J * p)), q[0] ** 2 / (q @ (J * q)))
        assert eta == pytest.approx(np.sqrt((p @ (J * p)) / (q @ (J * q))), rel=lost)
        assert v @ (J * v) == pytest.approx(1.0, rel=10.0 * lost * v[0] ** 2)
        assert (shrink, root) == (
            pytest.approx(1.0 / (1.0 + v[0]), rel=1e-14),
            pytest.approx((q @ (J * q)) ** -0.5, rel=lost),
        )
        size = np.abs(w).max() * np.abs(e).max()
        np.testing.assert_allclose(np.sqrt(eta) * scaled, w @ e, rtol=0, atol=100.0 * lost * size)
        np.testing.assert_allclose(twice, w @ w @ e, rtol=0, atol=100.0 * lost * size * np.abs(w).max())
        # what it is for: it takes s to x
        both = insides.scaling(lanes, p[None], q[None], q[None])[0]
        np.testing.assert_allclose(both[9:], p, rtol=0, atol=100.0 * lost * np.abs(w).max() ** 2 * q[0])


def test_the_oracles_boundary_is_where_steps_end() -> None:
    rng, bounded = np.random.default_rng(0), 0
    for x, d in zip(inside(rng, 60), rng.standard_normal((60, 3)), strict=True):
        inverse = per_boundary(x, d)
        assert inverse == pytest.approx(max(0.0, insides.boundary(1, x[None], d[None])[0, 2]), rel=1e-6, abs=1e-9)
        end = x + d / inverse if inverse > 0.0 else x
        bounded += inverse > 0.0
        assert end[0] - np.hypot(end[1], end[2]) >= -1e-6 * np.abs(end).max()
    assert 20 < bounded < 60


@pytest.mark.parametrize(
    ("count", "kind"), [*((n, "hard") for n in (3, 4, 5, 8, 9)), (8, "frictionless"), (5, "frictionless"), (6, "thin")]
)
def test_iterations_are_the_oracles(count: int, kind: str) -> None:
    s = sample(count, kind)
    for load in wrenches(np.random.default_rng(count), 2, 3.0):
        unit = s.unit @ load
        size = float(np.abs(unit).max())
        for layout in layouts(count):
            program = oracle.of_grasp(s.rows, unit / size, s.divisor)
            at = oracle.start(program, s.inverse, s.rest)
            first, seen = size * at.x[: 3 * count] / s.divisor.reshape(-1), []
            for k in range(1, 5):
                at = oracle.iteration(program, at)
                row = solver(s, layout, 1e-15, k).solve(load)
                assert (row[CODE], row[ITERATIONS]) == (LIMIT, k)
                force, start = row[FORCE : FORCE + 6 * count].reshape(2, -1)
                wanted = size * at.x[: 3 * count] / s.divisor.reshape(-1)
                near = 1e-8 * np.abs(force).max()
                np.testing.assert_allclose(start, first, rtol=0, atol=1e-9 * np.abs(first).max())
                np.testing.assert_allclose(force, wanted, rtol=0, atol=near)
                # y of the record is scaled onto the boundary of its set
                bound, nu = oracle.certified_bound(program, at.y)
                nu = s.unit.T @ nu
                np.testing.assert_allclose(row[14:20], nu, rtol=0, atol=1e-7 * np.abs(nu).max())
                assert row[BOUND] == pytest.approx(size * bound, rel=1e-7, abs=near)
                seen.append(force)
            # every iteration moved: equal iterates would prove nothing
            assert all(np.abs(b - a).max() > 1e-6 * np.abs(b).max() for a, b in pairwise(seen))


def certified(s: Sample, load: np.ndarray, row: np.ndarray, tolerance: float) -> None:
    """A converged record, everything computed anew: balanced, inside, and with a bound that weak duality proves."""
    force, w = row[FORCE : FORCE + 3 * s.count].reshape(-1, 3), s.unit @ load
    x = (force * s.scale).reshape(-1)
    assert row[CODE] == CONVERGED
    assert row[OBJECTIVE] == pytest.approx(force[:, 0].sum(), rel=1e-12)
    assert np.abs(s.rows @ x + w).max() <= 1e-13 * s.count * (np.abs(x).max() + np.abs(w).max())
    slack = x[0::3] - np.hypot(x[1::3], x[2::3])
    assert row[MARGIN] == pytest.approx(slack.min(), abs=1e-15 * np.abs(x).max())
    assert row[MARGIN] >= 0.0
    pull = (s.cone_matrix.T @ row[14:20]).reshape(-1, 3)
    cost = 1.0 / s.divisor[:, 0]
    # feasible to rounding: sum c u - nu . (G x + w) is at least -nu . w for every x in the cones
    assert ((pull[:, 0] + np.hypot(pull[:, 1], pull[:, 2])) / cost).max() <= 1.0 + 1e-9
    assert row[BOUND] == pytest.approx(max(0.0, -row[14:20] @ load), rel=1e-9)
    assert row[BOUND] <= row[OBJECTIVE] <= row[BOUND] * (1.0 + tolerance * (1.0 + 1e-9))


@pytest.mark.parametrize("kind", ["hard", "frictionless", "thin"])
@pytest.mark.parametrize("count", COUNTS)
def test_every_layout_certifies_the_same_least_force(count: int, kind: str) -> None:
    if (count, kind) == (3, "thin"):  # three contacts nearly on a line have hardly any internal force
        kind = "hard"
    s, rng = sample(count, kind), np.random.default_rng(count)
    for size in (1e-6, 1.0, 1e4):
        load = wrenches(rng, 1, size)[0]
        rows = [solver(s, layout).solve(load) for layout in layouts(count)]
        for row in rows:
            certified(s, load, row, 1e-6)
            for other in rows:
                assert row[BOUND] <= other[OBJECTIVE] * (1.0 + 1e-12)


@pytest.mark.parametrize("count", [3, 5, 8])
def test_the_optimum_of_phi_is_no_less(count: int) -> None:
    """Two solvers, one truth: no force of the other objective has a smaller sum of normal forces than this bound."""
    s = sample(count)
    for load in wrenches(np.random.default_rng(count), 3):
        row = solver(s, (1, 0), 1e-8).solve(load)
        least = min(
            (
                Sample(s.positions, s.normals, s.scale, s.weights * [1.0, lam]).minimum(load)[0][0::3] / s.divisor[:, 0]
            ).sum()
            for lam in (1.0, 1e-2)
        )
        assert row[BOUND] <= least
        assert row[OBJECTIVE] <= least * (1.0 + 1e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_repeats_and_copies(layout: tuple[int, int]) -> None:
    s = sample(4)
    a, b = wrenches(np.random.default_rng(3), 2)
    made = solver(s, layout)
    copy, wanted = made.clone(), made.solve(a)
    for other in (b, 1e6 * b, 0.0 * b, b * np.nan):
        made.solve(other)
        np.testing.assert_array_equal(made.solve(a), wanted)
    np.testing.assert_array_equal(copy.solve(a), wanted)
    del made
    np.testing.assert_array_equal(copy.solve(a), wanted)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_wrench_and_wrenches_that_are_none(layout: tuple[int, int]) -> None:
    s = sample(4)
    made = solver(s, layout)
    for nothing in (np.zeros(6), np.full(6, 1e-310), -np.full(6, 1e-309)):
        row = made.solve(nothing)
        assert row[CODE] == CONVERGED
        assert not row[FORCE:].any()
    tiny = np.full(6, 1e-140)  # below that the squares in a slack have no digits
    certified(s, tiny, made.solve(tiny), 1e-6)
    for k in range(6):
        for bad in (np.nan, np.inf, -np.inf, 1e13):
            row = made.solve(np.where(np.arange(6) == k, bad, 1.0))
            assert row[CODE] == REFUSED
            assert not row[FORCE:].any()


@pytest.mark.parametrize("bad", [np.nan, -1.0])
def test_an_interior_that_is_none_is_refused(bad: float) -> None:
    s = sample(4)
    row = insides.AnyConic.make(1, 0, s.placement, 1e-6, 60, s.rest * bad).solve(np.ones(6))
    assert row[CODE] == REFUSED
