"""Newton on Phi with soft contacts and further rows against dense numpy and scipy."""

from __future__ import annotations

from functools import cache

import _core_test as insides
import numpy as np
import pytest
from grasp_env.force.program import ForceProgram
from oracles import phi as oracle
from problems import GRASPS
from scipy.linalg import null_space
from scipy.optimize import minimize

from grasp_env.force import ForceLimits
from grasp_env.force.objective import Objective
from grasp_env.force.record import LIMIT, REFUSED
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])


def objective_of(count: int, barrier: float = 0.01) -> Objective:
    """Different weights at every contact."""
    return Objective(np.linspace(0.7, 1.6, count).tolist(), np.linspace(barrier, 5.0 * barrier, count).tolist())


def soft(base: Grasp, models: list[str]) -> Grasp:
    return Grasp.from_contacts(
        base.positions, base.normals, base.friction, contact_model=models, torsional_friction=0.004
    )


def torque_limits(count: int) -> ForceLimits:
    jacobian = 0.05 * np.random.default_rng(6).standard_normal((count, 6, 3))
    return ForceLimits(min_normal=0.05, max_normal=12.0, jacobian=jacobian, torque_limit=1.5)


GENERAL = {
    "hard": (GRASPS["cuboid, 4"], None),
    "soft": (soft(GRASPS["tripod, uneven"], ["soft"] * 3), None),
    "hard, limits": (GRASPS["cuboid, 4"], torque_limits(4)),
    "mixed, limits": (soft(GRASPS["cuboid, 5, uneven"], ["hard", "soft", "hard", "soft", "soft"]), torque_limits(5)),
}


class Dense:
    """Phi with limits on the variables that count: (u, o, t) of all contacts, w of soft ones."""

    def __init__(self, name: str, load: np.ndarray = LOAD) -> None:
        self.program = ForceProgram(*GENERAL[name])
        self.grasp, self.soft = self.program.grasp, self.program.soft
        self.count = self.grasp.n_contacts
        self.objective = objective_of(self.count)
        self.weights = self.objective.weights(self.count)
        self.live = np.ones((self.count, 4), bool)
        self.live[~self.soft, 3] = False
        self.balance = self.program.balance[:, self.live]
        self.rows = self.program.rows[:, self.live]
        self.unit = self.program.frame @ load
        limits = len(self.program.bound)
        self.row_weights = np.random.default_rng(8).uniform(0.01, 0.04, limits)
        self.all_weights = np.concatenate([np.zeros(6), self.row_weights])
        # orthonormal rows of balance, as the core has them
        flat, lower = np.linalg.qr(self.program.balance.reshape(6, -1).T)
        self.turned, self.right = flat.T.reshape(6, self.count, 4), np.linalg.solve(lower.T, -self.unit)
        self.stacked = np.concatenate([self.turned, self.program.rows])
        self.rights = np.concatenate([self.right, self.program.bound])
        self.lower = lower
        start = feasibility(self.grasp, load, GENERAL[name][1])
        assert start.force is not None
        self.start = self.program.balanced(self.program.variables(start.force, start.torsion), load)

    def full(self, v: np.ndarray) -> np.ndarray:
        z = np.ones((self.count, 4))
        z[self.live] = v
        return z

    def slack(self, v: np.ndarray) -> np.ndarray:
        return self.program.bound - self.rows @ v

    def phi(self, v: np.ndarray) -> float:
        z, slack = self.full(v), self.slack(v)
        if slack.min(initial=1.0) <= 0.0 or z[self.soft, 3].min(initial=1.0) <= 0.0:
            return np.inf
        lam = self.weights[self.soft, 1]
        own = self.objective.value(np.ascontiguousarray(z[:, :3]).reshape(-1))
        return own + float((lam / z[self.soft, 3]).sum() + (self.row_weights / slack).sum())

    def gradient(self, v: np.ndarray) -> np.ndarray:
        z, out = self.full(v), np.zeros((self.count, 4))
        out[:, :3] = oracle.gradient(z[:, :3].reshape(-1), self.weights).reshape(-1, 3)
        out[:, 3] = -self.weights[:, 1] / z[:, 3] ** 2
        return out[self.live] + self.rows.T @ (self.row_weights / self.slack(v) ** 2)

    def hessian(self, v: np.ndarray) -> np.ndarray:
        z, out = self.full(v), np.zeros((self.count, 4, self.count, 4))
        dense = oracle.hessian(z[:, :3].reshape(-1), self.weights)
        blocks = [dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(self.count)]
        for k in range(self.count):
            out[k, :3, k, :3] = blocks[k]
            out[k, 3, k, 3] = 2.0 * self.weights[k, 1] / z[k, 3] ** 3
        bend = 2.0 * self.row_weights / self.slack(v) ** 3
        return out[self.live][:, self.live] + (self.rows.T * bend) @ self.rows

    def newton(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(step, multipliers of balance and limits): that of a limit is its price after the step, to first order, or 0."""
        n = len(v)
        kkt = np.block([[self.hessian(v), self.balance.T], [self.balance, np.zeros((6, 6))]])
        answer = np.linalg.solve(kkt, -np.concatenate([self.gradient(v), self.balance @ v + self.unit]))
        slack = self.slack(v)
        price = self.row_weights / slack**2 + 2.0 * self.row_weights / slack**3 * (self.rows @ answer[:n])
        return answer[:n], np.concatenate([answer[n:], np.maximum(price, 0.0)])

    def core(self, v: np.ndarray, limit: int, tolerance: float = 1e-15, twice: bool = False):
        """(z, multipliers of balance and limits, code, iterations, trials, value, bound)."""
        z, y, *rest = insides.phi_rows(
            self.stacked, self.rights, 6, self.weights, self.all_weights, self.soft.astype(float), self.full(v),
            tolerance, limit, twice,
        )  # fmt: skip
        y[:6] = np.linalg.solve(self.lower, y[:6])
        return z, y, *rest


@cache
def dense(name: str) -> Dense:
    return Dense(name)


def inside(problem: Dense, rng: np.random.Generator, part: float = 0.5) -> np.ndarray:
    """A force on the way from the deepest to where a random direction, unbalanced too, leaves the limits."""
    v = problem.start[problem.live]
    d = rng.standard_normal(len(v)) * np.abs(v).max()
    while not np.isfinite(problem.phi(v + d)):
        d *= 0.7
    return v + part * d


@pytest.mark.parametrize("twice", [False, True])
@pytest.mark.parametrize("name", GENERAL)
def test_phi_is_the_formula(name: str, twice: bool) -> None:
    rng, problem, outside = np.random.default_rng(10), dense(name), 0
    for _ in range(40):
        v = problem.start[problem.live] + rng.choice([0.1, 1.0]) * rng.standard_normal(int(problem.live.sum()))
        z, _, code, iterations, _, value, _ = problem.core(v, 0, twice=twice)
        want = problem.phi(v)
        assert (code == REFUSED) == (want == np.inf)
        outside += code == REFUSED
        if code != REFUSED:
            assert value == pytest.approx(want, rel=1e-11)
            assert iterations == 0
            np.testing.assert_array_equal(z, problem.full(v))
    assert 3 < outside < 37


@pytest.mark.parametrize("name", GENERAL)
def test_dense_derivatives_are_differences(name: str) -> None:
    """The reference of the next tests, by central differences."""
    problem = dense(name)
    v = inside(problem, np.random.default_rng(11), 0.3)
    for a, unit in enumerate(np.eye(len(v))):
        step = 1e-6 * unit
        slope = (problem.phi(v + step) - problem.phi(v - step)) / 2e-6
        assert slope == pytest.approx(problem.gradient(v)[a], rel=1e-5, abs=1e-5)
        bend = (problem.gradient(v + step) - problem.gradient(v - step)) / 2e-6
        np.testing.assert_allclose(bend, problem.hessian(v)[a], rtol=0, atol=1e-5 * np.abs(problem.hessian(v)).max())


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
        assert bound <= value
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


@pytest.mark.parametrize("twice", [False, True])
@pytest.mark.parametrize("name", GENERAL)
def test_the_bound_is_below_scipys_minimum_and_touches_it(name: str, twice: bool) -> None:
    problem = dense(name)
    basis, v = null_space(problem.balance), problem.start[problem.live]
    answer = minimize(
        lambda c: problem.phi(v + basis @ c),
        np.zeros(basis.shape[1]),
        jac=lambda c: basis.T @ problem.gradient(v + basis @ c),
        hess=lambda c: basis.T @ problem.hessian(v + basis @ c) @ basis,
        method="trust-exact",
        options={"gtol": 1e-9, "maxiter": 500},
    )
    least = float(answer.fun)
    z, _, _, _, _, value, bound = problem.core(v, 100, 1e-10, twice)
    assert value == pytest.approx(least, rel=1e-9)
    assert least * (1.0 - 1e-8) < bound <= least * (1.0 + 1e-12)
    np.testing.assert_allclose(z[problem.live], v + basis @ answer.x, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["soft", "mixed, limits"])
def test_the_bound_is_the_least_of_the_lagrangian(name: str) -> None:
    """Not only below: term by term the infimum over all z, by scipy, at multipliers far from the best."""
    problem = dense(name)
    for limit in (6, 8, 100):  # where the multipliers are on their way: the last bound is theirs where it is the best
        _, y, _, _, _, value, found = problem.core(problem.start[problem.live], limit, 1e-13)
        assert 0.0 < found <= value * (1.0 + 1e-14)  # the last digits of two sums
        other = y
        stacked = np.concatenate([problem.program.balance, problem.program.rows])
        right = np.concatenate([-problem.unit, problem.program.bound])
        q = np.einsum("rna,r->na", stacked, other)
        total = -float(other @ right) + float(2.0 * np.sqrt(problem.row_weights * other[6:]).sum())
        for k in range(problem.count):
            omega, lam = problem.weights[k]
            weights, slope = np.array([[omega, lam]]), q[k, :3]
            best = minimize(
                lambda x, s=weights, p=slope: oracle.phi(x, s) + p @ x,
                np.array([1.0, 0.0, 0.0]),
                jac=lambda x, s=weights, p=slope: oracle.gradient(x, s) + p,
                hess=lambda x, s=weights: oracle.hessian(x, s),
                method="trust-exact",
                options={"gtol": 1e-10, "maxiter": 500},
            )
            total += float(best.fun)
            if problem.soft[k]:
                total += 2.0 * np.sqrt(lam * q[k, 3])
        assert found == pytest.approx(total, rel=1e-8)
