"""`ForceOptimizer` against plain oracles: optima of Phi, Newton steps, bounds, the 12-basis and
starts.

One table of kinds of problems serves all tests. Everything that a record claims is computed again
by code that shares nothing with the core.
"""

from __future__ import annotations

from itertools import pairwise

import _core_test as insides
import numpy as np
import pytest
from cases import FIELDS, REFUSED, START, Case, at, case, nu_of
from oracles import limits as oracle
from oracles import newton
from oracles.phi import gradient, lower_bound, phi
from oracles.starts import turned as turned_forces
from samples import COUNTS, Sample, moved, sample, wrenches

from grasp_env.force.record import CONVERGED, LIMIT, STARTED

SOME = (3, 9)
HARD = ("hard", "frictionless")
SOFT = ("some soft", "all soft", "slippery soft")
KINDS = (*HARD, *SOFT, "own limits", "shared limits", "soft limits")


def of(kind: str) -> float:
    """The size of wrenches [N] that contacts of a kind can bear within their limits."""
    return 0.7 if "limits" in kind else 3.0


def check(
    c: Case, load: np.ndarray, row: np.ndarray, tolerance: float, least: float | None = None
) -> None:
    """Check a record of a least Phi: certificate, balance, torques. least: the oracle's optimum,
    exact to rounding."""
    s = c.contacts
    z = c.z(row)
    w = s.unit @ load
    value = c.value(z)
    bound = at(row, "lower_bound")
    assert at(row, "code") == CONVERGED
    assert at(row, "margin") > 0.0
    assert at(row, "limit_excess") == 0.0
    assert at(row, "objective") == pytest.approx(value, rel=1e-9)  # before balance was restored
    assert 0.0 < bound <= value * (1.0 + 1e-11)
    assert value - bound <= tolerance * bound * (1.0 + 1e-6) + 1e-13 * value
    left = np.abs(c.matrix @ z + w).max()
    size = np.abs(z).max() + np.abs(w).max()
    more = 1e-12 * bool(len(c.terms.rows))
    assert left <= (1e-13 * c.count + more) * size
    assert at(row, "residual") == pytest.approx(left, abs=(1e-14 * c.count + more) * size)
    np.testing.assert_array_equal(row[FIELDS["wrench"] :][:6], load)
    np.testing.assert_array_equal(c.forces(row)[1][~c.soft], 0.0)
    (torques, multipliers), expected = c.torques_and_multipliers(row), c.torques(row)
    np.testing.assert_allclose(
        torques, expected, rtol=0, atol=1e-13 * (1.0 + np.abs(expected).max(initial=0.0))
    )
    assert (multipliers >= 0.0).all()
    if least is not None:
        # the last bound may come from dual_near, 2e-5 of the tolerance above the least
        assert bound <= least * (1.0 + 1e-12)
        assert least * (1.0 - 1e-12) <= at(row, "objective") <= least * (1.0 + 1.1 * tolerance)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", COUNTS)
def test_newton_finds_the_optimum_of_the_oracle(count, kind):
    if count > 9 and "limits" in kind:
        pytest.skip("the general program is not made of registers")
    rng = np.random.default_rng(count)
    found = 0
    sizes = (1e-3, 1.0, 30.0) if kind in HARD and count < 50 else (of(kind),)
    for seed, load in enumerate(wrenches(rng, max(len(sizes), 3 if "limits" in kind else 1))):
        c = case(count, kind, seed % 2)
        load = sizes[seed % len(sizes)] * load
        best = c.minimum(load)
        if best is None:
            continue
        least = c.value(best)
        tolerance = 1e-10 if kind in HARD else 1e-9
        found = found + 1
        hard = c.contacts.minimum(load)[0] / c.contacts.divisor.reshape(-1)
        solver = c.solver(tolerance=tolerance, limit=500)
        row, _ = solver.solve(load)
        near, _ = solver.solve(1.02 * load)
        others = [
            solver.solve(load, START["previous"], previous=record)[0] for record in (row, near)
        ]
        given, _ = solver.solve(load, START["given"], force=hard)
        guess, _ = solver.solve(load, START["guess"], force=1.1 * hard + 0.01)
        for record in (row, *others, given, guess):
            check(c, load, record, tolerance, least)
        # Phi is flat: a gap of 1e-10 is a distance of its root over the least curvature
        if kind in HARD:
            np.testing.assert_allclose(c.z(row), best, rtol=0, atol=3e-4 * np.abs(best).max())
        if "limits" not in kind:
            of_wrench = np.linalg.solve(c.contacts.unit, c.matrix)
            known = lower_bound(nu_of(row), of_wrench, load, c.phi_weights)
            assert known == pytest.approx(least, rel=1e-6)
        # the conditions of the optimum, with the multipliers of the limits as they are given
        price = c.torques_and_multipliers(row)[1] * c.sizes
        pull = c.matrix.T @ np.linalg.solve(c.contacts.unit.T, nu_of(row))
        slope = gradient(c.z(row), c.phi_weights)
        np.testing.assert_allclose(
            slope + c.own[0].T @ price, pull, rtol=0, atol=2e-3 * np.abs(slope).max()
        )
    assert found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", SOME)
def test_steps_are_the_oracles(count, kind):
    """Within limits, where the method's own start is inside them."""
    c = case(count, kind)
    load = wrenches(np.random.default_rng(count), 1, 0.1 if "limits" in kind else 5.0)[0]
    rows = [c.solver(tolerance=1e-15, limit=k).solve(load)[0] for k in range(5)]
    assert [at(row, "iterations") for row in rows] == [0, 1, 2, 3, 4]
    for before, after in pairwise(rows):
        step, _ = oracle.newton_step(c.z(before), c.matrix, c.contacts.unit @ load, c.terms)
        solver = c.z(after) - c.z(before)
        alpha = float(solver @ step) / float(step @ step)
        assert 0.0 < alpha <= 1.0 + 1e-8
        np.testing.assert_allclose(solver, alpha * step, rtol=0, atol=1e-8 * np.abs(step).max())


@pytest.mark.parametrize("kind", [*HARD, *SOFT])
@pytest.mark.parametrize("count", SOME)
def test_a_previous_solution_follows_the_wrench_by_the_tangent_correction(count, kind):
    """The correction is the least change in the Hessian of Phi, torsions included."""
    c = case(count, kind)
    load = wrenches(np.random.default_rng(count), 1, 5.0)[0]
    soft = int(c.soft.any())
    before, _ = c.solver(tolerance=1e-10).solve(load)
    for now in (1.01 * load, load + 0.02 * np.abs(load).max() * np.array([1, 0, 0, 0.05, 0, 0.05])):
        z = c.z(before)
        row = c.solver(limit=soft).solve(now, START["previous"], previous=before)[0]
        # from an optimum that is the Newton step, which soft contacts take: it has the last digits
        # of the optimum besides
        step, _ = oracle.newton_step(z, c.matrix, c.contacts.unit @ now, c.terms)
        if not soft:
            step = newton.tangent_correction(z, c.matrix, c.contacts.unit @ now, c.phi_weights) - z
        # the optimum itself, of a large force that grows
        assert at(row, "code") in (LIMIT, CONVERGED)
        assert (at(row, "start"), at(row, "replaced")) == (START["previous"], 0.0)
        assert at(row, "iterations") == soft
        np.testing.assert_allclose(c.z(row), z + step, rtol=0, atol=1e-5 * np.abs(step).max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_bound_is_one_far_from_the_optimum(kind):
    c = case(5, kind)
    load = wrenches(np.random.default_rng(2), 1, 0.1 * of(kind))[0]
    best = c.minimum(load)
    assert best is not None
    rows = [c.solver(tolerance=1e-15, limit=k).solve(load)[0] for k in range(12)]
    assert max(at(row, "lower_bound") for row in rows) <= c.value(best) * (1.0 + 1e-12)
    assert sum(at(row, "lower_bound") > 0.0 for row in rows) >= 3
    for row in rows:  # a force that is returned is inside
        if at(row, "code") in (LIMIT, CONVERGED):
            assert at(row, "limit_excess") == 0.0
            assert np.isfinite(c.value(c.z(row)))


@pytest.mark.parametrize("barrier", [1e-4, 1e-2, 1e3])
def test_small_and_large_forces_and_barriers(barrier):
    count = 5
    base = sample(count)
    c = Case(
        Sample(base.positions, base.normals, base.scale, base.weights * [1.0, 100.0 * barrier]),
        np.zeros(count),
    )
    solver = c.solver(tolerance=1e-6, limit=2000)
    for size in 10.0 ** np.arange(-9.0, 7.0, 3.0):
        load = wrenches(np.random.default_rng(count), 1, size)[0]
        check(c, load, solver.solve(load)[0], 1e-6)


def test_the_basis_is_that_of_the_oracle():
    c = case(4, "frictionless")
    s = c.contacts
    solver = c.solver()
    gap, basis = solver.make_basis()
    assert 0.0 <= gap <= 1e-9
    for k, expected in enumerate(s.basis):
        assert phi(basis[k], s.phi_weights) == pytest.approx(phi(expected, s.phi_weights), rel=1e-9)
        np.testing.assert_allclose(basis[k], expected, rtol=0, atol=1e-3 * np.abs(expected).max())
        load = [*np.eye(6), *-np.eye(6), np.zeros(6)][k]
        left = s.rows @ basis[k] + s.unit @ load
        assert np.abs(left).max() <= 1e-13 * s.count * (
            np.abs(basis[k]).max() + np.abs(s.unit @ load).max()
        )


STARTS = (
    "internal_force",
    "linear_combination",
    "linear_combination_printed",
    "single_value",
    "lagrange",
    "phase_one",
)


@pytest.mark.parametrize("name", STARTS)
@pytest.mark.parametrize("count", SOME)
def test_starts_are_balanced_and_inside(count, name):
    c = case(count, "hard")
    s = c.contacts
    solver = c.solver(start=START[name])
    for load in wrenches(np.random.default_rng(count), 2, 2.0):
        w = s.unit @ load
        row = solver.start(load, START[name])
        x = c.z(row, "initial")
        size = np.abs(x).max() + np.abs(w).max()
        assert at(row, "code") == STARTED
        assert name == "lagrange" or (at(row, "replaced"), at(row, "start")) == (0.0, START[name])
        assert at(row, "objective") == pytest.approx(phi(x, s.phi_weights), rel=1e-9)
        assert np.abs(s.rows @ x + w).max() <= 1e-9 * size
        assert at(row, "residual") <= 1e-9 * size
        assert at(row, "margin") > 0.0
        if name.startswith("linear"):
            expected = newton.combine(s.basis, load, name.endswith("printed"))
            np.testing.assert_allclose(x, expected, rtol=0, atol=1e-3 * size)
        if name == "single_value":  # the least force, and a multiple of an internal force
            expected = -s.inverse @ w
            share = float((x - expected) @ s.rest / (s.rest @ s.rest))
            np.testing.assert_allclose(x, expected + share * s.rest, rtol=0, atol=1e-3 * size)
            assert share >= 1.0 - 1e-3
        solved, _ = solver.solve(load, START[name])
        np.testing.assert_allclose(c.z(solved, "initial"), x, rtol=0, atol=1e-12 * size)
        check(c, load, solved, 1e-9)


@pytest.mark.parametrize(
    ("torsion", "accepted"), [(0.0, True), (0.0239, True), (0.0241, False), (0.05, False)]
)
def test_a_given_torsion_is_inside_the_cone_or_refused(torsion, accepted):
    # at 10 N, 4 N of shear are 4/5 of the cone; 3/5 of the torsion 0.04 N m are left beside it
    jaw = insides.place(
        np.array([[-0.02, 0, 0], [0.02, 0, 0]]),
        np.array([[1.0, 0, 0], [-1.0, 0, 0]]),
        np.tile([0.5, 1.0, 1.0], (2, 1)),
        np.tile([1.0, 0.01], (2, 1)),
        torsion=np.full(2, 0.004),
    )
    solver = insides.AnyOptimizer.make(jaw, tolerance=1e-8)
    load = np.array([0, 0, -8.0, 0, 0, 0])
    row, _ = solver.solve(load)
    force = row[FIELDS["force"] :][:6].reshape(2, 3)
    force[:, 0] = 10.0
    row, _ = solver.solve(load, START["given"], force=force, torsion=np.full(2, torsion))
    assert (at(row, "code") != REFUSED) == accepted


@pytest.mark.parametrize("kind", KINDS)
def test_a_given_start_is_one_or_refused(kind):
    c = case(4, kind)
    load = next(
        load
        for load in wrenches(np.random.default_rng(4), 9, of(kind))
        if c.minimum(load) is not None
    )
    solver = c.solver(tolerance=1e-8)
    row, _ = solver.solve(load)
    check(c, load, row, 1e-8)
    force, torsion = c.forces(row)
    given, _ = solver.solve(load, START["given"], force=force, torsion=torsion)
    assert (at(given, "start"), at(given, "replaced")) == (START["given"], 0.0)
    np.testing.assert_allclose(
        c.forces(given, "initial")[0], force, rtol=0, atol=1e-9 * np.abs(force).max()
    )
    unbalanced = force.copy()
    unbalanced[0] += 1e-5 * np.abs(force).max()
    none = (np.full(12, np.nan), -force, np.zeros(12), 1e13 * force)
    for bad in (*none, unbalanced, 1.001 * force, force[:9]):
        assert (
            at(solver.solve(load, START["given"], force=bad, torsion=torsion)[0], "code") == REFUSED
        )
    for number in (np.nan, 1.0) if kind in ("all soft", "slippery soft") else ():
        bad = np.where(np.arange(4) == 1, number, torsion)
        assert (
            at(solver.solve(load, START["given"], force=force, torsion=bad)[0], "code") == REFUSED
        )
    for bad in none:
        before = row.copy()
        before[FIELDS["force"] :][:12] = bad
        check(c, load, solver.solve(load, START["previous"], previous=before)[0], 1e-8)
        check(c, load, solver.solve(load, START["previous"], force=bad)[0], 1e-8)
        if kind in HARD:
            check(c, load, solver.solve(load, START["guess"], force=bad)[0], 1e-8)
    np.testing.assert_array_equal(solver.solve(load)[0], row)


@pytest.mark.parametrize("count", SOME)
def test_a_guess_is_balanced_and_the_best_on_the_way(count):
    c = case(count, "hard")
    rng = np.random.default_rng(count)
    used = set()
    s = c.contacts
    solver = c.solver()
    for size in (1e-3, 0.3, 10.0):
        load = wrenches(rng, 1, 2.0)[0]
        w = s.unit @ load
        best = s.minimum(load)[0]
        guess = best * (1.0 + size * rng.standard_normal(3 * count))
        row = solver.start(load, START["guess"], force=guess / s.divisor.reshape(-1))
        plain = solver.start(load)
        x = c.z(row, "initial")
        safe = c.z(plain, "initial")
        moved = guess - s.inverse @ (s.rows @ guess + w)
        used.add(at(row, "replaced"))
        assert phi(x, s.phi_weights) <= min(phi(safe, s.phi_weights), phi(moved, s.phi_weights)) * (
            1.0 + 1e-12
        )
        assert np.abs(s.rows @ x + w).max() <= 1e-12 * count * (np.abs(x).max() + np.abs(w).max())
        share = float((x - safe) @ (moved - safe) / ((moved - safe) @ (moved - safe)))
        np.testing.assert_allclose(
            x, safe + share * (moved - safe), rtol=0, atol=1e-9 * np.abs(moved).max()
        )
    assert 0.0 in used


@pytest.mark.parametrize("count", SOME)
def test_the_combination_follows_moved_contacts(count):
    """The tangent correction carries it; it is replaced where that leaves the cones or more than
    doubles Phi."""
    c = case(count, "hard")
    replaced = set()
    s = c.contacts
    solver = c.solver(start=START["linear_combination"], limit=0)
    for seed, w in enumerate(wrenches(np.random.default_rng(count), 5)):
        for size in (1e-3, 0.03, 0.1, 0.3, 2.0):
            there = moved(s, size, seed)
            combined = newton.combine(s.basis, w)
            turned = turned_forces(combined, s.frames, there.frames, s.divisor, s.scale)
            expected = newton.tangent_correction(turned, there.rows, there.unit @ w, s.phi_weights)
            grown = phi(expected, s.phi_weights) / phi(combined, s.phi_weights)
            row, _ = solver.solve(w, positions=there.positions, normals=there.normals)
            if at(row, "code") != LIMIT or abs(grown - 2.0) < 1e-2:
                continue
            assert at(row, "replaced") == (not grown <= 2.0)
            replaced.add(at(row, "replaced"))
            if grown <= 2.0:
                np.testing.assert_allclose(
                    c.z(row, "initial"), expected, rtol=0, atol=1e-4 * np.abs(expected).max()
                )
    assert replaced == {0.0, 1.0}
