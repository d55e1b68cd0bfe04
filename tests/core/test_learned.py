"""Networks against plain numpy, and the guarantee of the starts that they predict, whatever the weights."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import network as oracle
from oracles import newton
from oracles.phi import phi
from samples import Sample, layouts, sample, wrenches
from test_newton import BOUND, CODE, CONVERGED, ITERATIONS, LIMIT, MARGIN, OBJECTIVE, REFUSED, RESIDUAL, check

from grasp_env.force.record import FORCE

SIZES = [
    [1, 1], [8, 6], [8, 32, 6], [8, 64, 64, 6], [8, 96, 96, 6], [3, 5, 7, 9, 11], [8, 130, 33, 1], [17, 1, 40], [1024, 2], [2, 1024],
    [4] * 9,
]  # fmt: skip
"""Networks of every filling of registers of 4, 8 and 16."""


def single(a: np.ndarray) -> np.ndarray:
    return a.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_a_network_is_that_of_numpy(sizes: list[int]) -> None:
    rng = np.random.default_rng(len(sizes))
    weights = single(rng.standard_normal(insides.network_numbers(sizes)) / np.sqrt(max(sizes)))
    for x in single(rng.standard_normal((5, sizes[0]))):
        expected = oracle.network(sizes, weights, x)
        # float32: rounding of sums of a thousand terms
        np.testing.assert_allclose(
            insides.network(sizes, weights, x), expected, atol=3e-6 * max(1.0, np.abs(expected).max())
        )


@pytest.mark.parametrize(
    "sizes", [[], [8], [8, 0, 6], [8, -1, 6], [8, 1025, 6], [4] * 10, [2**31 - 1, 2**31 - 1]], ids=str
)
def test_sizes_beyond_the_bounds_have_no_numbers(sizes: list[int]) -> None:
    assert insides.network_numbers(sizes) == 0


def null_space(s: Sample) -> np.ndarray:
    """(3N, 3N - 6) internal forces."""
    return np.ascontiguousarray(np.linalg.svd(s.rows * s.scale.reshape(-1))[2][6:].T)


def learned(
    s: Sample, layout: tuple[int, int], seed: int, size: float = 0.3, tolerance: float = 1e-8, hidden: tuple[int, ...] = (16, 16)
):  # fmt: skip
    """Starts of a network with random weights of that size."""
    shape = [8, *hidden, 3 * s.count - 6]
    weights = size * np.random.default_rng(seed).standard_normal(insides.network_numbers(shape))
    return insides.AnyLearned.make(
        *layout, s.placement, tolerance, 500, s.basis, shape, np.clip(weights, -3.4e38, 3.4e38), null_space(s)
    )


def starting(s: Sample, row: np.ndarray, at: int = FORCE) -> np.ndarray:
    return (row[at : at + 3 * s.count].reshape(-1, 3) * s.scale).reshape(-1)


@pytest.mark.parametrize("size", [0.1, 3.0, 1e4, 1e20, 3e38])
@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_start_is_never_worse_than_the_combination_whatever_the_weights(count: int, size: float) -> None:
    """Nor than the previous optimum carried over; balanced, inside; and Newton from it ends certified."""
    s = sample(count)
    for layout in layouts(count)[-2:]:
        for seed in range(3):
            made = learned(s, layout, seed, size)
            previous = None
            for scale in (1e-6, 1e-2, 1.0, 30.0, 1e4):
                for w in wrenches(np.random.default_rng(seed), 3, scale):
                    safe = phi(newton.combine(s.basis, w), s.weights)
                    for before in (None, previous):
                        row, solved = made.start(w, before), made.solve(w, before)
                        x, first = starting(s, row), starting(s, solved, FORCE + 3 * count)
                        force = np.abs(x).max() + np.abs(s.unit @ w).max()
                        for start in (x, first):
                            assert phi(start, s.weights) <= safe * (1.0 + 1e-12)
                            assert np.abs(s.rows @ start + s.unit @ w).max() <= 1e-12 * count * force
                        assert row[CODE] in (CONVERGED, LIMIT)
                        assert row[MARGIN] > 0.0
                        assert row[RESIDUAL] <= 1e-12 * count * force
                        if scale < 1e3:  # beyond, 1e-8 is more than Newton's last digits give
                            check(s, w, solved, 1e-8)
                        assert row[BOUND] <= solved[OBJECTIVE] * (1.0 + 1e-11)
                    previous = solved[FORCE : FORCE + 3 * count]


@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_a_prediction_is_the_networks_force(count: int) -> None:
    s = sample(count)
    shape = [8, 16, 3 * count - 6]
    weights = single(0.3 * np.random.default_rng(7).standard_normal(insides.network_numbers(shape)))
    for layout in layouts(count):
        made = learned(s, layout, 7, hidden=(16,))
        for w in wrenches(np.random.default_rng(count), 4):
            parts = w / np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05])
            size = np.sqrt(parts @ parts + 0.2**2)
            features = np.array([*(parts / size), (np.log(size) - 0.5) / 1.3, (0.5 - 0.4) / 0.12])
            force = -(s.inverse / s.scale.reshape(-1)[:, None]) @ (s.unit @ w)
            force += null_space(s) @ (size * oracle.network(shape, weights, features))
            good, found = made.predict(w)
            assert good
            np.testing.assert_allclose(found, force, atol=1e-5 * np.abs(force).max())
            row = made.start(w)
            x, x0 = (force.reshape(-1, 3) * s.scale).reshape(-1), newton.combine(s.basis, w)
            if phi(x, s.weights) <= phi(x0, s.weights):
                np.testing.assert_allclose(starting(s, row), x, atol=1e-5 * np.abs(x).max())
            else:
                assert row[OBJECTIVE] <= min(phi(x0, s.weights), phi(x, s.weights)) * (1 + 1e-12)


def test_a_good_previous_solution_is_taken() -> None:
    """Close to the optimum already: nothing is left to do, whatever the weights say."""
    s, w = sample(4), wrenches(np.random.default_rng(5), 1)[0]
    made = learned(s, (4, 1), 1, 3.0, tolerance=1e-4)
    best, _ = s.minimum(1.0001 * w)
    row = made.solve(w, (best.reshape(-1, 3) / s.divisor).reshape(-1))
    assert row[CODE] == CONVERGED
    assert row[ITERATIONS] == 0
    assert not made.replaced


def test_numbers_that_are_not_finite_are_refused() -> None:
    s = sample(4)
    made = learned(s, (4, 1), 1)
    for wrong in (np.nan, np.inf, 1e13):
        w = np.array([0.0, wrong, 0.0, 0.0, 0.0, 0.0])
        assert made.start(w)[CODE] == made.solve(w)[CODE] == REFUSED
        assert not made.predict(w)[0]
        assert not made.covers(w)
    for wrong in (np.nan, np.inf, 1e300, -1.0):  # a previous force that is none: not used
        assert made.solve(np.eye(6)[0], np.full(12, wrong))[CODE] == CONVERGED


def test_what_training_covered() -> None:
    made = learned(sample(4), (4, 1), 1)
    for w in wrenches(np.random.default_rng(0), 100, 10.0):
        size = np.linalg.norm(w / np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05]))
        assert made.covers(w) == (size <= 20.0)


def test_layouts_and_clones_agree() -> None:
    s = sample(4)
    every = [learned(s, layout, 2, 0.1, 1e-10) for layout in layouts(4)]
    for w in wrenches(np.random.default_rng(2), 5):
        rows = [made.solve(w) for made in every]
        np.testing.assert_array_equal(every[0].clone().solve(w), rows[0])
        for row in rows[1:]:
            np.testing.assert_allclose(
                row[FORCE : FORCE + 12],
                rows[0][FORCE : FORCE + 12],
                rtol=0,
                atol=1e-4 * np.abs(rows[0][FORCE : FORCE + 12]).max(),
            )


def test_a_start_of_which_nothing_is_kept_is_told() -> None:
    """Then, and only then, it is the combination; without a wrench that is the optimum, which is no replacement."""
    s, told = sample(4), set()
    for seed in range(6):
        made = learned(s, (4, 1), seed, 3.0)
        for w in wrenches(np.random.default_rng(seed), 10):
            x, safe = starting(s, made.start(w)), newton.combine(s.basis, w)
            assert made.replaced == (np.abs(x - safe).max() <= 1e-12 * np.abs(safe).max())
            told.add(made.replaced)
        made.start(np.zeros(6))
        assert not made.replaced
    assert told == {True, False}
