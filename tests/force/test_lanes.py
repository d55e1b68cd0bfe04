"""The 6 x 6 system, the unit frame, and Newton's step against dense numpy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from oracles.boundary import longest_step
from oracles.newton import newton_step
from problems import GRASPS, PAPER_WRENCH, random_grasp
from scipy.linalg import null_space
from scipy.optimize import minimize

from grasp_env import core
from grasp_env.force import ForceLimits, lanes, record
from grasp_env.force.basis import core_contacts
from grasp_env.force.cholesky6 import PACKED, factor6, solve6
from grasp_env.force.feasibility import phase_one
from grasp_env.force.objective import Objective
from grasp_env.force.program import ForceProgram
from grasp_env.force.program_newton import general_bound, general_newton, general_phi, slacks
from grasp_env.force.record import LIMIT
from grasp_env.grasp import Grasp

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
COUNTS = (3, 4, 5, 9)


# the 6 x 6 system


def spd(rng: np.random.Generator, condition: float) -> np.ndarray:
    basis = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    matrix = (basis * np.geomspace(1.0, 1.0 / condition, 6)) @ basis.T
    return 0.5 * (matrix + matrix.T)


@pytest.mark.parametrize("condition", [1.0, 1e2, 1e6, 1e10, 1e13])
def test_factor6_and_solve6_are_numpys(condition: float) -> None:
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e-8, 1e8):
        for _ in range(40):
            matrix, b = scale * spd(rng, condition), rng.standard_normal(6)
            factor = np.empty(PACKED)
            least = factor6(matrix[np.tril_indices(6)], factor)
            lower, d = np.eye(6), np.empty(6)
            packed = np.zeros((6, 6))
            packed[np.tril_indices(6)] = factor
            lower += np.tril(packed, -1)
            d = 1.0 / np.diag(packed)
            assert least == pytest.approx(d.min(), rel=1e-12)
            # backward stable: the errors of L D L^T and of the residual are rounding, whatever the condition
            np.testing.assert_allclose((lower * d) @ lower.T, matrix, rtol=0, atol=1e-14 * scale)
            y = np.array(solve6(factor, *b))
            assert np.abs(matrix @ y - b).max() < 1e-14 * scale * np.abs(y).max() + 1e-14
            wanted = np.linalg.solve(matrix, b)
            np.testing.assert_allclose(y, wanted, rtol=0, atol=1e-14 * condition * np.abs(wanted).max())


def test_factor6_says_where_a_matrix_is_not_positive() -> None:
    rng = np.random.default_rng(1)
    factor = np.empty(PACKED)
    for k in range(6):
        basis = np.linalg.qr(rng.standard_normal((6, 6)))[0]
        values = np.ones(6)
        values[k] = -0.1
        assert not factor6(((basis * values) @ basis.T)[np.tril_indices(6)], factor) > 0.0
        diagonal = np.diag(np.where(np.arange(6) == k, -1.0, 1.0))
        assert factor6(diagonal[np.tril_indices(6)], factor) == -1.0
        singular = np.diag(np.where(np.arange(6) == k, 0.0, 1.0))
        assert not factor6(singular[np.tril_indices(6)], factor) > 0.0
    # one contact that is not a number makes all entries so
    assert not factor6(np.full(PACKED, np.nan), factor) > 0.0


# grasps and the unit frame


@cache
def some_grasp(count: int) -> Grasp:
    """Random, with force closure and different friction along both tangents."""
    rng = np.random.default_rng(200 + count)
    while True:
        base = random_grasp(rng, count)
        both = np.column_stack([base.friction, rng.uniform(0.3, 1.0, count)])
        grasp = Grasp.from_contacts(base.positions + np.array([0.3, -0.2, 0.1]), base.normals, both)
        if phase_one(grasp, np.zeros(6)).margin > 0.06:
            return grasp


def objective_of(count: int, barrier: float = 0.01) -> Objective:
    """Different weights at every contact."""
    return Objective(np.linspace(0.7, 1.6, count).tolist(), np.linspace(barrier, 5.0 * barrier, count).tolist())


def test_load_is_the_unit_frame_and_pull_back_its_transpose() -> None:
    rng = np.random.default_rng(3)
    for count in COUNTS:
        grasp = some_grasp(count)
        options, out = lanes.options(grasp, 1e-6, 7, 2.5), np.empty(6)
        for w, n in rng.standard_normal((20, 2, 6)):
            lanes.load(w, options, out)
            np.testing.assert_allclose(out, grasp.unit_frame @ w, rtol=1e-12, atol=1e-12 / grasp.length)
            back = np.array(lanes.pull_back(options, n))
            np.testing.assert_allclose(back, grasp.unit_frame.T @ n, rtol=1e-12, atol=1e-12 / grasp.length)
            assert n @ out == pytest.approx(back @ w, rel=1e-10, abs=1e-10)


# the core's Newton


def start_near_the_optimum(grasp: Grasp, objective: Objective, load: np.ndarray, away: float) -> np.ndarray:
    """Cone coordinates, balanced: the optimum of the dense twin, then a seeded internal force."""
    force = phase_one(grasp, load).force
    assert force is not None
    x, g, unit = grasp.to_cone(force).reshape(-1), grasp.unit_frame @ grasp.cone_matrix, grasp.unit_frame @ load
    for _ in range(60):
        step, _, decrement = newton_step(x, g, unit, objective.weights(grasp.n_contacts))
        alpha = 1.0
        while not objective.value(x + alpha * step) <= objective.value(x) - 1e-4 * alpha * decrement and alpha > 1e-9:
            alpha *= 0.5
        x = x + alpha * step
        if decrement < 1e-12:
            break
    internal = null_space(g) @ np.random.default_rng(len(x)).standard_normal(len(x) - 6)
    slack = x[0::3] - np.hypot(x[1::3], x[2::3])
    return x + away * slack.min() * internal / np.abs(internal).max()


def one_iteration(grasp: Grasp, objective: Objective, load: np.ndarray, x: np.ndarray, limit: int) -> np.ndarray:
    row = np.zeros(record.record_size(grasp.n_contacts))
    solver = core.Newton.make(core_contacts(grasp, objective), 1e-15, limit)
    assert solver.descend(load, grasp.to_force(x), float("nan"), np.empty(0), row) == LIMIT
    assert (row[record.CODE], row[record.ITERATIONS]) == (LIMIT, limit)
    return row


REACH = 0.7
"""Part of the way to the boundary that the core's steps go at most."""


@pytest.mark.parametrize("away", [0.2, 0.6, 0.9])
@pytest.mark.parametrize("count", COUNTS)
def test_newton_takes_the_twins_step(count: int, away: float) -> None:
    grasp, objective = some_grasp(count), objective_of(count, 0.1)
    frame, divisor, full = grasp.unit_frame, grasp.models.cone_divisor.reshape(-1), 0
    rows, weights = frame @ grasp.cone_matrix, objective.weights(count)
    for load in (LOAD, PAPER_WRENCH, 10.0 * LOAD):
        x = start_near_the_optimum(grasp, objective, load, away)
        # in the unit frame, where the dense system is well conditioned
        unit = frame @ load
        step, multipliers, decrement = newton_step(x, rows, unit, weights)
        multipliers = frame.T @ multipliers
        none = one_iteration(grasp, objective, load, x, 0)
        near = 1e-8 * np.abs(multipliers).max()
        np.testing.assert_allclose(none[record.MULTIPLIERS : record.MULTIPLIERS + 6], multipliers, rtol=0, atol=near)
        assert none[record.OBJECTIVE] == pytest.approx(objective.value(x), rel=1e-12)
        bound = objective.lower_bound(none[record.MULTIPLIERS : record.MULTIPLIERS + 6], grasp.cone_matrix, load)
        assert none[record.BOUND] == pytest.approx(bound, rel=1e-8)
        row = one_iteration(grasp, objective, load, x, 1)
        after = row[record.FORCE : record.FORCE + 3 * count] * divisor
        alpha = min(1.0, REACH * longest_step(x, step)) * 0.5 ** (row[record.TRIALS] - 1.0)
        # a step is the small difference of large terms where forces lie deep in their cones
        np.testing.assert_allclose(after - x, alpha * step, rtol=0, atol=1e-6 * np.abs(step).max())
        np.testing.assert_allclose(after - x, alpha * step, rtol=0, atol=1e-9 * np.abs(x).max())
        # the rule itself: the first trial that is low enough
        value, tried = objective.value(x), min(1.0, REACH * longest_step(x, step))
        while objective.value(x + tried * step) >= value - 1e-4 * tried * decrement:
            tried *= 0.5
        assert alpha == pytest.approx(tried, rel=1e-12)
        full += alpha == 1.0
        second = frame.T @ newton_step(after, rows, unit, weights)[1]
        np.testing.assert_allclose(row[record.MULTIPLIERS : record.MULTIPLIERS + 6], second, rtol=0, atol=near)
    if away == 0.2:
        assert full == 3


# Newton with soft contacts and limits


def soft(base: Grasp, models: list[str]) -> Grasp:
    return Grasp.from_contacts(
        base.positions, base.normals, base.friction, contact_model=models, torsional_friction=0.004
    )


def torque_limits(count: int) -> ForceLimits:
    jacobian = 0.05 * np.random.default_rng(6).standard_normal((count, 4, 3))
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
        self.inverse = np.linalg.pinv(self.program.balance.reshape(6, -1)).reshape(self.count, 4, 6)
        self.right = np.concatenate([-self.unit, self.program.bound])
        stacked = np.concatenate([self.program.balance, self.program.rows])
        contacts, self.touched = (k.astype(np.int64) for k in np.nonzero((stacked != 0.0).any(axis=2).T))
        self.first = np.searchsorted(contacts, np.arange(self.count + 1)).astype(np.int64)
        self.values = np.ascontiguousarray(stacked[self.touched, contacts])
        start = phase_one(self.grasp, load, GENERAL[name][1])
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
        out[:, :3] = self.objective.gradient(np.ascontiguousarray(z[:, :3]).reshape(-1)).reshape(-1, 3)
        out[:, 3] = -self.weights[:, 1] / z[:, 3] ** 2
        return out[self.live] + self.rows.T @ (self.row_weights / self.slack(v) ** 2)

    def hessian(self, v: np.ndarray) -> np.ndarray:
        z, out = self.full(v), np.zeros((self.count, 4, self.count, 4))
        blocks = self.objective.hessian(np.ascontiguousarray(z[:, :3]).reshape(-1))
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

    def kernel(self, v: np.ndarray, limit: int, tolerance: float = 1e-15):
        z, y = self.full(v), np.zeros(len(self.right))
        answer = general_newton(
            self.first, self.touched, self.values, self.right, 6, self.inverse, self.weights, self.all_weights, self.soft,
            tolerance, np.nan, limit, z, y, np.empty(0),
        )  # fmt: skip
        return answer, z, y

    def bound(self, y: np.ndarray) -> float:
        return general_bound(
            self.first, self.touched, self.values, self.right, 6, self.weights, self.all_weights, self.soft, y
        )


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


@pytest.mark.parametrize("name", GENERAL)
def test_general_phi_is_the_formula(name: str) -> None:
    rng, problem = np.random.default_rng(10), dense(name)
    slack, outside = np.empty(len(problem.right)), 0
    for _ in range(40):
        v = problem.start[problem.live] + rng.choice([0.1, 1.0]) * rng.standard_normal(int(problem.live.sum()))
        z = problem.full(v)
        slacks(problem.first, problem.touched, problem.values, problem.right, 6, z, slack)
        np.testing.assert_allclose(slack[6:], problem.slack(v), rtol=0, atol=1e-12 * np.abs(problem.right).max())
        np.testing.assert_allclose(slack[:6], -problem.unit - problem.balance @ v, rtol=0, atol=1e-12)
        mine = general_phi(z, slack, 6, problem.weights, problem.all_weights, problem.soft)
        assert mine == pytest.approx(problem.phi(v), rel=1e-11)
        outside += mine == np.inf
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
def test_general_newton_takes_the_dense_step(name: str) -> None:
    rng, problem = np.random.default_rng(12), dense(name)
    taken = 0
    for k in range(8):
        v = inside(problem, rng, (0.0, 0.2, 0.5)[k % 3])
        if k < 4:  # balanced
            v = v - np.linalg.pinv(problem.balance) @ (problem.balance @ v + problem.unit)
            if not np.isfinite(problem.phi(v)):
                continue
        step, multipliers = problem.newton(v)
        (code, iterations, _, value, bound), z, y = problem.kernel(v, 0)
        assert (code, iterations) == (LIMIT, 0)
        assert value == pytest.approx(problem.phi(v), rel=1e-12)
        np.testing.assert_array_equal(z, problem.full(v))
        np.testing.assert_allclose(y, multipliers, rtol=0, atol=1e-8 * np.abs(multipliers).max())
        assert bound == problem.bound(y)
        (code, iterations, trials, value, _), z, _ = problem.kernel(v, 1)
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


@pytest.mark.parametrize("name", GENERAL)
def test_general_bound_is_below_scipys_minimum_and_touches_it(name: str) -> None:
    rng, problem = np.random.default_rng(13), dense(name)
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
    (_, _, _, value, bound), z, y = problem.kernel(v, 100, 1e-10)
    assert value == pytest.approx(least, rel=1e-9)
    assert least * (1.0 - 1e-8) < bound <= least * (1.0 + 1e-12)
    np.testing.assert_allclose(z[problem.live], v + basis @ answer.x, rtol=0, atol=1e-4)
    finite, nothing = 0, 0
    for _ in range(60):
        other = y + rng.choice([1e-3, 0.1, 1.0]) * rng.standard_normal(len(y)) * np.abs(y).max()
        other[6:] = np.maximum(other[6:], 0.0) if rng.random() < 0.8 else other[6:]
        found = problem.bound(other)
        assert found <= least * (1.0 + 1e-12)
        finite, nothing = finite + np.isfinite(found), nothing + (found == -np.inf)
    assert min(finite, nothing) > 3


@pytest.mark.parametrize("name", ["soft", "mixed, limits"])
def test_general_bound_is_the_least_of_the_lagrangian(name: str) -> None:
    """Not only below: term by term the infimum over all z, by scipy, at multipliers far from the best."""
    rng, problem = np.random.default_rng(14), dense(name)
    _, _, y = problem.kernel(problem.start[problem.live], 100, 1e-10)
    stacked = np.concatenate([problem.program.balance, problem.program.rows])
    for _ in range(6):
        other = y * rng.uniform(0.8, 1.2, len(y))
        found = problem.bound(other)
        if found == -np.inf:
            continue
        q = np.einsum("rna,r->na", stacked, other)
        total = -float(other @ problem.right) + float(2.0 * np.sqrt(problem.row_weights * other[6:]).sum())
        for k in range(problem.count):
            omega, lam = problem.weights[k]
            single, slope = Objective(omega, lam), q[k, :3]
            best = minimize(
                lambda x, s=single, p=slope: s.value(x) + p @ x,
                np.array([1.0, 0.0, 0.0]),
                jac=lambda x, s=single, p=slope: s.gradient(x) + p,
                hess=lambda x, s=single: s.hessian(x)[0],
                method="trust-exact",
                options={"gtol": 1e-10, "maxiter": 500},
            )
            total += float(best.fun)
            if problem.soft[k]:
                total += 2.0 * np.sqrt(lam * q[k, 3])
        assert found == pytest.approx(total, rel=1e-8)
