"""`ForceOptimizer`: learned starts, contacts and friction of a call, independence of earlier calls,
no allocation."""

from __future__ import annotations

from itertools import pairwise

import _core_test as insides
import numpy as np
import pytest
from cases import FIELDS, REFUSED, START, Case, at, case
from oracles import network as network_oracle
from oracles.phi import phi
from samples import Sample, sample, wrenches
from test_certificates import certified
from test_optimizer import check, of

from grasp_env.force.record import CONVERGED, INFEASIBLE, LIMIT, LIMITS_EXCEEDED, STARTED, UNDECIDED


def single(a: np.ndarray) -> np.ndarray:
    return a.astype(np.float32).astype(np.float64)


def null_space(s: Sample) -> np.ndarray:
    """(3N, 3N - 6) internal forces."""
    return np.ascontiguousarray(np.linalg.svd(s.rows * s.scale.reshape(-1))[2][6:].T)


PAIRS = single(np.random.default_rng(9).standard_normal((6, 6)))
"""A linear stage from a wrench to three vectors, whose lengths are features."""


def model(s: Sample, seed: int, size: float) -> tuple[list[int], np.ndarray, insides.Model]:
    """Sizes, weights and model of a random network."""
    shape = [8 + 3, 16, 3 * s.count - 6]
    weights = size * np.random.default_rng(seed).standard_normal(
        sum((a + 1) * b for a, b in pairwise(shape))
    )
    weights = single(np.clip(weights, -3.4e38, 3.4e38))
    return shape, weights, insides.Model.make(shape, weights, PAIRS, null_space(s))


@pytest.mark.parametrize("size", [0.1, 3.0, 3e38])
@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_learned_start_is_the_networks_force_or_a_better_one(count, size):
    """For any weights it is balanced, inside and no worse than the method's own start, and Newton
    from it ends certified."""
    c = case(count, "hard")
    kept_values = set()
    outside = set()
    s = c.contacts
    for seed in range(2):
        shape, weights, trained = model(s, seed, size)
        solver = c.solver(tolerance=1e-8, start=START["learned"], model=trained)
        previous = None
        for scale in (1e-6, 1.0, 30.0, 1e4):
            load = wrenches(np.random.default_rng(seed), 1, scale)[0]
            w = s.unit @ load
            safe = c.z(solver.start(load, START["internal_force"]), "initial")
            for before in (None, previous):
                row = solver.start(load, previous=before)
                solved, _ = solver.solve(load, previous=before)
                for start in (c.z(row, "initial"), c.z(solved, "initial")):
                    assert phi(start, s.phi_weights) <= phi(safe, s.phi_weights) * (1.0 + 1e-12)
                    left = np.abs(s.rows @ start + w).max()
                    assert left <= 1e-12 * count * (np.abs(start).max() + np.abs(w).max())
                assert at(row, "code") == STARTED
                assert at(row, "margin") > 0.0
                outside.add(at(row, "outside"))
                assert at(row, "outside") == (np.linalg.norm(w) > 20.0)
                if scale < 1e3:  # beyond, Newton has fewer digits than 1e-8
                    check(c, load, solved, 1e-8)
                if before is None and size < 1.0:
                    length = np.sqrt(w @ w + 0.2**2)
                    o, t = (PAIRS @ w / length).reshape(2, 3)
                    lengths = np.sqrt(o * o + t * t + 0.05**2)
                    log = (np.log(length) - 0.5) / 1.3
                    friction = (0.5 - 0.4) / 0.12
                    features = np.array([*(w / length), log, *lengths, friction])
                    made_up = network_oracle.network(shape, weights, features)
                    force = null_space(s) @ (length * made_up) * s.scale.reshape(-1) - s.inverse @ w
                    # on the way from the safe start to the network's force, which leaves the cones
                    x = c.z(row, "initial")
                    way = force - safe
                    share = float((x - safe) @ way / (way @ way))
                    near = 1e-5 * share * np.abs(way).max() + 1e-12 * np.abs(safe).max()
                    np.testing.assert_allclose(x, safe + share * way, rtol=0, atol=near)
                    assert 0.0 <= share <= 1.0
                    kept = share > 0.0
                    assert at(row, "replaced") == (not kept)
                    kept_values.add(kept)
                    best = min(phi(force, s.phi_weights), phi(safe, s.phi_weights))
                    assert at(row, "objective") <= best * (1 + 1e-12)
            previous = solved
    assert size >= 1.0 or True in kept_values
    assert outside == {0.0, 1.0}


def test_a_good_previous_solution_is_taken_before_a_prediction():
    """Close to the optimum nothing is left to do.

    Without a wrench the own start is the optimum, which counts as no replacement.
    """
    c = case(4, "hard")
    load = wrenches(np.random.default_rng(5), 1)[0]
    solver = c.solver(tolerance=1e-4, start=START["learned"], model=model(c.contacts, 1, 3.0)[2])
    before, _ = c.solver(tolerance=1e-10).solve(1.0001 * load)
    row, _ = solver.solve(load, previous=before)
    assert (at(row, "code"), at(row, "iterations"), at(row, "replaced")) == (CONVERGED, 0.0, 0.0)
    assert at(row, "start") == START["previous"]
    assert at(solver.start(np.zeros(6)), "replaced") == 0.0


ALGORITHMS = [
    ("newton", "hard"),
    ("newton", "own limits"),
    ("newton", "shared limits"),
    ("newton", "some soft"),
    ("newton", "soft limits"),
    ("reduced flow", "hard"),
    ("full flow", "hard"),
    ("sum", "hard"),
    ("sum", "soft limits"),
    ("largest", "hard"),
]
counted = pytest.mark.skipif(
    not insides.counts_allocations, reason="the sanitizers have an operator new of their own"
)
each_algorithm = pytest.mark.parametrize(("method", "kind"), ALGORITHMS)


@each_algorithm
@pytest.mark.parametrize("count", [3, 4, 5])
def test_answers_do_not_depend_on_earlier_calls(count, method, kind):
    """Bit by bit, whatever the last call left in unused lanes; copies are independent, and so are
    the problems of a batch."""
    c = case(count, kind)
    load, other = wrenches(np.random.default_rng(1), 2)
    solver, again = (c.solver(method, tolerance=1e-4, limit=30) for _ in range(2))
    expected, _ = solver.solve(load)
    copy = solver.clone()
    for heavy in (1e-3, 1.0, 1e3, np.nan):
        again.solve(heavy * other)
        np.testing.assert_array_equal(again.solve(load)[0], expected)
    solver.solve(50.0 * other)
    np.testing.assert_array_equal(copy.solve(load)[0], expected)
    del solver
    np.testing.assert_array_equal(copy.solve(load)[0], expected)
    loads = np.array([load, other, np.full(6, np.nan), 0.5 * load] * 4)
    for row, one in zip(copy.solve_many(loads), loads, strict=True):
        alone = copy.solve(one)[0]
        assert at(row, "code") == at(alone, "code")
        # side by side sums are taken in another order
        np.testing.assert_allclose(
            c.z(row), c.z(alone), rtol=0, atol=1e-7 * np.abs(c.z(alone)).max() + 1e-300
        )


@each_algorithm
def test_bad_wrenches_are_refused_and_tiny_ones_are_solved(method, kind):
    c = case(4, kind)
    solver = c.solver(method, tolerance=1e-4)
    good, _ = solver.solve(np.ones(6) * 0.1)
    assert at(good, "code") == CONVERGED
    for k in range(6):
        for bad in (np.nan, np.inf, 1e13):
            row, _ = solver.solve(np.where(np.arange(6) == k, bad, 0.1))
            assert at(row, "code") == REFUSED
            assert not row[FIELDS["force"] :].any()
    for nothing in (np.zeros(6), np.full(6, 1e-310), np.full(6, 1e-140)):
        row, _ = solver.solve(nothing)
        assert at(row, "code") == CONVERGED
        assert np.isfinite(np.delete(row, FIELDS["lower_bound"])).all()
    np.testing.assert_array_equal(solver.solve(np.ones(6) * 0.1)[0], good)


@pytest.mark.parametrize("method", ["newton", "reduced flow", "full flow", "sum", "largest"])
def test_a_row_without_a_force_does_not_look_like_an_optimum_of_zero(method):
    """Refused wrenches, proofs, and weights of 1e300, with which every objective overflows; alone
    and side by side."""
    s = sample(4)
    load = wrenches(np.random.default_rng(0), 1)[0]
    palm = Sample(s.positions, np.tile([0.0, 0.0, 1.0], (4, 1)), s.scale, s.weights)
    heavy = Sample(s.positions, s.normals, s.scale, 1e300 * s.weights)
    for contacts, wrench, codes in (
        (s, np.full(6, np.nan), {REFUSED}),
        (palm, np.eye(6)[2], {INFEASIBLE}),
        (heavy, 1e11 * load, {REFUSED, UNDECIDED}),
    ):
        solver = Case(contacts, np.zeros(4)).solver(method, tolerance=1e-4)
        rows = [solver.solve(wrench)[0], *solver.solve_many(np.array([wrench] * 12))]
        for row in rows:
            assert at(row, "code") in codes
            assert at(row, "objective") == np.inf
            assert at(row, "lower_bound") == (np.inf if codes == {INFEASIBLE} else -np.inf)


@pytest.mark.parametrize("method", ["newton", "reduced flow", "sum"])
@pytest.mark.parametrize("count", [4, 9])
def test_contacts_of_a_call(count, method):
    s = sample(count)
    rng = np.random.default_rng(count)
    saved = 0.0
    positions = s.positions
    normals = s.normals
    load = wrenches(rng, 1)[0]
    solver = case(count, "hard").solver(method, tolerance=1e-5)
    before, _ = solver.solve(load)
    for _ in range(4):
        positions = positions + 1.5e-4 * rng.standard_normal(positions.shape)
        normals = normals + 3e-3 * rng.standard_normal(normals.shape)
        normals = normals / np.linalg.norm(normals, axis=1)[:, None]
        load = load + 0.03 * wrenches(rng, 1)[0]
        there = Case(Sample(positions, normals, s.scale, s.weights), np.zeros(count))
        alone, _ = there.solver(method, tolerance=1e-5).solve(load)
        row, _ = solver.solve(load, positions=positions, normals=normals)
        assert at(row, "objective") == pytest.approx(at(alone, "objective"), rel=2e-5)
        frames = there.contacts.placement.arrays["frames"]
        np.testing.assert_array_equal(
            row[FIELDS["force"] + 7 * count :][: 9 * count], frames.reshape(-1)
        )
        follows, _ = solver.solve(
            load, START["previous"], previous=before, positions=positions, normals=normals
        )
        for record in (row, follows):
            if method == "sum":
                certified(there, load, record, 1e-5, False)
            else:
                check(there, load, record, 1e-5)
        saved += at(row, "iterations") - at(follows, "iterations")
        before = follows
    assert saved > 0.0 or method == "sum"


@counted
@pytest.mark.parametrize("calls", [4_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@each_algorithm
@pytest.mark.parametrize("count", [4, 16])
def test_nothing_is_allocated(count, method, kind, calls):
    """Optima, proofs and least excesses, on contacts that stay or move."""
    assert (insides.known_allocations(0), insides.known_allocations(5)) == (0, 10)
    if method == "full flow" and count > 8:
        pytest.skip("the full flow is dense")
    calls //= {"full flow": 200, "reduced flow": 20, "largest": 20}.get(
        method, 20 if "limits" in kind else 1
    )
    loads = wrenches(np.random.default_rng(count), 24, of(kind))
    for elastic in (False, True) if "limits" in kind and method == "newton" else (False,):
        c = case(count, kind, 0, 4.0)
        solver = c.solver(method, tolerance=1e-4, limit=100, elastic=elastic)
        ends = {at(row, "code") for row in solver.solve_many(loads)}
        assert ends & {CONVERGED, LIMIT}
        assert (count, kind) != (4, "own limits") or ends & {LIMITS_EXCEEDED, INFEASIBLE}
        assert solver.allocations(loads, calls=calls) == 0
        rng = np.random.default_rng(0)
        points = c.contacts.positions + 1e-4 * rng.standard_normal((24, count, 3))
        normals = c.contacts.normals + 1e-3 * rng.standard_normal((24, count, 3))
        normals /= np.linalg.norm(normals, axis=2)[:, :, None]
        assert solver.allocations(loads, points, normals, calls=calls // 2) == 0
    if (method, kind) == ("newton", "hard"):
        solver = c.solver(
            tolerance=1e-4, start=START["learned"], model=model(c.contacts, 1, 0.1)[2]
        )
        assert solver.allocations(loads, calls=calls) == 0


@counted
@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("gamma", [0.0, 0.01])
@pytest.mark.parametrize("method", ["newton", "sum", "largest"])
def test_nothing_is_allocated_over_the_edge_of_supports(method, gamma, limited):
    """Weights above the line between two of three supports and next to it, where the boundary is
    found and left."""
    supports = np.array([[0.05, 0.0, 0.0], [-0.05, 0.05, 0.0], [-0.05, -0.05, 0.0]])
    flat = Sample(
        supports,
        np.tile([0.0, 0.0, 1.0], (3, 1)),
        np.tile([0.5, 1.0, 1.0], (3, 1)),
        np.tile([1.0, 0.01], (3, 1)),
    )
    limits = {"max_normal": np.full(3, 1e3)} if limited else {}
    solver = Case(flat, np.full(3, gamma), limits).solver(method, tolerance=1e-4)
    beyond = np.array([-1e-3, -1e-9, -1e-12, 0.0, 1e-12, 1e-6])
    loads = np.outer(np.ones(6), [0.0, 0.0, -5.0, 0.0, 0.0, 0.0])
    loads[:, 4] = -5.0 * (0.05 + beyond)
    assert [at(solver.solve(load)[0], "code") for load in loads] == [CONVERGED] * 5 + [INFEASIBLE]
    assert solver.allocations(loads, calls=60) == 0
