"""Newton on Phi with soft contacts and further rows against dense numpy and scipy."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import _core_test as insides
import numpy as np
import pytest
from cases import LIMIT, REFUSED, Case, case, with_slack
from dense import limit_rows
from oracles import limits as oracle
from oracles.phi import gradient, hessian, phi
from samples import Sample
from scipy.optimize import minimize

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
GENERAL = {
    "hard": case(4, "hard"),
    "soft": case(3, "all soft"),
    "hard, limits": case(4, "shared limits"),
    "mixed, limits": case(5, "soft limits"),
}


class Dense:
    """Phi with limits on the variables that count: (u, o, t) of all contacts, w of soft ones."""

    def __init__(self, c: Case) -> None:
        self.case, self.count, self.weights = c, c.count, c.contacts.weights
        self.live, self.unit = c.live, c.contacts.unit @ LOAD
        balance, (rows, self.bound) = with_slack(c.balance), limit_rows(c)
        self.balance, self.rows = balance[:, self.live], rows[:, self.live]
        self.row_weights = np.random.default_rng(8).uniform(0.01, 0.04, len(self.bound))
        # orthonormal rows of balance, as the core has them
        flat, self.lower = np.linalg.qr(balance.reshape(6, -1).T)
        self.stacked = np.concatenate([flat.T.reshape(6, self.count, 4), rows])
        self.rights = np.concatenate([np.linalg.solve(self.lower.T, -self.unit), self.bound])
        # w > 0 is a row as the others for the oracle, of the contact's own lambda
        positive = np.zeros((int(c.soft.sum()), self.count, 4))
        positive[np.arange(len(positive)), np.flatnonzero(c.soft), 3] = -1.0
        tangible = np.flatnonzero(np.tile([True] * 3 + [False], self.count))
        order = np.concatenate([tangible, 4 * np.flatnonzero(c.soft) + 3])
        self.order = np.searchsorted(np.flatnonzero(self.live.reshape(-1)), order)  # of the oracle's z among the live
        every = np.concatenate([self.rows, positive[:, self.live]])[:, self.order]
        self.terms = oracle.Terms(
            self.weights, every, np.append(self.bound, np.zeros(len(positive))),
            np.append(self.row_weights, self.weights[c.soft, 1]),
        )  # fmt: skip
        base = c.contacts
        softer = Sample(base.positions, base.normals, base.scale, base.weights * [1.0, 10.0])
        best = Case(softer, c.gamma, c.limits).minimum(LOAD)  # balanced, inside, and not the optimum
        assert best is not None
        z = np.zeros((self.count, 4))
        z[:, :3] = best[: 3 * self.count].reshape(-1, 3)
        z[c.soft, 3] = z[c.soft, 0] - best[3 * self.count :]
        self.start = z[self.live]

    def full(self, v: np.ndarray) -> np.ndarray:
        z = np.ones((self.count, 4))
        z[self.live] = v
        return z

    def phi(self, v: np.ndarray) -> float:
        return float(oracle.value(v[self.order], self.terms))

    def derivatives(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, full = oracle.derivatives(v[self.order], self.terms)
        back = np.argsort(self.order)
        return slope[back], full[back][:, back]

    def newton(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(step, multipliers of balance and limits): that of a limit is its price after the step, to first order, or 0."""
        n, (slope, bend) = len(v), self.derivatives(v)
        kkt = np.block([[bend, self.balance.T], [self.balance, np.zeros((6, 6))]])
        answer = np.linalg.solve(kkt, -np.concatenate([slope, self.balance @ v + self.unit]))
        slack = self.bound - self.rows @ v
        price = self.row_weights / slack**2 + 2.0 * self.row_weights / slack**3 * (self.rows @ answer[:n])
        return answer[:n], np.concatenate([answer[n:], np.maximum(price, 0.0)])

    def core(self, v: np.ndarray, limit: int, tolerance: float = 1e-15, twice: bool = False):
        """(z, multipliers of balance and limits, code, iterations, trials, value, bound)."""
        z, y, *rest = insides.phi_rows(
            self.stacked, self.rights, 6, self.weights, np.concatenate([np.zeros(6), self.row_weights]),
            self.case.soft.astype(float), self.full(v), tolerance, limit, twice,
        )  # fmt: skip
        y[:6] = np.linalg.solve(self.lower, y[:6])
        return z, y, *rest


@cache
def dense(name: str) -> Dense:
    return Dense(GENERAL[name])


def inside(problem: Dense, rng: np.random.Generator, part: float = 0.5) -> np.ndarray:
    """A force on the way to where a random direction, unbalanced too, leaves the limits."""
    v = problem.start
    d = rng.standard_normal(len(v)) * np.abs(v).max()
    while not np.isfinite(problem.phi(v + d)):
        d *= 0.7
    return v + part * d


@pytest.mark.parametrize("name", GENERAL)
def test_newton_takes_the_dense_step(name: str) -> None:
    rng, problem = np.random.default_rng(12), dense(name)
    taken = 0
    for k in range(8):
        v = inside(problem, rng, (0.0, 0.2, 0.5)[k % 3])
        if k < 4:  # balanced
            v = v - np.linalg.pinv(problem.balance) @ (problem.balance @ v + problem.unit)
            if not np.isfinite(problem.phi(v)):
                continue
        step, multipliers = problem.newton(v)
        z, y, code, iterations, _, value, bound = problem.core(v, 0)
        assert (code, iterations) == (LIMIT, 0)
        assert value == pytest.approx(problem.phi(v), rel=1e-12)
        np.testing.assert_array_equal(z, problem.full(v))
        np.testing.assert_allclose(y, multipliers, rtol=0, atol=1e-8 * np.abs(multipliers).max())
        assert bound <= value or k >= 4
        z, _, code, iterations, trials, value, _ = problem.core(v, 1)
        if iterations == 0:
            continue  # unbalanced, so no promise that Phi falls
        assert (code, iterations) == (LIMIT, 1)
        assert value == pytest.approx(problem.phi(z[problem.live]), rel=1e-12)
        moved = z[problem.live] - v
        alpha = float(moved @ step / (step @ step))
        np.testing.assert_allclose(moved, alpha * step, rtol=0, atol=1e-8 * np.abs(step).max())
        far = alpha * 2.0 ** (trials - 1)
        if far == pytest.approx(1.0, rel=1e-7):
            assert np.isfinite(problem.phi(v + 0.999999 * step))
        else:
            # 0.95 of the way out
            assert np.isfinite(problem.phi(v + 0.9999 / 0.95 * far * step))
            assert problem.phi(v + 1.0001 / 0.95 * far * step) == np.inf
        np.testing.assert_array_equal(z[~problem.live], 1.0)
        taken += 1
    assert taken >= 3
    for twice in (False, True):
        assert problem.core(-problem.start, 0, twice=twice)[2] == REFUSED  # outside


@pytest.mark.parametrize("name", ["soft", "mixed, limits"])
def test_the_bound_is_the_least_of_the_lagrangian(name: str) -> None:
    """Not only below: term by term the infimum over all z, by scipy, at multipliers far from the best."""
    problem = dense(name)
    for limit in (6, 8, 100):  # where the multipliers are on their way: the last bound is theirs where it is the best
        _, y, _, _, _, value, found = problem.core(problem.start, limit, 1e-13)
        assert 0.0 < found <= value * (1.0 + 1e-14)  # the last digits of two sums
        other = y
        balance, (rows, limits) = with_slack(problem.case.balance), limit_rows(problem.case)
        right = np.concatenate([-problem.unit, limits])
        q = np.einsum("rna,r->na", np.concatenate([balance, rows]), other)
        total = -float(other @ right) + float(2.0 * np.sqrt(problem.row_weights * other[6:]).sum())
        for k in range(problem.count):
            omega, lam = problem.weights[k]
            weights, slope = np.array([[omega, lam]]), q[k, :3]
            best = minimize(
                lambda x, s=weights, p=slope: phi(x, s) + p @ x, [1.0, 0.0, 0.0], method="trust-exact", options={"gtol": 1e-10},
                jac=lambda x, s=weights, p=slope: gradient(x, s) + p, hess=lambda x, s=weights: hessian(x, s),
            )  # fmt: skip
            total += float(best.fun)
            if problem.case.soft[k]:
                total += 2.0 * np.sqrt(lam * q[k, 3])
        assert found == pytest.approx(total, rel=1e-8)


@pytest.mark.parametrize("name", GENERAL)
def test_the_best_bound_is_kept(name: str) -> None:
    problem = dense(name)
    v = inside(problem, np.random.default_rng(13), 0.9)
    v = v - np.linalg.pinv(problem.balance) @ (problem.balance @ v + problem.unit)
    for start in (v, problem.start) if np.isfinite(problem.phi(v)) else (problem.start,):
        bounds = [problem.core(start, limit, 1e-15)[-1] for limit in range(25)]
        assert all(before <= after for before, after in pairwise(bounds))
