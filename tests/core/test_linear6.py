"""Six equations: L D L^T against numpy, over all condition numbers, and where there is none."""

from __future__ import annotations

from fractions import Fraction

import _core_test as insides
import numpy as np
import pytest

LOWER = np.tril_indices(6)


def definite(rng: np.random.Generator, condition: float) -> np.ndarray:
    basis = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    matrix = (basis * np.geomspace(1.0, 1.0 / condition, 6)) @ basis.T
    return 0.5 * (matrix + matrix.T)


@pytest.mark.parametrize("condition", [1.0, 1e2, 1e6, 1e10, 1e13])
@pytest.mark.parametrize("scale", [1.0, 1e-8, 1e8, 1e-150, 1e150])
def test_factor_and_solve_are_numpys(condition: float, scale: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(40):
        matrix, b = scale * definite(rng, condition), rng.standard_normal(6)
        least, packed = insides.factor(matrix)
        factor = np.zeros((6, 6))
        factor[LOWER] = packed
        lower, pivots = np.eye(6) + np.tril(factor, -1), 1.0 / np.diag(factor)
        assert least == pytest.approx(pivots.min(), rel=1e-12)
        # backward stable: the errors of L D L^T and of the residual are rounding, whatever the condition
        np.testing.assert_allclose((lower * pivots) @ lower.T, matrix, rtol=0, atol=1e-14 * scale)
        y = insides.solve(matrix, b)
        assert np.abs(matrix @ y - b).max() < 1e-14 * scale * np.abs(y).max() + 1e-14
        wanted = np.linalg.solve(matrix / scale, b) / scale
        np.testing.assert_allclose(y, wanted, rtol=0, atol=1e-14 * condition * np.abs(wanted).max())


def test_what_has_no_positive_pivot() -> None:
    """Values below zero or zero, numbers that are none; only the lower triangle is read."""
    rng, eye = np.random.default_rng(1), np.eye(6)
    for k in range(6):
        basis = np.linalg.qr(rng.standard_normal((6, 6)))[0]
        assert not insides.factor((basis * np.where(np.arange(6) == k, -0.1, 1.0)) @ basis.T)[0] > 0.0
        assert insides.factor(eye - 2.0 * np.diag(eye[k]))[0] == -1.0
        assert not insides.factor(eye - np.diag(eye[k]))[0] > 0.0
    for bad in (np.nan, np.inf, -np.inf):
        for r, s in zip(*LOWER, strict=True):
            matrix = eye + 0.1
            matrix[r, s] = bad
            if not (bad == np.inf and r == s):  # a diagonal of inf has a factor: nothing moves along it
                assert not insides.factor(matrix)[0] > 0.0, (r, s)
        matrix = np.random.default_rng(0).standard_normal((9, 6))
        matrix[:, 3] = bad
        assert not insides.qr(matrix, np.ones(9), np.ones(6))[0]
    matrix = definite(rng, 10.0)
    half = np.where(np.tri(6) > 0.0, matrix, np.nan)
    np.testing.assert_array_equal(insides.solve(half, np.ones(6)), insides.solve(matrix, np.ones(6)))
    found = [insides.size(a) for a in (np.array([0.0, 1.0, -7.0, 3.0, 0.0, 2.0]), np.zeros(6), np.full(6, np.nan))]
    np.testing.assert_array_equal(found, [7.0, 0.0, np.nan])
    assert insides.size(np.array([0.0, np.inf, -7.0, 3.0, 0.0, 2.0])) == np.inf


def test_the_bound_of_the_rank_is_one() -> None:
    """Of the least eigenvalue of the Gram matrix over its trace; far below it only where many are small."""
    rng, clear = np.random.default_rng(0), 0
    for ratio in 10.0 ** np.arange(-12.0, 0.0, 0.25):
        u, v = (np.linalg.qr(rng.standard_normal((n, 6)))[0] for n in (6, 9))
        values = np.array([1.0, 0.9, 0.8, 0.7, 0.6, ratio])
        for scale in (1.0, 1e-100, 1e100):
            found = insides.rank_bound(scale * (u * values) @ v.T)
            least = values.min() ** 2 / (values**2).sum()
            assert found <= least * (1.0 + 1e-9) + 1e-15
            assert found > 0.01 * least or least < 1e-12
            clear += found > insides.CLEAR_RANK
            assert not found > insides.CLEAR_RANK or ratio > 1e-6
    assert clear > 24
    for rows in (np.zeros((6, 9)), np.full((6, 9), np.nan), np.full((6, 9), np.inf), np.ones((6, 9))):
        assert not insides.rank_bound(rows) > 0.0


def exactly(matrix: np.ndarray, right: list[Fraction]) -> list[Fraction]:
    """(A^T A)^-1 right in fractions, by elimination."""
    rows = [[Fraction(v) for v in row] for row in matrix]
    system = [[sum(r[i] * r[j] for r in rows) for j in range(6)] + [right[i]] for i in range(6)]
    for k in range(6):
        for i in range(6):
            if i != k:
                factor = system[i][k] / system[k][k]
                system[i] = [a - factor * b for a, b in zip(system[i], system[k], strict=True)]
    return [system[k][6] / system[k][k] for k in range(6)]


@pytest.mark.parametrize("decades", [0, 4, 8, 12])
@pytest.mark.parametrize("count", [6, 9, 24])
def test_rows_of_any_size(count: int, decades: int) -> None:
    """Rows that differ by all digits, so that A^T A has none of the small ones: each is as good as its own digits."""
    rng = np.random.default_rng(count + decades)
    for _ in range(4):
        plain, sizes = rng.standard_normal((count, 6)), 10.0 ** -rng.uniform(0.0, decades, count)
        matrix, g, b = plain * sizes[:, None], rng.standard_normal(count), rng.standard_normal(6)
        whole, rest, reached, z, n = insides.qr(matrix, g, b)
        assert whole
        wanted = np.array([float(v) for v in exactly(matrix, [Fraction(v) for v in b])])
        # the condition that counts is that of the rows without their sizes
        error = 1e-14 * np.linalg.cond(plain[np.argsort(-sizes)[:6]])
        np.testing.assert_allclose(n, wanted, rtol=0, atol=error * np.abs(wanted).max())
        np.testing.assert_allclose(z / sizes, plain @ wanted, rtol=0, atol=error * np.abs(wanted).max())
        exact = [[Fraction(v) for v in row] for row in matrix]
        pull = [sum(row[k] * Fraction(v) for row, v in zip(exact, g, strict=True)) for k in range(6)]
        multipliers = exactly(matrix, pull)
        reach = [sum(a * n for a, n in zip(row, multipliers, strict=True)) for row in exact]
        wanted = np.array([float(v) for v in multipliers])
        np.testing.assert_allclose(reached, wanted, rtol=0, atol=error * np.abs(wanted).max())
        wanted = np.array([float(Fraction(v) - a) for v, a in zip(g, reach, strict=True)])
        np.testing.assert_allclose(rest, wanted, rtol=0, atol=error * np.abs(g).max())
