"""`ForceOptimizer` in every layout of the registers: each algorithm against its plain oracle, certificates, proofs, starts.

One table of kinds of problems serves all tests. Whatever a record says is computed anew, by code that shares nothing with the core.
"""

from __future__ import annotations

from itertools import pairwise

import _core_test as insides
import numpy as np
import pytest
from cases import CONVERGED, EXCEEDED, FIELDS, INFEASIBLE, LIMIT, REFUSED, START, Case, case, own_limits, shared_limits
from dense import asked_of, cold, flat, twin
from oracles import conic, interior_point, newton
from oracles import limits as oracle
from oracles import network as network_oracle
from oracles.phi import gradient, lower_bound, phi
from samples import COUNTS, LAYOUTS, Sample, layouts, sample, wrenches
from scipy.optimize import linprog

SOME = (3, 4, 5, 8, 9)
HARD = ("hard", "frictionless")
KINDS = (*HARD, "some soft", "all soft", "own limits", "shared limits", "soft limits")


def of(kind: str) -> float:
    """The size of wrenches [N] that contacts of a kind can bear within their limits."""
    return 0.7 if "limits" in kind else 3.0


def at(row: np.ndarray, name: str) -> float:
    return float(row[FIELDS[name]])


def nu_of(row: np.ndarray) -> np.ndarray:
    return row[FIELDS["multipliers"] :][:6]


def check(c: Case, load: np.ndarray, row: np.ndarray, tolerance: float, least: float | None = None) -> None:
    """A certified least Phi. least: the oracle's, which knows it to rounding."""
    s, z = c.contacts, c.z(row)
    w = s.unit @ load
    value, bound = c.value(z), at(row, "lower_bound")
    assert at(row, "code") == CONVERGED
    assert at(row, "margin") > 0.0
    assert at(row, "limit_excess") == 0.0
    assert at(row, "objective") == pytest.approx(
        value, rel=1e-9
    )  # of the last iterate, before its balance was restored
    assert 0.0 < bound <= value * (1.0 + 1e-11)
    assert value - bound <= tolerance * bound * (1.0 + 1e-6) + 1e-13 * value
    left, size, more = (
        np.abs(c.matrix @ z + w).max(),
        np.abs(z).max() + np.abs(w).max(),
        1e-12 * bool(len(c.terms.rows)),
    )
    assert left <= (1e-13 * c.count + more) * size
    assert at(row, "residual") == pytest.approx(left, abs=(1e-14 * c.count + more) * size)
    np.testing.assert_array_equal(row[FIELDS["wrench"] :][:6], load)
    np.testing.assert_array_equal(c.forces(row)[1][~c.soft], 0.0)
    (torques, prices), wanted = c.said(row), c.torques(row)
    np.testing.assert_allclose(torques, wanted, rtol=0, atol=1e-13 * (1.0 + np.abs(wanted).max(initial=0.0)))
    assert (prices >= 0.0).all()
    if least is not None:
        # the last bound may come from dual_near, 2e-5 of the tolerance above the least
        assert bound <= least * (1.0 + 1e-12)
        assert least * (1.0 - 1e-12) <= at(row, "objective") <= least * (1.0 + 1.1 * tolerance)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", COUNTS)
def test_newton_finds_the_optimum_of_the_oracle(count: int, kind: str) -> None:
    """From its own start, from its own optimum and that of a nearby wrench, from a given force and from a guess."""
    if count > 9 and kind not in HARD and count not in (12, 16):
        pytest.skip("the general program is not made of registers")
    rng, found = np.random.default_rng(count), 0
    sizes = (1e-3, 1.0, 30.0) if kind in HARD and count < 50 else (of(kind),)
    for seed, load in enumerate(wrenches(rng, max(len(sizes), 3 if count < 6 or "limits" in kind else 1))):
        c = case(count, kind, seed % 2)
        load = sizes[seed % len(sizes)] * load
        best = c.minimum(load)
        if best is None:
            continue
        least, tolerance, found = c.value(best), 1e-10 if kind in HARD else 1e-9, found + 1
        hard = c.contacts.minimum(load)[0] / c.contacts.divisor.reshape(-1)
        for layout in layouts(count):
            made = c.solver(layout, tolerance=tolerance, limit=500)
            row, _ = made.solve(load)
            near, _ = made.solve(1.02 * load)
            others = [made.solve(load, START["previous"], previous=each)[0] for each in (row, near)]
            given, _ = made.solve(load, START["given"], force=hard)
            guess, _ = made.solve(load, START["guess"], force=1.1 * hard + 0.01)
            for each in (row, *others, given, guess):
                check(c, load, each, tolerance, least)
            if kind in HARD:  # Phi is flat: a gap of 1e-10 is a distance of its root over the least curvature
                np.testing.assert_allclose(c.z(row), best, rtol=0, atol=3e-4 * np.abs(best).max())
                known = lower_bound(nu_of(row), c.contacts.cone_matrix, load, c.contacts.weights)
                assert known == pytest.approx(least, rel=1e-6)
            else:  # the conditions of the optimum, with the prices of the limits as they are given
                s, price, z = c.contacts, c.said(row)[1] * c.sizes, c.z(row)
                torsion = oracle.Terms(s.weights, *(a[len(price) :] for a in c.terms[1:]))
                pull = c.matrix.T @ np.linalg.solve(s.unit.T, nu_of(row))
                slope = oracle.derivatives(z, torsion)[0] + c.own[0].T @ price - pull
                np.testing.assert_allclose(slope, 0.0, atol=2e-3 * np.abs(gradient(z[: 3 * count], s.weights)).max())
    assert found


@pytest.mark.parametrize("kind", [*HARD, "some soft"])
@pytest.mark.parametrize("count", SOME)
def test_steps_are_the_oracles_in_every_layout(count: int, kind: str) -> None:
    """The direction of the dense KKT system, cut short alike; only the order of sums differs from layout to layout."""
    c = case(count, kind)
    load = wrenches(np.random.default_rng(count), 1, 5.0)[0]
    every = [[c.solver(layout, tolerance=1e-15, limit=k).solve(load)[0] for k in range(5)] for layout in layouts(count)]
    for rows in every:
        assert [at(row, "iterations") for row in rows] == [0, 1, 2, 3, 4]
        for before, after, same in zip(rows, rows[1:], every[0][1:], strict=False):
            here = c.z(before)
            step, _ = oracle.newton_step(here, c.matrix, c.contacts.unit @ load, c.terms)
            made = c.z(after) - here
            alpha = float(made @ step) / float(step @ step)
            assert 0.0 < alpha <= 1.0 + 1e-8
            np.testing.assert_allclose(made, alpha * step, rtol=0, atol=1e-8 * np.abs(step).max())
            np.testing.assert_array_equal(after[:3], same[:3])
            np.testing.assert_allclose(c.z(after), c.z(same), rtol=0, atol=1e-9 * np.abs(here).max())


@pytest.mark.parametrize("kind", [*HARD, "some soft", "all soft"])
@pytest.mark.parametrize("count", SOME)
def test_a_previous_solution_follows_the_wrench_by_the_tangent_correction(count: int, kind: str) -> None:
    """The change that is least in the Hessian of Phi, of torsions too."""
    c = case(count, kind)
    load, soft = wrenches(np.random.default_rng(count), 1, 5.0)[0], int(c.soft.any())
    for layout in layouts(count):
        before, _ = c.solver(layout, tolerance=1e-10).solve(load)
        for now in (1.01 * load, load + 0.02 * np.abs(load).max() * np.array([1, 0, 0, 0.05, 0, 0.05])):
            z, row = c.z(before), c.solver(layout, limit=soft).solve(now, START["previous"], previous=before)[0]
            # from an optimum that is the Newton step, which soft contacts take: it has the last digits of the optimum besides
            step, _ = oracle.newton_step(z, c.matrix, c.contacts.unit @ now, c.terms)
            if not soft:
                step = newton.tangent_correction(z, c.matrix, c.contacts.unit @ now, c.contacts.weights) - z
            assert at(row, "code") in (LIMIT, CONVERGED)  # the optimum itself, of a large force that grows
            assert (at(row, "start"), at(row, "replaced")) == (START["previous"], 0.0)
            assert at(row, "iterations") == soft
            np.testing.assert_allclose(c.z(row), z + step, rtol=0, atol=1e-5 * np.abs(step).max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_bound_is_one_far_from_the_optimum(kind: str) -> None:
    """Stopped after any number of steps."""
    c, load = case(5, kind), wrenches(np.random.default_rng(2), 1, 0.1 * of(kind))[0]
    best = c.minimum(load)
    assert best is not None
    rows = [c.solver((8, 0), tolerance=1e-15, limit=k).solve(load)[0] for k in range(12)]
    assert max(at(row, "lower_bound") for row in rows) <= c.value(best) * (1.0 + 1e-12)
    assert sum(at(row, "lower_bound") > 0.0 for row in rows) >= 3
    for row in rows:  # a force that is returned is inside
        if at(row, "code") in (LIMIT, CONVERGED):
            assert at(row, "limit_excess") == 0.0
            assert np.isfinite(c.value(c.z(row)))


@pytest.mark.parametrize("barrier", [1e-4, 1e-2, 1.0, 1e3])
@pytest.mark.parametrize("count", [3, 5, 8])
def test_small_and_large_forces_and_barriers(count: int, barrier: float) -> None:
    base = sample(count)
    c = Case(Sample(base.positions, base.normals, base.scale, base.weights * [1.0, 100.0 * barrier]), np.zeros(count))
    made = c.solver((8, 0), tolerance=1e-6, limit=2000)
    for size in 10.0 ** np.arange(-9.0, 7.0):
        load = wrenches(np.random.default_rng(count), 1, size)[0]
        check(c, load, made.solve(load)[0], 1e-6)


# --- the 12-basis and the starts that it makes


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", HARD)
def test_the_basis_is_that_of_the_oracle(layout: tuple[int, int], kind: str) -> None:
    c = case(4, kind)
    s, made = c.contacts, c.solver(layout)
    gap, basis = made.make_basis()
    assert 0.0 <= gap <= 1e-9
    for k, wanted in enumerate(s.basis):
        assert phi(basis[k], s.weights) == pytest.approx(phi(wanted, s.weights), rel=1e-9)
        np.testing.assert_allclose(basis[k], wanted, rtol=0, atol=1e-3 * np.abs(wanted).max())
        load = [*np.eye(6), *-np.eye(6), np.zeros(6)][k]
        left = s.rows @ basis[k] + s.unit @ load
        assert np.abs(left).max() <= 1e-13 * s.count * (np.abs(basis[k]).max() + np.abs(s.unit @ load).max())


def test_the_gap_of_a_basis_is_its_worst() -> None:
    """A barrier so small that rounding ends each of the 13 descents elsewhere; the shorter reach to the boundary finds it."""
    base, worst = sample(4), []
    for lam in (1e-5, 1e-9, 1e-11, 1e-13):
        s = Sample(base.positions, base.normals, base.scale, np.column_stack([base.weights[:, 0], np.full(4, lam)]))
        made = insides.AnyOptimizer.make(8, 0, s.placement, tolerance=1e-4)
        gap, basis = made.make_basis()
        loads = [*np.eye(6), *-np.eye(6), np.zeros(6)]
        bounds = [at(made.solve(load)[0], "lower_bound") for load in loads]
        gaps = [phi(x, s.weights) / bound - 1.0 for x, bound in zip(basis, bounds, strict=True)]
        assert gap >= max(gaps) - 2e-4
        worst.append(gap)
    assert worst[0] < 1e-2


@pytest.mark.parametrize(
    "name",
    ["internal_force", "linear_combination", "linear_combination_printed", "single_value", "lagrange", "phase_one"],
)
@pytest.mark.parametrize("count", SOME)
def test_starts_are_balanced_inside_and_the_same_in_every_layout(count: int, name: str) -> None:
    c = case(count, "hard")
    s = c.contacts
    made = [c.solver(layout, start=START[name]) for layout in layouts(count)]
    for load in wrenches(np.random.default_rng(count), 4, 2.0):
        w, rows = s.unit @ load, [each.start(load, START[name]) for each in made]
        for row, each in zip(rows, made, strict=True):
            x = c.z(row, "initial")
            size = np.abs(x).max() + np.abs(w).max()
            assert at(row, "code") == LIMIT
            assert name == "lagrange" or (at(row, "replaced"), at(row, "start")) == (0.0, START[name])
            assert at(row, "objective") == pytest.approx(phi(x, s.weights), rel=1e-9)
            assert np.abs(s.rows @ x + w).max() <= 1e-9 * size
            assert at(row, "residual") <= 1e-9 * size
            assert at(row, "margin") > 0.0
            np.testing.assert_allclose(x, c.z(rows[0], "initial"), rtol=0, atol=1e-5 * size)
            if name.startswith("linear"):
                wanted = newton.combine(s.basis, load, name.endswith("printed"))
                np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-3 * size)
            if name == "single_value":  # the least force, and a multiple of an internal force
                wanted = -s.inverse @ w
                share = float((x - wanted) @ s.rest / (s.rest @ s.rest))
                np.testing.assert_allclose(x, wanted + share * s.rest, rtol=0, atol=1e-3 * size)
                assert share >= 1.0 - 1e-3
            solved, _ = each.solve(load, START[name])
            np.testing.assert_allclose(c.z(solved, "initial"), x, rtol=0, atol=1e-12 * size)
            check(c, load, solved, 1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("layout", [(1, 0), (4, 1), (8, 0)])
def test_a_given_start_is_one_or_refused(layout: tuple[int, int], kind: str) -> None:
    """Balanced and strictly inside the cones; what is none of a guess or a previous solution is not used."""
    c = case(4, kind)
    load = next(load for load in wrenches(np.random.default_rng(4), 9, of(kind)) if c.minimum(load) is not None)
    made = c.solver(layout, tolerance=1e-8)
    row, _ = made.solve(load)
    check(c, load, row, 1e-8)
    force, torsion = c.forces(row)
    given, _ = made.solve(load, START["given"], force=force, torsion=torsion)
    assert (at(given, "start"), at(given, "replaced")) == (START["given"], 0.0)
    np.testing.assert_allclose(c.forces(given, "initial")[0], force, rtol=0, atol=1e-9 * np.abs(force).max())
    unbalanced = force.copy()
    unbalanced[0] += 1e-5 * np.abs(force).max()
    none = (np.full(12, np.nan), np.full(12, np.inf), -force, np.zeros(12), 1e13 * force)
    wrong = [*none, unbalanced, 1.001 * force, force[:9]]
    for bad in wrong:
        assert at(made.solve(load, START["given"], force=bad, torsion=torsion)[0], "code") == REFUSED
    for number in (np.nan, np.inf, -1e300, 1.0) if kind == "all soft" else ():
        bad = np.where(np.arange(4) == 1, number, torsion)
        assert at(made.solve(load, START["given"], force=force, torsion=bad)[0], "code") == REFUSED
    for bad in none:
        before = row.copy()
        before[FIELDS["force"] :][:12] = bad
        check(c, load, made.solve(load, START["previous"], previous=before)[0], 1e-8)
        check(c, load, made.solve(load, START["previous"], force=bad)[0], 1e-8)
        if kind in HARD:
            check(c, load, made.solve(load, START["guess"], force=bad)[0], 1e-8)
    np.testing.assert_array_equal(made.solve(load)[0], row)


@pytest.mark.parametrize("count", SOME)
def test_a_guess_is_balanced_and_the_best_on_the_way(count: int) -> None:
    c, rng, used = case(count, "hard"), np.random.default_rng(count), set()
    s = c.contacts
    for layout in layouts(count):
        made = c.solver(layout)
        for size in (1e-3, 0.3, 10.0):
            load = wrenches(rng, 1, 2.0)[0]
            w, best = s.unit @ load, s.minimum(load)[0]
            guess = best * (1.0 + size * rng.standard_normal(3 * count))
            row, plain = made.start(load, START["guess"], force=guess / s.divisor.reshape(-1)), made.start(load)
            x, safe = c.z(row, "initial"), c.z(plain, "initial")
            moved = guess - s.inverse @ (s.rows @ guess + w)
            used.add(at(row, "replaced"))
            assert phi(x, s.weights) <= min(phi(safe, s.weights), phi(moved, s.weights)) * (1.0 + 1e-12)
            assert np.abs(s.rows @ x + w).max() <= 1e-12 * count * (np.abs(x).max() + np.abs(w).max())
            share = float((x - safe) @ (moved - safe) / ((moved - safe) @ (moved - safe)))
            np.testing.assert_allclose(x, safe + share * (moved - safe), rtol=0, atol=1e-9 * np.abs(moved).max())
    assert 0.0 in used


# --- proofs and least excesses


TIGHT = [
    *((count, "own", free) for free in (0, 1) for count in (3, 4, 6, 9)), (3, "shared", 0), (4, "shared", 0), (5, "soft", 0),
]  # fmt: skip


def tight(count: int, what: str, free: int, seed: int) -> Case:
    """Limits that about half of the wrenches of 2 N exceed. free: contacts that nothing bounds."""
    s = sample(count)
    if what == "own":
        return Case(s, np.zeros(count), own_limits(s, seed, 1.0, full=True, free=free))
    gamma = case(count, "some soft").gamma if what == "soft" else np.zeros(count)
    return Case(s, gamma, shared_limits(s, seed, 6.0))


def least_over(c: Case, load: np.ndarray, cost: np.ndarray, *, inside: bool, elastic: bool):
    """linprog over pyramids about the cones, or inside them; elastic: balanced forces that exceed limits by the last variable."""
    facets, bound = c.pyramids(inside=inside)
    if not elastic:
        return linprog(cost, A_ub=facets, b_ub=bound, bounds=(None, None), method="highs")
    wider = np.zeros(len(facets))
    first = len(facets) - len(c.terms.rows)
    wider[first : first + len(c.own[2])] = c.own[2]
    return linprog(
        cost, A_ub=np.column_stack([facets, -wider]), b_ub=bound, A_eq=np.column_stack([c.matrix, np.zeros(6)]),
        b_eq=-(c.contacts.unit @ load), bounds=(None, None), method="highs",
    )  # fmt: skip


@pytest.mark.parametrize(("count", "what", "free"), TIGHT)
def test_infeasible_is_proven_or_exceeded_least(count: int, what: str, free: int) -> None:
    """A proof v: v . w exceeds what any force within pyramids around the cones, and within the limits, makes of -v . G f.

    Elastic, the excess is within a hundredth of the least: pyramids inside the cones know no smaller one, and its multipliers are a
    slope below it.
    """
    proofs, exceeded, feasible = 0, 0, 0
    for k, load in enumerate(wrenches(np.random.default_rng(100 + count), 12, 2.0)):
        c = tight(count, what, free, k)
        s = c.contacts
        row, soft = (c.solver((1, 0), elastic=elastic).solve(load)[0] for elastic in (False, True))
        if at(row, "code") != INFEASIBLE:
            assert at(soft, "code") == at(row, "code")
            assert at(row, "code") != CONVERGED or c.excess(c.z(row)) == 0.0
            feasible += 1
            continue
        twist, (_, prices) = nu_of(row), c.said(row)
        assert np.abs(twist).max() == pytest.approx(1.0)
        assert (prices >= 0.0).all()
        np.testing.assert_array_equal(row[FIELDS["force"] : len(row) - len(prices)], 0.0)
        for layout in layouts(count):
            assert at(c.solver(layout).solve(load)[0], "code") == INFEASIBLE
        # a proof touches the cone of a contact without bound
        pull = np.linalg.solve(s.unit, c.matrix).T @ twist
        least = least_over(c, load, pull, inside=free > 0, elastic=False)
        if least.status != 3:  # pyramids of 64 facets are open where the cones are not: no verdict of theirs
            assert least.status == 2 or twist @ load + least.fun > -2e-3 * abs(twist @ load)
            proofs += least.status == 2 or twist @ load + least.fun > 0.0
        if at(soft, "code") != EXCEEDED:
            continue
        exceeded += 1
        z, t, low = c.z(soft), at(soft, "limit_excess"), at(soft, "lower_bound")
        assert at(soft, "objective") == t == pytest.approx(c.excess(z), rel=1e-9)
        assert 0.0 < low <= t <= max(1.01 * low, low + 1e-6)
        assert np.abs(c.matrix @ z + s.unit @ load).max() < 1e-9 * np.abs(z).max()
        assert (z[0 : 3 * count : 3] > np.hypot(z[1 : 3 * count : 3], z[2 : 3 * count : 3])).all()
        last = np.append(np.zeros(len(z)), 1.0)
        # 64 facets around a cone are 0.12 % wider: they may exceed less, and by little
        around, within = (least_over(c, load, last, inside=inside, elastic=True) for inside in (False, True))
        assert around.fun <= t * (1.0 + 1e-9)
        assert low == pytest.approx(around.fun, rel=0.02, abs=2e-3)
        assert low <= within.fun * (1.0 + 1e-9)
        for share in (0.3, -0.3) if what == "own" and free == 0 else ():
            other = least_over(c, (1.0 + share) * load, last, inside=True, elastic=True)
            assert other.fun >= low - share * float(nu_of(soft) @ load) - 1e-6
        for layout in layouts(count):
            made = c.solver(layout, elastic=True)
            again, _ = made.solve(load)
            assert at(again, "limit_excess") == pytest.approx(t, rel=0.0101, abs=1e-6)
            for scale in (1.001, 0.9, 0.7, 0.5, 0.3, 0.1):  # on the way back within the limits
                fresh, after = (
                    made.solve(scale * load, *more)[0] for more in ((), (START["previous"], None, None, again))
                )
                assert at(after, "code") == at(fresh, "code")
                assert at(after, "limit_excess") == pytest.approx(at(fresh, "limit_excess"), rel=0.0202, abs=2e-6)
    assert proofs >= 3
    assert exceeded >= 3
    assert feasible >= (what != "own")


@pytest.mark.parametrize("method", ["newton", "reduced flow", "sum", "largest"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_fingers_that_all_push_one_way_have_proofs_or_forces(layout: tuple[int, int], method: str) -> None:
    """No force closure: pressed against the fingers the object is held, and lifted from them a twist proves that it is not."""
    base = sample(4)
    s = Sample(base.positions, np.tile([0.0, 0.6, 0.8], (4, 1)), base.scale * 0.0 + [0.3, 1.0, 1.0], base.weights)
    c = Case(s, np.zeros(4))
    made = c.solver(layout, method, tolerance=1e-4)
    middle = s.positions.mean(axis=0)
    press = np.array([0.0, -3.0, -4.0])
    held = np.concatenate([press, np.cross(middle, press)])
    row, _ = made.solve(held)
    assert at(row, "code") == CONVERGED
    assert np.abs(s.rows @ c.z(row) + s.unit @ held).max() <= 1e-9 * np.abs(s.unit @ held).max()
    row, _ = made.solve(-held)
    assert at(row, "code") == INFEASIBLE
    twist = nu_of(row)
    pull = (s.cone_matrix.T @ twist).reshape(-1, 3)
    assert twist @ -held > 0.0
    assert (pull[:, 0] - np.hypot(pull[:, 1], pull[:, 2])).min() >= -1e-9


# --- the least sum and the least maximum of the normal forces


@pytest.mark.parametrize(
    ("count", "kind"), [*((n, "hard") for n in SOME), (8, "frictionless"), (5, "frictionless"), (6, "thin")]
)
def test_iterations_of_the_least_sum_are_the_oracles(count: int, kind: str) -> None:
    c = case(count, kind)
    s = c.contacts
    for load in wrenches(np.random.default_rng(count), 2, 3.0):
        unit = s.unit @ load
        size = float(np.abs(unit).max())
        for layout in layouts(count):
            program = conic.of_grasp(s.rows, unit / size, s.divisor)
            rows = [c.solver(layout, "sum", tolerance=1e-15, limit=k).solve(load)[0] for k in range(1, 5)]
            # the start is the core's: a centre that another internal force makes would be as good a one
            x = c.z(rows[0], "initial") / size
            point = conic.Iterate(x, program.cost.copy(), np.zeros(6))
            assert np.abs(s.rows @ x + unit / size).max() <= 1e-12 * np.abs(x).max()
            seen = []
            for k, row in enumerate(rows):
                point = conic.iteration(program, point)
                assert (at(row, "code"), at(row, "iterations")) == (LIMIT, k + 1)
                force, _ = c.forces(row)
                near = 1e-8 * np.abs(force).max()
                np.testing.assert_allclose(force, size * point.x / s.divisor.reshape(-1), rtol=0, atol=near)
                # y of the record is scaled onto the boundary of its set
                bound, nu = conic.certified_bound(program, point.y)
                np.testing.assert_allclose(nu_of(row), s.unit.T @ nu, rtol=0, atol=1e-7 * np.abs(s.unit.T @ nu).max())
                assert at(row, "lower_bound") == pytest.approx(size * bound, rel=1e-7, abs=near)
                seen.append(force)
            # every iteration moved: equal iterates would prove nothing
            assert all(np.abs(b - a).max() > 1e-6 * np.abs(b).max() for a, b in pairwise(seen))


def certified(c: Case, load: np.ndarray, row: np.ndarray, tolerance: float, largest: bool) -> None:
    """Balanced, inside cones and limits, and with a bound that weak duality proves from multipliers and prices."""
    s, z = c.contacts, c.z(row)
    w, normals = s.unit @ load, c.forces(row)[0][0::3]
    assert at(row, "code") == CONVERGED
    assert at(row, "objective") == pytest.approx(normals.max() if largest else normals.sum(), rel=1e-9)
    size = np.abs(z).max() + np.abs(w).max()
    near = 1e-13 if c.terms.rows.size == 0 and not largest else 1e-9
    assert np.abs(c.matrix @ z + w).max() <= near * c.count * size
    assert at(row, "margin") >= 0.0
    assert c.excess(z) <= 1e-9
    # nu, and prices y of the limits: what every force in the cones pays, a = c - G^T nu + A^T y, must be in the dual cones
    price = c.said(row)[1] * c.sizes
    pull = c.matrix.T @ np.linalg.solve(s.unit.T, nu_of(row)) - c.own[0].T @ price
    turn = np.zeros(c.count)
    turn[c.soft] = np.abs(pull[3 * c.count :])
    each = pull[: 3 * c.count].reshape(-1, 3)
    need = (each[:, 0] + np.hypot(each[:, 1], each[:, 2]) + turn) * s.divisor[:, 0]
    most = np.maximum(need, 0.0).sum() if largest else need.max()
    value, low = -nu_of(row) @ load - price @ c.own[1], at(row, "lower_bound")
    assert most <= 1.0 + 1e-6
    assert low <= max(0.0, value / max(1.0, most)) * (1.0 + 1e-5) + 1e-12
    assert low <= at(row, "objective") <= low * (1.0 + tolerance * (1.0 + 1e-9)) + 1e-300


@pytest.mark.parametrize("kind", [*HARD, "thin"])
@pytest.mark.parametrize("count", COUNTS)
def test_the_least_sum_is_certified_in_every_layout(count: int, kind: str) -> None:
    # three contacts nearly on a line have hardly any internal force
    c, rng = case(count, "hard" if (count, kind) == (3, "thin") else kind), np.random.default_rng(count)
    for size in (1e-6, 1.0, 1e4):
        load = wrenches(rng, 1, size)[0]
        rows = [c.solver(layout, "sum", tolerance=1e-6).solve(load)[0] for layout in layouts(count)]
        for row in rows:
            certified(c, load, row, 1e-6, False)
            assert max(at(row, "lower_bound") for row in rows) <= at(row, "objective") * (1.0 + 1e-12)


@pytest.mark.parametrize("method", ["sum", "largest"])
@pytest.mark.parametrize("kind", ["some soft", "own limits", "shared limits", "soft limits", "hard"])
@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_least_forces_are_those_of_the_dense_interior_point(count: int, kind: str, method: str) -> None:
    c, found = case(count, kind), 0
    for load in wrenches(np.random.default_rng(count), 4, of(kind)):
        rows = [c.solver(layout, method, tolerance=1e-8).solve(load)[0] for layout in layouts(count)]
        if at(rows[0], "code") == INFEASIBLE:
            assert c.minimum(load) is None
            continue
        found += 1
        asked = asked_of(c, load, method)
        program, point = twin(asked), flat(asked, cold(asked))
        for _ in range(40):
            point = interior_point.nt_step(program, point)
            if point.x @ point.s < 1e-10 * abs(program.cost @ point.x + program.shared_cost @ point.t):
                break
        least = float(program.cost @ point.x + program.shared_cost @ point.t)
        for row in rows:
            certified(c, load, row, 1e-8, method == "largest")
            assert at(row, "objective") == pytest.approx(least, rel=2e-8)
    assert found


# --- learned starts


NETWORKS = [
    [1, 1], [8, 6], [8, 32, 6], [8, 64, 64, 6], [8, 96, 96, 6], [3, 5, 7, 9, 11], [8, 130, 33, 1], [17, 1, 40], [1024, 2], [2, 1024],
    [4] * 9,
]  # fmt: skip
"""Of every filling of registers of 4, 8 and 16."""


def single(a: np.ndarray) -> np.ndarray:
    return a.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("sizes", NETWORKS, ids=str)
def test_a_network_is_that_of_numpy(sizes: list[int]) -> None:
    rng = np.random.default_rng(len(sizes))
    weights = single(rng.standard_normal(insides.network_numbers(sizes)) / np.sqrt(max(sizes)))
    for x in single(rng.standard_normal((5, sizes[0]))):
        expected = network_oracle.network(sizes, weights, x)
        # float32: rounding of sums of a thousand terms
        near = 3e-6 * max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(insides.network(sizes, weights, x), expected, atol=near)


@pytest.mark.parametrize(
    "sizes", [[], [8], [8, 0, 6], [8, -1, 6], [8, 1025, 6], [4] * 10, [2**31 - 1, 2**31 - 1]], ids=str
)
def test_sizes_beyond_the_bounds_have_no_numbers(sizes: list[int]) -> None:
    assert insides.network_numbers(sizes) == 0


def null_space(s: Sample) -> np.ndarray:
    """(3N, 3N - 6) internal forces."""
    return np.ascontiguousarray(np.linalg.svd(s.rows * s.scale.reshape(-1))[2][6:].T)


PAIRS = single(np.random.default_rng(9).standard_normal((6, 6)))
"""Three vectors of a wrench, whose lengths are features."""


def model(s: Sample, seed: int, size: float) -> tuple[list[int], np.ndarray, insides.Model]:
    """A network of random weights of that size."""
    shape = [8 + 3, 16, 3 * s.count - 6]
    weights = size * np.random.default_rng(seed).standard_normal(insides.network_numbers(shape))
    weights = single(np.clip(weights, -3.4e38, 3.4e38))
    return shape, weights, insides.Model.make(shape, weights, PAIRS, null_space(s))


@pytest.mark.parametrize("size", [0.1, 0.3, 3.0, 1e4, 1e20, 3e38])
@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_a_learned_start_is_the_networks_force_and_never_worse_than_the_methods_own(count: int, size: float) -> None:
    """Whatever the weights: balanced, inside, no worse than a previous optimum, and Newton from it ends certified."""
    c, told, outside = case(count, "hard"), set(), set()
    s = c.contacts
    for layout in layouts(count)[-2:] if size > 1.0 else layouts(count):
        for seed in range(2):
            shape, weights, trained = model(s, seed, size)
            made = c.solver(layout, tolerance=1e-8, start=START["learned"], model=trained)
            previous = None
            for scale in (1e-6, 1e-2, 1.0, 30.0, 1e4):
                load = wrenches(np.random.default_rng(seed), 1, scale)[0]
                w = s.unit @ load
                safe = c.z(made.start(load, START["internal_force"]), "initial")
                for before in (None, previous):
                    row, (solved, _) = made.start(load, previous=before), made.solve(load, previous=before)
                    for start in (c.z(row, "initial"), c.z(solved, "initial")):
                        assert phi(start, s.weights) <= phi(safe, s.weights) * (1.0 + 1e-12)
                        left = np.abs(s.rows @ start + w).max()
                        assert left <= 1e-12 * count * (np.abs(start).max() + np.abs(w).max())
                    assert at(row, "code") == LIMIT
                    assert at(row, "margin") > 0.0
                    outside.add(at(row, "outside"))
                    assert at(row, "outside") == (np.linalg.norm(w) > 20.0)
                    if scale < 1e3:  # beyond, 1e-8 is more than Newton's last digits give
                        check(c, load, solved, 1e-8)
                    if before is None and size < 1.0:
                        length = np.sqrt(w @ w + 0.2**2)
                        o, t = (PAIRS @ w / length).reshape(2, 3)
                        lengths = np.sqrt(o * o + t * t + 0.05**2)
                        log, friction = (np.log(length) - 0.5) / 1.3, (0.5 - 0.4) / 0.12
                        features = np.array([*(w / length), log, *lengths, friction])
                        made_up = network_oracle.network(shape, weights, features)
                        force = null_space(s) @ (length * made_up) * s.scale.reshape(-1) - s.inverse @ w
                        x, near = c.z(row, "initial"), 1e-5 * np.abs(force).max()
                        kept = np.abs(x - safe).max() > 1e-12 * np.abs(safe).max()
                        assert at(row, "replaced") == (not kept)
                        told.add(kept)
                        if phi(force, s.weights) <= phi(safe, s.weights):
                            np.testing.assert_allclose(x, force, rtol=0, atol=near)
                        else:
                            best = min(phi(force, s.weights), phi(safe, s.weights))
                            assert at(row, "objective") <= best * (1 + 1e-12)
                previous = solved
    assert size >= 1.0 or True in told
    assert outside == {0.0, 1.0}


def test_a_good_previous_solution_is_taken_before_a_prediction() -> None:
    """Close to the optimum already: nothing is left to do. Without a wrench the own start is the optimum, which is no replacement."""
    c, load = case(4, "hard"), wrenches(np.random.default_rng(5), 1)[0]
    made = c.solver((4, 1), tolerance=1e-4, start=START["learned"], model=model(c.contacts, 1, 3.0)[2])
    before, _ = c.solver((4, 1), tolerance=1e-10).solve(1.0001 * load)
    row, _ = made.solve(load, previous=before)
    assert (at(row, "code"), at(row, "iterations"), at(row, "replaced")) == (CONVERGED, 0.0, 0.0)
    assert at(row, "start") == START["previous"]
    assert at(made.start(np.zeros(6)), "replaced") == 0.0


# --- what holds for all


ALGORITHMS = [
    ("newton", "hard"), ("newton", "own limits"), ("newton", "shared limits"), ("newton", "some soft"), ("newton", "soft limits"),
    ("reduced flow", "hard"), ("full flow", "hard"), ("sum", "hard"), ("sum", "soft limits"), ("largest", "hard"),
]  # fmt: skip
each_algorithm = pytest.mark.parametrize(("method", "kind"), ALGORITHMS)


@each_algorithm
@pytest.mark.parametrize(("layout", "count"), [((1, 0), 4), ((4, 1), 4), ((8, 0), 8), ((4, 1), 3), ((8, 0), 5)])
def test_answers_do_not_depend_on_earlier_calls(layout: tuple[int, int], count: int, method: str, kind: str) -> None:
    """Bit by bit, whatever the last call has left in the lanes that hold no contact; copies are independent; many are each alone."""
    c = case(count, kind)
    load, other = wrenches(np.random.default_rng(1), 2)
    made, again = (c.solver(layout, method, tolerance=1e-4, limit=30) for _ in range(2))
    wanted, _ = made.solve(load)
    copy = made.clone()
    for heavy in (1e-3, 1.0, 1e3, np.nan):
        again.solve(heavy * other)
        np.testing.assert_array_equal(again.solve(load)[0], wanted)
    made.solve(50.0 * other)
    np.testing.assert_array_equal(copy.solve(load)[0], wanted)
    del made
    np.testing.assert_array_equal(copy.solve(load)[0], wanted)
    loads = np.array([load, other, np.full(6, np.nan), 0.5 * load] * 4)
    for row, one in zip(copy.solve_many(loads), loads, strict=True):
        alone = copy.solve(one)[0]
        assert at(row, "code") == at(alone, "code")
        # side by side sums are taken in another order
        np.testing.assert_allclose(c.z(row), c.z(alone), rtol=0, atol=1e-7 * np.abs(c.z(alone)).max() + 1e-300)


@each_algorithm
@pytest.mark.parametrize("layout", LAYOUTS)
def test_wrenches_that_are_none_and_of_nothing(layout: tuple[int, int], method: str, kind: str) -> None:
    c = case(4, kind)
    made = c.solver(layout, method, tolerance=1e-4)
    good, _ = made.solve(np.ones(6) * 0.1)
    assert at(good, "code") == CONVERGED
    for k in range(6):
        for bad in (np.nan, np.inf, -np.inf, 1e13):
            row, _ = made.solve(np.where(np.arange(6) == k, bad, 0.1))
            assert at(row, "code") == REFUSED
            assert not row[FIELDS["force"] :].any()
    for nothing in (np.zeros(6), np.full(6, 1e-310), np.full(6, 1e-140)):
        row, _ = made.solve(nothing)
        assert at(row, "code") == CONVERGED
        assert np.isfinite(np.delete(row, FIELDS["lower_bound"])).all()
    np.testing.assert_array_equal(made.solve(np.ones(6) * 0.1)[0], good)


@pytest.mark.parametrize("method", ["newton", "reduced flow", "sum"])
@pytest.mark.parametrize("count", [4, 5, 9])
def test_contacts_of_a_call(count: int, method: str) -> None:
    """The answer of a solver made for them, whichever came before; the previous solution follows them in fewer steps."""
    s, rng, saved = sample(count), np.random.default_rng(count), 0.0
    positions, normals, load = s.positions, s.normals, wrenches(rng, 1)[0]
    every = [case(count, "hard").solver(layout, method, tolerance=1e-5) for layout in layouts(count)]
    before = [made.solve(load)[0] for made in every]
    for _ in range(8):
        positions = positions + 1.5e-4 * rng.standard_normal(positions.shape)
        normals = normals + 3e-3 * rng.standard_normal(normals.shape)
        normals = normals / np.linalg.norm(normals, axis=1)[:, None]
        load = load + 0.03 * wrenches(rng, 1)[0]
        there = Case(Sample(positions, normals, s.scale, s.weights), np.zeros(count))
        for k, (layout, made) in enumerate(zip(layouts(count), every, strict=True)):
            alone, _ = there.solver(layout, method, tolerance=1e-5).solve(load)
            row, _ = made.solve(load, positions=positions, normals=normals)
            assert at(row, "objective") == pytest.approx(at(alone, "objective"), rel=2e-5)
            frames = there.contacts.placement.arrays["frames"]
            np.testing.assert_array_equal(row[FIELDS["force"] + 7 * count :], frames.reshape(-1))
            follows, _ = made.solve(load, START["previous"], previous=before[k], positions=positions, normals=normals)
            for each in (row, follows):
                if method == "sum":
                    certified(there, load, each, 1e-5, False)
                else:
                    check(there, load, each, 1e-5)
            saved += at(row, "iterations") - at(follows, "iterations")
            before[k] = follows
    assert saved > 0.0 or method == "sum"


@pytest.mark.parametrize("method", ["newton", "reduced flow", "sum"])
@pytest.mark.parametrize("count", [4, 9])
def test_friction_of_a_call(count: int, method: str) -> None:
    """One coefficient, one of each contact or two; contacts that were without stay so."""
    c, load = case(count, "frictionless"), wrenches(np.random.default_rng(count), 1)[0]
    s, rubs = c.contacts, c.contacts.scale[:, 1] > 0.0
    rng = np.random.default_rng(count)
    for friction in (np.array([0.9]), rng.uniform(0.8, 1.2, count), rng.uniform(0.8, 1.2, (count, 2))):
        two = np.broadcast_to(friction[:, None] if friction.ndim == 1 else friction, (count, 2))
        mean = np.sqrt(two.prod(axis=1))[:, None]
        scale = np.where(rubs[:, None], np.column_stack([mean, mean / two]), [1.0, 0.0, 0.0])
        there = Case(Sample(s.positions, s.normals, scale, s.weights), np.zeros(count))
        for layout in layouts(count):
            made = c.solver(layout, method, tolerance=1e-6)
            row, _ = made.solve(load, friction=friction)
            wanted, _ = there.solver(layout, method, tolerance=1e-6).solve(load)
            assert at(row, "code") == at(wanted, "code") == CONVERGED
            assert at(row, "objective") == pytest.approx(at(wanted, "objective"), rel=2e-6)
            np.testing.assert_array_equal(c.forces(row)[0].reshape(-1, 3)[~rubs, 1:], 0.0)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("calls", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@each_algorithm
@pytest.mark.parametrize(("count", "layout"), [(4, (4, 1)), (16, (8, 0))])
def test_nothing_is_allocated(count: int, layout: tuple[int, int], method: str, kind: str, calls: int) -> None:
    """Optima, proofs and least excesses, on contacts that stay and that move."""
    assert (insides.known_allocations(0), insides.known_allocations(5)) == (0, 10)
    if method == "full flow" and count > 8:
        pytest.skip("the full flow is dense")
    calls //= {"full flow": 200, "reduced flow": 20, "largest": 20}.get(method, 20 if "limits" in kind else 1)
    loads = wrenches(np.random.default_rng(count), 24, of(kind))
    for elastic in (False, True) if "limits" in kind and method == "newton" else (False,):
        c = case(count, kind, 0, 4.0)
        made = c.solver(layout, method, tolerance=1e-4, limit=100, elastic=elastic)
        ends = {at(row, "code") for row in made.solve_many(loads)}
        assert ends & {CONVERGED, LIMIT}
        assert (count, kind) != (4, "own limits") or ends & {EXCEEDED, INFEASIBLE}
        assert made.allocations(loads, calls=calls) == 0
        rng = np.random.default_rng(0)
        points = c.contacts.positions + 1e-4 * rng.standard_normal((24, count, 3))
        normals = c.contacts.normals + 1e-3 * rng.standard_normal((24, count, 3))
        normals /= np.linalg.norm(normals, axis=2)[:, :, None]
        assert made.allocations(loads, points, normals, calls=calls // 2) == 0
    if (method, kind) == ("newton", "hard"):
        made = c.solver(layout, tolerance=1e-4, start=START["learned"], model=model(c.contacts, 1, 0.1)[2])
        assert made.allocations(loads, calls=calls) == 0
