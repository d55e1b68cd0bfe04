"""`ForceOptimizer`: proofs that no force exists, least excesses of limits, the least sum and
maximum of the normal forces."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from cases import FIELDS, START, Case, at, case, nu_of, own_limits, shared_limits
from oracles import conic
from samples import COUNTS, sample, wrenches
from scipy.optimize import linprog
from test_optimizer import HARD, of

from grasp_env.force.record import CONVERGED, INFEASIBLE, LIMIT, LIMITS_EXCEEDED

TIGHT = [(3, "own", 0), (9, "own", 0), (4, "own", 1), (4, "shared", 0), (5, "soft", 0)]


def tight(count: int, what: str, free: int, seed: int) -> Case:
    """Limits that about half of the wrenches of 2 N exceed. free: contacts without a limit."""
    s = sample(count)
    if what == "own":
        return Case(s, np.zeros(count), own_limits(s, seed, 1.0, full=True, free=free))
    gamma = case(count, "some soft").gamma if what == "soft" else np.zeros(count)
    return Case(s, gamma, shared_limits(s, seed, 6.0))


def least_over(c: Case, load: np.ndarray, cost: np.ndarray, *, inside: bool, elastic: bool):
    """linprog over pyramids around or inside the cones; elastic: the last variable is the excess of
    balanced forces."""
    facets, bound = c.pyramids(inside=inside)
    others = facets.shape[1] - c.matrix.shape[1]
    if not elastic:
        padded = np.pad(cost, (0, others))
        return linprog(padded, A_ub=facets, b_ub=bound, bounds=(None, None), method="highs")
    wider = np.zeros(len(facets))
    first = len(facets) - len(c.terms.rows)
    wider[first : first + len(c.own[2])] = c.own[2]
    return linprog(
        np.concatenate([cost[:-1], np.zeros(others), cost[-1:]]),
        A_ub=np.column_stack([facets, -wider]),
        b_ub=bound,
        A_eq=np.pad(c.matrix, [(0, 0), (0, others + 1)]),
        b_eq=-(c.contacts.unit @ load),
        bounds=(None, None),
        method="highs",
    )


@pytest.mark.parametrize(("count", "what", "free"), TIGHT)
def test_infeasible_is_proven_or_exceeded_least(count, what, free):
    """A twist v proves infeasibility: v .

    w exceeds -v . G f for every force within the limits and pyramids around the cones.

    An elastic excess is within 1 % of the least one over pyramids, and its multipliers are a slope
    below it.
    """
    proofs, exceeded, feasible = 0, 0, 0
    for k, load in enumerate(wrenches(np.random.default_rng(100 + count), 12, 2.0)):
        c = tight(count, what, free, k)
        s = c.contacts
        row, soft = (c.solver(elastic=elastic).solve(load)[0] for elastic in (False, True))
        if at(row, "code") != INFEASIBLE:
            assert at(soft, "code") == at(row, "code")
            assert at(row, "code") != CONVERGED or c.excess(c.z(row)) == 0.0
            feasible += 1
            continue
        twist = nu_of(row)
        _, multipliers = c.torques_and_multipliers(row)
        assert np.abs(twist).max() == pytest.approx(1.0)
        assert (multipliers >= 0.0).all()
        np.testing.assert_array_equal(row[FIELDS["force"] : len(row) - len(multipliers)], 0.0)
        # a proof touches the cone of a contact that has no limit
        pull = np.linalg.solve(s.unit, c.matrix).T @ twist
        least = least_over(c, load, pull, inside=free > 0, elastic=False)
        if least.status != 3:  # unbounded: pyramids of 64 facets decide nothing
            assert least.status == 2 or twist @ load + least.fun > -2e-3 * abs(twist @ load)
            proofs += least.status == 2 or twist @ load + least.fun > 0.0
        if at(soft, "code") != LIMITS_EXCEEDED:
            continue
        exceeded += 1
        z = c.z(soft)
        t = at(soft, "limit_excess")
        low = at(soft, "lower_bound")
        assert at(soft, "objective") == t == pytest.approx(c.excess(z), rel=1e-9)
        assert 0.0 < low <= t <= max(1.01 * low, low + 1e-6)
        assert np.abs(c.matrix @ z + s.unit @ load).max() < 1e-9 * np.abs(z).max()
        assert (c.margins(z) > 0.0).all()
        last = np.append(np.zeros(len(z)), 1.0)
        # 64 facets around a cone are 0.12 % wider: they may exceed less, and by little
        around, within = (
            least_over(c, load, last, inside=inside, elastic=True) for inside in (False, True)
        )
        assert around.fun <= t * (1.0 + 1e-9)
        assert low == pytest.approx(around.fun, rel=0.02, abs=2e-3)
        assert low <= within.fun * (1.0 + 1e-9)
        for share in (0.3, -0.3) if what == "own" and free == 0 else ():
            other = least_over(c, (1.0 + share) * load, last, inside=True, elastic=True)
            assert other.fun >= low - share * float(nu_of(soft) @ load) - 1e-6
        solver = c.solver(elastic=True)
        again, _ = solver.solve(load)
        for scale in (1.001, 0.7, 0.1):  # on the way back within the limits
            fresh, after = (
                solver.solve(scale * load, *more)[0]
                for more in ((), (START["previous"], None, None, again))
            )
            assert at(after, "code") == at(fresh, "code")
            assert at(after, "limit_excess") == pytest.approx(
                at(fresh, "limit_excess"), rel=0.0202, abs=2e-6
            )
    assert proofs >= 3
    assert exceeded >= 3
    assert feasible >= (what != "own")


@pytest.mark.parametrize(
    ("count", "kind"), [(3, "hard"), (9, "hard"), (8, "frictionless"), (6, "thin")]
)
def test_iterations_of_the_least_sum_are_the_oracles(count, kind):
    c = case(count, kind)
    s = c.contacts
    for load in wrenches(np.random.default_rng(count), 2, 3.0):
        unit = s.unit @ load
        size = float(np.abs(unit).max())
        program = conic.of_grasp(s.rows, unit / size, s.divisor, s.weights[:, 0])
        rows = [c.solver("sum", tolerance=1e-15, limit=k).solve(load)[0] for k in range(1, 5)]
        # the start is the core's own
        x = c.z(rows[0], "initial") / size
        point = conic.Iterate(x, program.cost.copy(), np.zeros(6))
        assert np.abs(s.rows @ x + unit / size).max() <= 1e-12 * np.abs(x).max()
        seen = []
        for k, row in enumerate(rows):
            point = conic.iteration(program, point)
            assert (at(row, "code"), at(row, "iterations")) == (LIMIT, k + 1)
            force, _ = c.forces(row)
            near = 1e-8 * np.abs(force).max()
            np.testing.assert_allclose(
                force, size * point.x / s.divisor.reshape(-1), rtol=0, atol=near
            )
            # y of the record is scaled onto the boundary of its set
            bound, nu = conic.certified_bound(program, point.y)
            np.testing.assert_allclose(
                nu_of(row), s.unit.T @ nu, rtol=0, atol=1e-7 * np.abs(s.unit.T @ nu).max()
            )
            assert at(row, "lower_bound") == pytest.approx(size * bound, rel=1e-7, abs=near)
            seen.append(force)
        assert all(  # every iteration moved
            np.abs(b - a).max() > 1e-6 * np.abs(b).max() for a, b in pairwise(seen)
        )


def certified(c: Case, load: np.ndarray, row: np.ndarray, tolerance: float, largest: bool) -> None:
    """Check a record: balanced, within cones and limits, with a bound that weak duality proves from
    multipliers of balance and limits."""
    s = c.contacts
    z = c.z(row)
    w = s.unit @ load
    omega = s.weights[:, 0]
    weighed = omega * c.forces(row)[0][0::3]
    assert at(row, "code") == CONVERGED
    assert at(row, "objective") == pytest.approx(
        weighed.max() if largest else weighed.sum(), rel=1e-9
    )
    size = np.abs(z).max() + np.abs(w).max()
    near = 1e-13 if c.terms.rows.size == 0 and not largest else 1e-9
    assert np.abs(c.matrix @ z + w).max() <= near * c.count * size
    assert at(row, "margin") >= 0.0
    assert c.excess(z) <= 1e-9
    # c - G^T nu + A^T y must be in the dual cones, y the multipliers of the limits
    price = c.torques_and_multipliers(row)[1] * c.sizes
    pull = c.matrix.T @ np.linalg.solve(s.unit.T, nu_of(row)) - c.own[0].T @ price
    pulls = pull.reshape(c.count, -1)
    need = pulls[:, 0] + np.hypot.reduce(pulls[:, 1:], axis=1)
    need *= s.divisor[:, 0] / omega
    most = np.maximum(need, 0.0).sum() if largest else need.max()
    value = -nu_of(row) @ load - price @ c.own[1]
    low = at(row, "lower_bound")
    assert most <= 1.0 + 1e-6
    assert low <= max(0.0, value / max(1.0, most)) * (1.0 + 1e-5) + 1e-12
    assert low <= at(row, "objective") <= low * (1.0 + tolerance * (1.0 + 1e-9)) + 1e-300


@pytest.mark.parametrize("kind", [*HARD, "thin"])
@pytest.mark.parametrize("count", COUNTS)
def test_the_least_sum_is_certified(count, kind):
    # three contacts nearly on a line have hardly any internal force
    c = case(count, "hard" if (count, kind) == (3, "thin") else kind)
    rng = np.random.default_rng(count)
    for size in (1e-6, 1.0, 1e4):
        load = wrenches(rng, 1, size)[0]
        certified(c, load, c.solver("sum", tolerance=1e-6).solve(load)[0], 1e-6, False)


@pytest.mark.parametrize("method", ["sum", "largest"])
@pytest.mark.parametrize(
    "kind", ["some soft", "own limits", "shared limits", "soft limits", "hard"]
)
@pytest.mark.parametrize("count", [4, 9])
def test_least_forces_are_certified_or_proven_not_to_exist(count, kind, method):
    c = case(count, kind)
    found = 0
    for load in wrenches(np.random.default_rng(count), 4, of(kind)):
        row, _ = c.solver(method, tolerance=1e-8).solve(load)
        if at(row, "code") == INFEASIBLE:
            assert c.minimum(load) is None
            continue
        found += 1
        certified(c, load, row, 1e-8, method == "largest")
    assert found
