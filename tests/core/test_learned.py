"""Networks and learned layers against plain numpy, and the guarantee of the starts that are made of them, whatever the weights."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from oracles import layers as oracle
from oracles import newton
from oracles.phi import lower_bound, phi
from samples import COUNTS, Sample, layouts, sample, wrenches
from test_newton import BOUND, CODE, CONVERGED, ITERATIONS, LIMIT, MARGIN, OBJECTIVE, REFUSED, RESIDUAL, check
from test_pipeline import initial_of, path, pipeline

WIDTH = 8
NOTHING = np.zeros(0)
SIZES = [
    [1, 1], [8, 6], [8, 32, 6], [8, 64, 64, 6], [8, 96, 96, 6], [3, 5, 7, 9, 11], [8, 130, 33, 1], [17, 1, 40], [1024, 2], [2, 1024],
    [4] * 9,
]  # fmt: skip
"""Networks of every filling of registers of 4, 8 and 16."""


def random_layers(rng: np.random.Generator, count: int, width: int = WIDTH, size: float = 0.1) -> np.ndarray:
    return size * rng.standard_normal((count, insides.layer_numbers(width)))


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


def test_widths_beyond_the_bounds_have_no_numbers() -> None:
    assert [insides.layer_numbers(width) for width in (-1, 0, 1025, 2**31 - 1)] == [0, 0, 0, 0]
    assert insides.layer_numbers(32) == 12 * 32 + 65 * 32 + 99


@pytest.mark.parametrize("width", [1, 3, 16, 32, 33])
@pytest.mark.parametrize("count", [1, 3, 4, 5, 9, 17])
def test_a_perceptron_is_that_of_numpy(count: int, width: int) -> None:
    rng = np.random.default_rng([count, width])
    weights, features = single(random_layers(rng, 2, width, 0.5)), single(rng.standard_normal((count, oracle.FEATURES)))
    for k in range(2):
        expected = oracle.perceptron(width, weights[k], features)
        said = insides.perceptron(width, weights, k, features).reshape(-1, 3)
        np.testing.assert_allclose(said, expected, atol=1e-5 * max(1.0, np.abs(expected).max()))


def beginning(s: Sample, w: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A balanced force inside the cones, some way from the optimum."""
    best, _ = s.minimum(w)
    return best + rng.uniform(0.3, 1.5) * s.rest


@pytest.mark.parametrize("count", [n for n in COUNTS if n <= 9])
@pytest.mark.parametrize("learned", [True, False])
def test_a_layer_is_that_of_numpy_in_every_layout(count: int, learned: bool) -> None:
    """Where it lowers Phi, so that it is taken at its full length; without weights it is a Newton step, shortened."""
    s, rng, taken = sample(count), np.random.default_rng(count), 0
    for w in wrenches(rng, 4):
        numbers = random_layers(rng, 1, size=0.1 if learned else 0.0)
        x = beginning(s, w, rng)
        expected, multipliers = oracle.layer(x, s.rows, s.rest, s.weights, WIDTH, numbers[0])
        if not phi(expected, s.weights) < phi(x, s.weights):
            continue
        taken += 1
        for lanes in (1, 2, 4, 8):
            found, value, nu = insides.refine(lanes, s.placement, WIDTH, numbers, s.rest, 0.0, 0, 1, x)
            # the perceptron is float32
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
            assert value == pytest.approx(phi(found, s.weights), rel=1e-12)
            np.testing.assert_allclose(nu, multipliers, rtol=0, atol=1e-7 * np.abs(multipliers).max())
            assert np.abs(s.rows @ found + s.unit @ w).max() < 1e-9 * np.abs(found).max()
    assert taken >= 2


def test_a_force_along_its_normal_has_a_layer_too() -> None:
    """Two fingers that press on each other: no tangential force, so no direction of it."""
    s = sample(4)
    x = np.zeros(12)
    x[0::3] = 1.0
    found, value, nu = insides.refine(
        4, s.placement, WIDTH, random_layers(np.random.default_rng(0), 3), s.rest, 0.0, 0, 3, x
    )
    assert np.isfinite(found).all()
    assert np.isfinite(nu).all()
    assert value <= phi(x, s.weights)
    expected, _ = oracle.layer(x, s.rows, s.rest, s.weights, WIDTH, zero := np.zeros(insides.layer_numbers(WIDTH)))
    plain = insides.refine(4, s.placement, WIDTH, zero[None], s.rest, 0.0, 0, 1, x)[0]
    assert phi(expected, s.weights) < phi(x, s.weights)
    np.testing.assert_allclose(plain, expected, atol=1e-6)


@pytest.mark.parametrize("size", [1e-2, 1.0, 1e3, 1e30, 3e38])
def test_layers_of_any_weights_only_lower_phi_and_keep_balance(size: float) -> None:
    s, rng = sample(5), np.random.default_rng(3)
    for w in wrenches(rng, 20):
        x = beginning(s, w, rng)
        numbers = np.clip(random_layers(rng, 6, size=size), -3.4e38, 3.4e38)
        for k in range(6):
            before = phi(x, s.weights)
            x, value, _ = insides.refine(8, s.placement, WIDTH, numbers, s.rest, 0.0, k, k + 1, x)
            assert value == pytest.approx(phi(x, s.weights), rel=1e-12)
            assert value <= before * (1.0 + 1e-14)  # summed in another order
        # each is a Newton step at worst: six of them come close
        assert value <= (1.0 + 0.5) * phi(s.minimum(w)[0], s.weights)
        assert np.abs(s.rows @ x + s.unit @ w).max() < 1e-8 * np.abs(x).max()


def test_layers_stop_where_they_have_settled() -> None:
    s, w = sample(4), wrenches(np.random.default_rng(1), 1)[0]
    best, multipliers = s.minimum(w)
    x, value, nu = insides.refine(
        4, s.placement, WIDTH, random_layers(np.random.default_rng(0), 2), s.rest, 1e-6, 0, 2, best
    )
    np.testing.assert_array_equal(x, best)
    np.testing.assert_allclose(nu, multipliers, atol=1e-6 * np.abs(multipliers).max())
    assert lower_bound(nu, s.rows, s.unit @ w, s.weights) == pytest.approx(value, rel=1e-9)


def null_space(s: Sample) -> np.ndarray:
    """(3N, 3N - 6) internal forces."""
    return np.ascontiguousarray(np.linalg.svd(s.rows * s.scale.reshape(-1))[2][6:].T)


def learned(
    s: Sample, layout: tuple[int, int], seed: int, sizes: list[int] | None = None, size: float = 0.3, layers: int = 0,
    tolerance: float = 1e-8, limit: int = 500,
):  # fmt: skip
    """Starts of a network and of layers with random weights of that size."""
    rng, outputs = np.random.default_rng(seed), 3 * s.count - 6
    shape = [8, *(sizes or []), outputs] if sizes is not None else []
    weights = size * rng.standard_normal(insides.network_numbers(shape) if shape else 0)
    return insides.AnyLearned.make(
        *layout, s.placement, tolerance, limit, s.basis, shape, np.clip(weights, -3.4e38, 3.4e38), null_space(s), WIDTH,
        np.clip(random_layers(rng, layers, size=size), -3.4e38, 3.4e38) if layers else NOTHING,
    )  # fmt: skip


KINDS = {"network": ([16, 16], 0), "layers": (None, 3), "both": ([16], 2), "none": (None, 0)}
kinds = pytest.mark.parametrize("kind", KINDS)


def starting(s: Sample, row: np.ndarray, at: int = 20) -> np.ndarray:
    return (row[at : at + 3 * s.count].reshape(-1, 3) * s.scale).reshape(-1)


@kinds
@pytest.mark.parametrize("size", [0.1, 3.0, 1e4, 1e20, 3e38])
@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_start_is_never_worse_than_the_combination_whatever_the_weights(count: int, size: float, kind: str) -> None:
    """Nor than the previous optimum carried over; balanced, inside; and Newton from it ends certified."""
    s, (sizes, layers) = sample(count), KINDS[kind]
    for layout in layouts(count)[-2:]:
        for seed in range(3):
            made = learned(s, layout, seed, sizes, size, layers)
            previous = None
            for scale in (1e-6, 1e-2, 1.0, 30.0, 1e4):
                for w in wrenches(np.random.default_rng(seed), 3, scale):
                    safe = phi(newton.combine(s.basis, w), s.weights)
                    for before in (None, previous):
                        row, solved = made.start(w, before), made.solve(w, before)
                        x, first = starting(s, row), starting(s, solved, 20 + 3 * count)
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
                    previous = solved[20 : 20 + 3 * count]


@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_a_prediction_is_the_networks_force(count: int) -> None:
    s = sample(count)
    shape = [8, 16, 3 * count - 6]
    weights = single(0.3 * np.random.default_rng(7).standard_normal(insides.network_numbers(shape)))
    for layout in layouts(count):
        made = learned(s, layout, 7, [16])
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


@kinds
def test_a_good_previous_solution_is_taken(kind: str) -> None:
    """Close to the optimum already: nothing is left to do, whatever the weights say."""
    s, w = sample(4), wrenches(np.random.default_rng(5), 1)[0]
    sizes, layers = KINDS[kind]
    made = learned(s, (4, 1), 1, sizes, 3.0, layers, tolerance=1e-4)
    best, _ = s.minimum(1.0001 * w)
    row = made.solve(w, (best.reshape(-1, 3) / s.divisor).reshape(-1))
    assert row[CODE] == CONVERGED
    assert row[ITERATIONS] == 0


@kinds
def test_numbers_that_are_not_finite_are_refused(kind: str) -> None:
    s = sample(4)
    made = learned(s, (4, 1), 1, KINDS[kind][0], 0.3, KINDS[kind][1])
    for wrong in (np.nan, np.inf, 1e13):
        w = np.array([0.0, wrong, 0.0, 0.0, 0.0, 0.0])
        assert made.start(w)[CODE] == made.solve(w)[CODE] == REFUSED
        assert not made.predict(w)[0]
        assert not made.covers(w)
    for wrong in (np.nan, np.inf, 1e300, -1.0):  # a previous force that is none: not used
        assert made.solve(np.eye(6)[0], np.full(12, wrong))[CODE] == CONVERGED


def test_what_training_covered() -> None:
    made = learned(sample(4), (4, 1), 1, [4])
    for w in wrenches(np.random.default_rng(0), 100, 10.0):
        size = np.linalg.norm(w / np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05]))
        assert made.covers(w) == (size <= 20.0)


@kinds
def test_layouts_and_clones_agree(kind: str) -> None:
    s, (sizes, layers) = sample(4), KINDS[kind]
    every = [learned(s, layout, 2, sizes, 0.1, layers, 1e-10) for layout in layouts(4)]
    for w in wrenches(np.random.default_rng(2), 5):
        rows = [made.solve(w) for made in every]
        np.testing.assert_array_equal(every[0].clone().solve(w), rows[0])
        for row in rows[1:]:
            np.testing.assert_allclose(row[20:32], rows[0][20:32], rtol=0, atol=1e-4 * np.abs(rows[0][20:32]).max())


@pytest.mark.parametrize("remembers", [True, False])
@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_pipeline_starts_from_its_layers(count: int, remembers: bool) -> None:
    """On moving contacts: what the layers make of the combination of now, or of the last optimum; never worse."""
    s = sample(count)
    numbers = random_layers(np.random.default_rng(count), 2)
    plain, made = (pipeline(s, layouts(count)[-1], remembers, tolerance=1e-3) for _ in range(2))
    made.set_layers(WIDTH, numbers)
    for there, w in path(s, 8, 3e-3):
        row, other = (each.solve(there.positions, there.normals, w) for each in (made, plain))
        x, x0 = initial_of(there, row), initial_of(there, other)
        assert phi(x, s.weights) <= phi(x0, s.weights) * (1.0 + 1e-12)
        assert np.abs(there.rows @ x + there.unit @ w).max() <= 1e-12 * count * np.abs(x).max()
        if not remembers:
            rest = newton.tangent_correction(s.rest, there.rows, np.zeros(6), s.weights)
            every = [x0]
            for layer in numbers:
                every.append(oracle.layer(every[-1], there.rows, rest, s.weights, WIDTH, single(layer))[0])
            if (np.diff([phi(each, s.weights) for each in every]) < 0.0).all():  # elsewhere steps are halved
                # the rest force is turned, not corrected: a few thousandths of a feature
                assert phi(x, s.weights) == pytest.approx(phi(every[-1], s.weights), rel=1e-2)
        assert row[CODE] == other[CODE] == CONVERGED
        assert row[OBJECTIVE] == pytest.approx(other[OBJECTIVE], rel=1.1e-3)
