"""Newton in every layout of the registers: the optimum of the dense oracle, certified, whatever the number of contacts."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import newton as oracle
from oracles.phi import lower_bound, phi
from samples import COUNTS, LAYOUTS, Sample, layouts, sample, wrenches

from grasp_env.force.record import FORCE

CONVERGED, LIMIT, STALLED, INFEASIBLE, REFUSED = range(5)
CODE, ITERATIONS, TRIALS, OBJECTIVE, BOUND, RESIDUAL, MARGIN = range(7)
SIZES = (1e-3, 1.0, 30.0)


def solver(s: Sample, layout: tuple[int, int], tolerance: float = 1e-8, limit: int = 500):
    made = insides.AnyNewton.make(*layout, s.placement, tolerance, limit)
    made.set_basis(s.basis if s.count <= 9 else core_basis(s))
    return made


def core_basis(s: Sample) -> np.ndarray:
    """(13, 3N) by the core: dense Newton on many contacts is slow."""
    return insides.AnyNewton.make(1, 0, s.placement, 1e-4, 500).make_basis()[1]


def check(s: Sample, wrench: np.ndarray, row: np.ndarray, tolerance: float) -> np.ndarray:
    """A certified record: returns its cone coordinates. Everything in it is computed anew."""
    x = (row[FORCE : FORCE + 3 * s.count].reshape(-1, 3) * s.scale).reshape(-1)
    w = s.unit @ wrench
    assert row[CODE] == CONVERGED
    assert row[MARGIN] > 0.0
    value = phi(x, s.weights)
    assert row[OBJECTIVE] == pytest.approx(value, rel=1e-9)  # of the last iterate, before its balance was restored
    assert 0.0 < row[BOUND] <= value * (1.0 + 1e-11)
    assert value - row[BOUND] <= tolerance * row[BOUND] * (1.0 + 1e-6)
    left = np.abs(s.rows @ x + w).max()
    rounding = 1e-14 * s.count * (np.abs(x).max() + np.abs(w).max())
    assert left <= 1e-13 * s.count * (np.abs(x).max() + np.abs(w).max())
    assert row[RESIDUAL] == pytest.approx(left, abs=rounding)
    np.testing.assert_array_equal(row[8:14], wrench)
    return x


@pytest.mark.parametrize("kind", ["hard", "frictionless"])
@pytest.mark.parametrize("count", COUNTS)
def test_every_layout_finds_the_optimum_of_the_oracle(count: int, kind: str) -> None:
    s, rng = sample(count, kind), np.random.default_rng(count)
    solvers = {layout: solver(s, layout, 1e-10) for layout in layouts(count)}
    for size in SIZES if count < 50 else SIZES[1:2]:
        for wrench in wrenches(rng, 1 if count > 5 else 3, size):
            best, _ = s.minimum(wrench)
            least = phi(best, s.weights)
            for made in solvers.values():
                x = check(s, wrench, row := made.solve(wrench), 1e-10)
                # the last bound may come from dual_near, 2e-5 of the tolerance above the least
                assert row[BOUND] <= least * (1.0 + 1e-12)
                assert least * (1.0 - 1e-12) <= row[OBJECTIVE] <= least * (1.0 + 1.1e-10)
                # Phi is flat: a gap of 1e-10 is a distance of its root over the least curvature
                np.testing.assert_allclose(x, best, rtol=0, atol=3e-4 * np.abs(best).max())
                nu = row[14:20]
                assert lower_bound(nu, s.cone_matrix, wrench, s.weights) == pytest.approx(least, rel=1e-6)


@pytest.mark.parametrize("count", [3, 4, 5, 8, 9, 16])
def test_layouts_take_the_same_steps(count: int) -> None:
    """To rounding, iterate by iterate: only the order of sums differs, and lanes without a contact have no say."""
    s = sample(count)
    for limit in (1, 2, 3, 4):
        for wrench in wrenches(np.random.default_rng(count), 3, 5.0):
            rows = [solver(s, layout, 1e-12, limit).solve(wrench) for layout in layouts(count)]
            for row in rows[1:]:
                np.testing.assert_array_equal(row[:3], rows[0][:3])
                np.testing.assert_allclose(
                    row[FORCE:], rows[0][FORCE:], rtol=0, atol=1e-9 * np.abs(rows[0][FORCE:]).max()
                )
            assert rows[0][ITERATIONS] == limit


@pytest.mark.parametrize(
    ("layout", "count"), [((1, 0), 4), ((4, 1), 4), ((8, 0), 8), ((4, 1), 3), ((8, 1), 5), ((8, 0), 9)]
)
def test_answers_do_not_depend_on_earlier_calls(layout: tuple[int, int], count: int) -> None:
    """Bit by bit, whatever the last call has left in the lanes that hold no contact."""
    s = sample(count)
    w, other = wrenches(np.random.default_rng(1), 2)
    start = oracle.combine(s.basis, w) / s.divisor.reshape(-1)
    made, again = solver(s, layout, 1e-8, 3), solver(s, layout, 1e-8, 3)
    for first in (
        lambda n: n.solve(w),
        lambda n: n.descend(w, start, np.nan, 0)[0],
        lambda n: n.follow(w, start, True),
    ):
        wanted = first(made)
        for heavy in (1e-3, 1.0, 1e3):
            again.solve(heavy * other)
            np.testing.assert_array_equal(first(again), wanted)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_copies_are_independent(layout: tuple[int, int]) -> None:
    s, other = sample(4), sample(4, "frictionless")
    w = wrenches(np.random.default_rng(2), 1)[0]
    made = solver(s, layout)
    copy, wanted = made.clone(), made.solve(w)
    np.testing.assert_array_equal(copy.solve(w), wanted)
    made.set_basis(other.basis)
    made.solve(50.0 * w)
    np.testing.assert_array_equal(copy.solve(w), wanted)
    del made
    np.testing.assert_array_equal(copy.solve(w), wanted)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", ["hard", "frictionless"])
def test_the_basis_is_that_of_the_oracle(layout: tuple[int, int], kind: str) -> None:
    s = sample(4, kind)
    made = insides.AnyNewton.make(*layout, s.placement, 1e-4, 500)
    gap, basis = made.make_basis()
    assert 0.0 <= gap <= 1e-9
    for k, wanted in enumerate(s.basis):
        assert phi(basis[k], s.weights) == pytest.approx(phi(wanted, s.weights), rel=1e-9)
        np.testing.assert_allclose(basis[k], wanted, rtol=0, atol=1e-3 * np.abs(wanted).max())
        load = [*np.eye(6), *-np.eye(6), np.zeros(6)][k]
        left = s.rows @ basis[k] + s.unit @ load
        assert np.abs(left).max() <= 1e-13 * s.count * (np.abs(basis[k]).max() + np.abs(s.unit @ load).max())
    load = np.full(6, 0.1)
    check(s, load, made.solve(load), 1e-4)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", ["hard", "frictionless"])
def test_the_step_is_the_dense_kkt_step(layout: tuple[int, int], kind: str) -> None:
    s, rng = sample(4, kind), np.random.default_rng(3)
    made = solver(s, layout)
    for wrench in wrenches(rng, 10):
        x = oracle.combine(s.basis, wrench) * rng.uniform(0.8, 1.2)
        decrement, step, nu = made.newton_step(wrench, x)
        dense, multipliers, squared = oracle.newton_step(x, s.rows, s.unit @ wrench, s.weights)
        np.testing.assert_allclose(step, dense, rtol=0, atol=1e-8 * np.abs(dense).max())
        np.testing.assert_allclose(nu, s.unit.T @ multipliers, rtol=0, atol=1e-8 * np.abs(s.unit.T @ multipliers).max())
        assert decrement == pytest.approx(squared, rel=1e-6, abs=1e-8 * np.abs(dense).max())


@pytest.mark.parametrize("layout", [(1, 0), (8, 1)])
@pytest.mark.parametrize("count", [3, 4, 7, 8])
def test_internal_forces_are_balanced_and_inside(layout: tuple[int, int], count: int) -> None:
    for kind in ("hard", "frictionless"):
        s = sample(count, kind)
        found, x = insides.AnyNewton.make(*layout, s.placement, 1e-4, 9).internal_force()
        assert found
        assert phi(x, s.weights) < np.inf
        assert np.abs(s.rows @ x).max() <= 1e-13 * count * np.abs(x).max()
    # fingers that all push the same way have none
    push = Sample(s.positions, np.tile([0.0, 0.6, 0.8], (count, 1)), s.scale * 0.0 + [0.3, 1.0, 1.0], s.weights)
    assert push.placement.verdict == 0
    assert not insides.AnyNewton.make(*layout, push.placement, 1e-4, 9).internal_force()[0]


@pytest.mark.parametrize("barrier", [1e-4, 1e-2, 1.0, 1e3])
@pytest.mark.parametrize("count", [3, 5, 8])
def test_small_and_large_forces_and_barriers(count: int, barrier: float) -> None:
    base = sample(count)
    s = Sample(base.positions, base.normals, base.scale, base.weights * [1.0, 100.0 * barrier])
    made = insides.AnyNewton.make(8, 0, s.placement, 1e-6, 2000)
    assert made.make_basis()[0] < 1e-2
    for size in 10.0 ** np.arange(-9.0, 7.0):
        wrench = wrenches(np.random.default_rng(count), 1, size)[0]
        row = made.solve(wrench)
        assert row[CODE] in (CONVERGED, STALLED)
        assert row[MARGIN] > 0.0
        assert row[BOUND] <= row[OBJECTIVE] * (1.0 + 1e-9)
        w = s.unit @ wrench
        x = (row[FORCE : FORCE + 3 * count].reshape(-1, 3) * s.scale).reshape(-1)
        assert np.abs(s.rows @ x + w).max() <= 1e-11 * count * (np.abs(x).max() + np.abs(w).max())
        # a force misses its cone by about sqrt(lambda) less than it is: beyond 1e-4 of it 1e-6 of Phi asks for more digits than there are
        assert row[CODE] == CONVERGED or size > 0.99e4 * np.sqrt(barrier)


@pytest.mark.parametrize("layout", [(1, 0), (8, 1)])
def test_a_known_optimum_and_the_trace(layout: tuple[int, int]) -> None:
    s = sample(5)
    w = wrenches(np.random.default_rng(7), 1, 10.0)[0]
    least = phi(s.minimum(w)[0], s.weights)
    start = oracle.combine(s.basis, w)
    row, trace = solver(s, layout, 1e-6).descend(w, start / s.divisor.reshape(-1), least, 50)
    steps = int(row[ITERATIONS])
    assert row[CODE] == CONVERGED
    assert row[BOUND] == least
    assert trace[0] == pytest.approx(phi(start, s.weights), rel=1e-13)
    assert trace[steps] == row[OBJECTIVE]
    assert (np.diff(trace[: steps + 1]) < 0.0).all()
    assert (trace[steps + 1 :] == -1.0).all()
    np.testing.assert_allclose(row[FORCE + 15 : FORCE + 30], start / s.divisor.reshape(-1), rtol=1e-15)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_is_no_start_is_refused(layout: tuple[int, int]) -> None:
    s = sample(4)
    made = solver(s, layout)
    w = wrenches(np.random.default_rng(8), 1)[0]
    good = oracle.combine(s.basis, w) / s.divisor.reshape(-1)
    assert made.descend(w, good, np.nan, 0)[0][CODE] == CONVERGED
    unbalanced = good.copy()
    unbalanced[0] += 1e-5 * np.abs(good).max()
    for bad in (np.full(12, np.nan), np.full(12, np.inf), -good, np.zeros(12), 1e13 * good, unbalanced):
        assert made.descend(w, bad, np.nan, 0)[0][CODE] == REFUSED
    for k in range(6):
        for number in (np.nan, np.inf, -np.inf, 1e13):
            wrong = np.where(np.arange(6) == k, number, w)
            for row in (made.solve(wrong), made.follow(wrong, good, True), made.descend(wrong, good, np.nan, 0)[0]):
                assert row[CODE] == REFUSED
    # a previous force that is none costs nothing but its use
    for bad in (np.full(12, np.nan), np.full(12, np.inf), -good, np.zeros(12)):
        for tangent in (True, False):
            check(s, w, made.follow(w, bad, tangent), 1e-8)
    assert insides.AnyNewton.make(*layout, s.placement, 1e-8, 9).solve(w)[CODE] == REFUSED  # no basis


def test_a_basis_of_nan_is_refused() -> None:
    s = sample(4)
    made = solver(s, (1, 0))
    made.set_basis(np.full((13, 12), np.nan))
    assert made.solve(np.ones(6))[CODE] == REFUSED


def test_a_basis_that_misses_balance_is_never_certified_outside_the_cones() -> None:
    s, rng = sample(5), np.random.default_rng(0)
    made = insides.AnyNewton.make(1, 0, s.placement, 1e-4, 500)
    made.set_basis(s.basis * (1.0 + rng.standard_normal((13, 1))))
    rows = [made.solve(wrench) for wrench in wrenches(rng, 200, 3.0)]
    assert all(
        row[MARGIN] > 0.0 and row[OBJECTIVE] >= row[BOUND] * (1.0 - 1e-9) for row in rows if row[CODE] == CONVERGED
    )


def test_the_basis_of_a_small_barrier() -> None:
    """Found with the shorter reach to the boundary alone: a descent that stalls tries the other."""
    base = sample(4)
    s = Sample(base.positions, base.normals, base.scale, np.column_stack([base.weights[:, 0], np.full(4, 1e-5)]))
    assert insides.AnyNewton.make(1, 0, s.placement, 1e-4, 500).make_basis()[0] < 1e-2
