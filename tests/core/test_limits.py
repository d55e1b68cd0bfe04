"""Newton within limits: against the dense oracle in every layout, proofs, the least excess, starts, allocations, wrong numbers."""

from __future__ import annotations

from dataclasses import dataclass

import _core_test as insides
import numpy as np
import pytest
from oracles import limits as oracle
from samples import COUNTS, Sample, layouts, sample, wrenches
from scipy.optimize import linprog

from grasp_env.core import _core

CODES = _core.codes()
CONVERGED, INFEASIBLE, REFUSED, EXCEEDED = (
    CODES[name] for name in ("converged", "infeasible", "refused", "limits_exceeded")
)
FIELDS = _core.record_fields()
FACETS = 64


@dataclass(frozen=True)
class Limited:
    """Rows on the contacts of a sample: a . x_i <= b.

    Attributes:
        rows: (M, 7) a, b, share, lambda, contact.
    """

    contacts: Sample
    rows: np.ndarray

    @property
    def dense(self) -> np.ndarray:
        """(M, 3N)."""
        out = np.zeros((len(self.rows), 3 * self.contacts.count))
        for row, line in zip(self.rows, out, strict=True):
            line[3 * int(row[6]) : 3 * int(row[6]) + 3] = row[:3]
        return out

    def solver(self, layout: tuple[int, int], tolerance: float = 1e-9, *, elastic: bool = False):
        s = self.contacts
        return insides.AnyLimited.make(*layout, s.placement, tolerance, 300, self.rows, s.basis, elastic)

    def excess(self, x: np.ndarray) -> float:
        return float(((self.dense @ x - self.rows[:, 3]) / self.rows[:, 4]).max(initial=0.0))

    def value(self, x: np.ndarray) -> float:
        s = self.contacts
        return float(oracle.limited_phi(x, s.weights, self.dense, self.rows[:, 3], self.rows[:, 5]))

    def pyramids(self, *, inside: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """A x <= b around cones and limits: what holds for these holds for them. inside: pyramids in the cones, 0.12 % narrower."""
        angles = 2.0 * np.pi * np.arange(FACETS) / FACETS
        width = np.cos(np.pi / FACETS) if inside else 1.0
        facets = np.column_stack([-width * np.ones(FACETS), np.cos(angles), np.sin(angles)])
        cones = np.kron(np.eye(self.contacts.count), facets)
        return np.vstack([cones, self.dense]), np.concatenate([np.zeros(len(cones)), self.rows[:, 3]])


def limited(s: Sample, seed: int, tight: float, *, full: bool = False, free: int = 0) -> Limited:
    """Zero to five pairs of rows a contact, some with one side, and one that no force changes. full: three or four pairs, so that no force
    is without bound, and proofs are the core's. free: contacts that no row bounds, as of a palm or a table.
    """
    rng = np.random.default_rng([seed, s.count])
    rows: list[np.ndarray] = []
    for i in range(free, s.count):
        for _ in range(int(rng.choice([3, 4] if full else [0, 1, 2, 3, 3, 3, 4, 5]))):
            a = rng.standard_normal(3)
            a /= np.linalg.norm(a)
            limit, bias = tight * rng.uniform(0.5, 2.0), 0.2 * tight * rng.uniform(-1.0, 1.0)
            sides = (1.0, -1.0) if full or rng.random() < 0.8 else (1.0,)
            for sign in sides:
                rows.append(np.array([*(sign * a), limit - sign * bias, limit, s.weights[i, 1], i]))
    rows.append(np.array([0.0, 0.0, 0.0, 0.3, 1.0, 0.01, 0]))
    return Limited(s, np.array(rows))


def force(row: np.ndarray, s: Sample) -> np.ndarray:
    """x of a record, cone coordinates."""
    return row[FIELDS["force"] :][: 3 * s.count] * s.scale.reshape(-1)


@pytest.mark.parametrize("count", COUNTS)
def test_the_optimum_is_the_oracles(count: int) -> None:
    s, found = sample(count), 0
    for k, load in enumerate(wrenches(np.random.default_rng(count), 4 if count < 20 else 1, 0.7)):
        problem = limited(s, k, 6.0)
        dense, bound, weight = problem.dense, problem.rows[:, 3], problem.rows[:, 5]
        want = oracle.minimum(s.minimum(load)[0], s.rows, s.weights, dense, bound, weight)
        if want is None or (bound - dense @ want).min() < 1e-3:
            continue
        found += 1
        least = problem.value(want)
        for layout in layouts(count):
            row = problem.solver(layout).solve(load)
            x = force(row, s)
            assert row[FIELDS["code"]] == CONVERGED
            # both know the least to rounding; the core to 1e-9
            assert row[FIELDS["objective"]] == pytest.approx(least, rel=1.1e-9)
            assert problem.value(x) == pytest.approx(row[FIELDS["objective"]], rel=1e-11)
            assert row[FIELDS["lower_bound"]] <= least * (1.0 + 1e-13)
            assert (dense @ x < bound).all()
            assert row[FIELDS["limit_excess"]] == 0.0
            assert np.abs(s.rows @ x + s.unit @ load).max() < 1e-12 * np.abs(x).max()
            # from there, and from another wrench's optimum
            near = problem.solver(layout).solve(1.02 * load)
            for start in (row, near):
                after = problem.solver(layout).follow(load, start[FIELDS["force"] :][: 3 * count])
                assert after[FIELDS["code"]] == CONVERGED
                assert after[FIELDS["objective"]] == pytest.approx(least, rel=1.1e-9)
            given = problem.solver(layout).descend(load, s.minimum(load)[0] / s.divisor.reshape(-1))
            assert given[FIELDS["objective"]] == pytest.approx(least, rel=1.1e-9)
    assert found >= 1


FREE = [(3, 0), (4, 0), (6, 0), (9, 0), (3, 1), (4, 1), (6, 1), (9, 1)]


@pytest.mark.parametrize(("count", "free"), FREE)
def test_infeasible_is_proven(count: int, free: int) -> None:
    """v . w exceeds what any force within pyramids around the cones, and within the limits, makes of -v . G f."""
    s, proofs = sample(count), 0
    for k, load in enumerate(wrenches(np.random.default_rng(100 + count), 12, 2.0)):
        problem = limited(s, k, 1.0, full=True, free=free)
        row = problem.solver((1, 0)).solve(load)
        facets, bound = problem.pyramids(inside=free > 0)  # a proof touches the cone of a contact without bound
        if row[FIELDS["code"]] == CONVERGED:
            assert (facets[-len(problem.rows) :] @ force(row, s) <= bound[-len(problem.rows) :]).all()
        if row[FIELDS["code"]] != INFEASIBLE:
            continue
        twist = row[FIELDS["multipliers"] :][:6]
        assert np.abs(twist).max() == pytest.approx(1.0)
        pull = s.cone_matrix.T @ twist
        least = linprog(pull, A_ub=facets, b_ub=bound, bounds=(None, None), method="highs")
        if least.status == 3:  # pyramids of 64 facets are open where the cones are not: no verdict of theirs
            continue
        assert least.status == 2 or twist @ load + least.fun > -2e-3 * abs(twist @ load)
        proofs += least.status == 2 or twist @ load + least.fun > 0.0
        np.testing.assert_array_equal(row[FIELDS["force"] :], 0.0)
        for layout in layouts(count):
            assert problem.solver(layout).solve(load)[FIELDS["code"]] == INFEASIBLE
    assert proofs >= 3


@pytest.mark.parametrize(("count", "free"), FREE)
def test_the_least_excess(count: int, free: int) -> None:
    """Within a hundredth of the least: below it pyramids inside the cones know a force, above it those around them do not."""
    s, exceeded = sample(count), 0
    for k, load in enumerate(wrenches(np.random.default_rng(100 + count), 12, 2.0)):
        problem = limited(s, k, 1.0, full=True, free=free)
        plain = problem.solver((1, 0)).solve(load)
        row = problem.solver((1, 0), elastic=True).solve(load)
        if plain[FIELDS["code"]] != INFEASIBLE:
            assert row[FIELDS["code"]] == plain[FIELDS["code"]]
            continue
        if row[FIELDS["code"]] == REFUSED:
            continue
        exceeded += 1
        x = force(row, s)
        t, low = row[FIELDS["limit_excess"]], row[FIELDS["lower_bound"]]
        assert row[FIELDS["code"]] == EXCEEDED
        assert row[FIELDS["objective"]] == t == pytest.approx(problem.excess(x), rel=1e-9)
        assert 0.0 < low <= t <= max(1.01 * low, low + 1e-6)
        assert np.abs(s.rows @ x + s.unit @ load).max() < 1e-12 * np.abs(x).max()
        assert (x[0::3] > np.hypot(x[1::3], x[2::3])).all()
        facets, bound = problem.pyramids()
        share = np.concatenate([np.zeros(len(facets) - len(problem.rows)), problem.rows[:, 4]])
        least = linprog(
            np.append(np.zeros(3 * count), 1.0),
            A_ub=np.column_stack([facets, -share]),
            b_ub=bound,
            A_eq=np.column_stack([s.rows, np.zeros(6)]),
            b_eq=-(s.unit @ load),
            bounds=(None, None),
            method="highs",
        )
        # 64 facets around a cone are 0.12 % wider: they may exceed less, and by little
        assert least.fun <= t * (1.0 + 1e-9)
        assert low == pytest.approx(least.fun, rel=0.02, abs=2e-3)
        for layout in layouts(count):
            again = problem.solver(layout, elastic=True).solve(load)
            assert again[FIELDS["limit_excess"]] == pytest.approx(t, rel=0.0101, abs=1e-6)
    assert exceeded >= 3


def test_rows_far_away_change_nothing() -> None:
    s = sample(4)
    load = wrenches(np.random.default_rng(5), 1)[0]
    problem = limited(s, 1, 1e9)
    plain = insides.AnyNewton.make(4, 1, s.placement, 1e-9, 300)
    plain.set_basis(s.basis)
    constant = 0.01 / 0.3  # of the row that no force changes
    found = problem.solver((4, 1)).solve(load)
    assert found[FIELDS["objective"]] - constant == pytest.approx(plain.solve(load)[FIELDS["objective"]], rel=2e-9)


def test_wrong_numbers_are_refused() -> None:
    s = sample(4)
    solver = limited(s, 0, 3.0).solver((4, 1))
    load = wrenches(np.random.default_rng(6), 1)[0]
    good = solver.solve(load)
    for wrong in (np.nan, np.inf, 1e13):
        spoiled = load.copy()
        spoiled[2] = wrong
        assert solver.solve(spoiled)[FIELDS["code"]] == REFUSED
    start = np.full(12, np.nan)
    assert solver.descend(load, start)[FIELDS["code"]] == REFUSED
    # a previous force that is none: as without
    again = solver.follow(load, start)
    np.testing.assert_array_equal(again, good)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("layout", [(4, 1), (8, 0)])
def test_nothing_is_allocated(layout: tuple[int, int]) -> None:
    """Optima, proofs and least excesses."""
    s = sample(4)
    loads = wrenches(np.random.default_rng(7), 24, 2.0)
    for elastic in (False, True):
        problem = limited(s, 3, 4.0, full=True)
        ends = {problem.solver(layout, 1e-4, elastic=elastic).solve(load)[FIELDS["code"]] for load in loads}
        assert ends >= {CONVERGED, EXCEEDED if elastic else INFEASIBLE}
        assert problem.solver(layout, 1e-4, elastic=elastic).allocations(loads, 50_000) == 0
