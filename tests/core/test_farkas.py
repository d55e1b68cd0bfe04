"""Proofs that no force keeps limits, from prices and multipliers: their value term by term, and how sure they have to be."""

from __future__ import annotations

import numpy as np
import pytest
from samples import EACH, Sample, sample
from scipy.optimize import linprog

SURE = 1e-9


def rows_of(s: Sample, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three or four joints a contact: rows (M, 3) of length one, owners (M,), bounds, shares and weights (3, M); some bounds below zero."""
    rng, rows, owners = np.random.default_rng([seed, s.count]), [], []
    for i in range(s.count):
        for _ in range(int(rng.choice([3, 4]))):
            a = rng.standard_normal(3)
            rows += [a / np.linalg.norm(a), -a / np.linalg.norm(a)]
            owners += [i, i]
    share = np.repeat(rng.uniform(0.5, 2.0, len(rows) // 2), 2)
    bound = share * (1.0 + rng.uniform(-1.3, 0.3, len(rows)))
    return np.array(rows), np.array(owners), np.array([bound, share, np.full(len(rows), 0.01)])


def largest_normal(rows: np.ndarray, bound: np.ndarray) -> float:
    """A bound of u in the cone and the rows, bounds below zero raised to it: by pyramids inside the cone none is smaller."""
    angles = 2.0 * np.pi * np.arange(256) / 256
    cone = np.column_stack([-np.cos(np.pi / 256) * np.ones(256), np.cos(angles), np.sin(angles)])
    every, right = np.vstack([cone, rows]), np.append(np.zeros(256), np.maximum(bound, 0.0))
    return -linprog([-1.0, 0.0, 0.0], A_ub=every, b_ub=right, bounds=(None, None)).fun


def prices_of(s: Sample, rows: np.ndarray, owners: np.ndarray, table: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(M,) the slope of lambda / slack, of its parabola below an edge of 8 of the contact's own scales."""
    bound, _, weight = table
    slack = bound - np.einsum("ma,ma->m", rows, x.reshape(-1, 3)[owners])
    edge = np.maximum(slack, 8.0 * np.sqrt(s.weights[:, 1] / s.weights[:, 0])[owners])
    return weight / edge**2 - 2.0 * weight / edge**3 * (slack - edge)


@pytest.mark.parametrize("lanes", EACH)
@pytest.mark.parametrize("count", [3, 4, 5, 9])
def test_a_proof_is_worth_what_its_terms_add_up_to(lanes: int, count: int) -> None:
    s, verdicts = sample(count), []
    for seed in range(4):
        rows, owners, table = rows_of(s, seed)
        rng, made = np.random.default_rng(seed), EACH[lanes](s.placement)
        x = 0.5 * s.rest + 3.0 * rng.standard_normal(3 * count)
        price = prices_of(s, rows, owners, table, x)
        pull = np.zeros((count, 3))
        np.add.at(pull, owners, price[:, None] * rows)
        most = np.array([largest_normal(rows[owners == i], table[0][owners == i]) for i in range(count)])
        for scale in (0.1, 1.0, 30.0):
            nu = scale * price.max() * rng.standard_normal(6)
            _, value, share, size, proof, slope = made.farkas(rows, owners.tolist(), table, x, nu, np.zeros(6))
            np.testing.assert_allclose(slope.reshape(-1, 3), pull, rtol=0, atol=1e-12 * price.max())
            np.testing.assert_array_equal(proof, nu)  # contacts that all have rows lean on nothing
            assert share == pytest.approx(price @ table[1], rel=1e-12)
            # what q lacks of the dual cones is paid with a bound of u, which is never below the largest u itself
            q = pull - (s.rows.T @ nu).reshape(-1, 3)
            lacking = np.maximum(0.0, np.hypot(q[:, 1], q[:, 2]) - q[:, 0])
            paid = value - price @ table[0]
            assert lacking @ most * (1.0 - 1e-3) <= paid <= 100.0 * lacking @ most + 1e-12 * size
            assert size == pytest.approx(np.abs(price * table[0]).sum() + paid, rel=1e-9)
            for part in (-2.0, -0.5, -0.05, 0.05, 0.5, 2.0):  # of what is sure; w takes the value there
                w = nu * (part * SURE * 2.0 * size - value) / float(nu @ nu)
                hopeless, at, _, whole, _, _ = made.farkas(rows, owners.tolist(), table, x, nu, w)
                assert at == pytest.approx(value + nu @ w, abs=1e-13 * whole)
                assert whole == pytest.approx(size + np.abs(nu * w).sum(), rel=1e-12)
                assert hopeless == (at < -SURE * whole)
                verdicts.append(hopeless)
    assert 10 < sum(verdicts) < len(verdicts) - 10
