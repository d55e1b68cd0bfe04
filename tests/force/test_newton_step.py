"""Newton's step in the core against dense numpy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from oracles.boundary import longest_step
from oracles.newton import newton_step
from problems import PAPER_WRENCH, random_grasp
from scipy.linalg import null_space

from grasp_env import core
from grasp_env.force import record
from grasp_env.force.basis import core_contacts
from grasp_env.force.objective import Objective
from grasp_env.force.record import LIMIT
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
COUNTS = (3, 4, 5, 9)


@cache
def some_grasp(count: int) -> Grasp:
    """Random, with force closure and different friction along both tangents."""
    rng = np.random.default_rng(200 + count)
    while True:
        base = random_grasp(rng, count)
        both = np.column_stack([base.friction, rng.uniform(0.3, 1.0, count)])
        grasp = Grasp.from_contacts(base.positions + np.array([0.3, -0.2, 0.1]), base.normals, both)
        if feasibility(grasp, np.zeros(6)).margin > 0.06:
            return grasp


def objective_of(count: int, barrier: float = 0.01) -> Objective:
    """Different weights at every contact."""
    return Objective(np.linspace(0.7, 1.6, count).tolist(), np.linspace(barrier, 5.0 * barrier, count).tolist())


# the core's Newton


def start_near_the_optimum(grasp: Grasp, objective: Objective, load: np.ndarray, away: float) -> np.ndarray:
    """Cone coordinates, balanced: the optimum of the dense twin, then a seeded internal force."""
    force = feasibility(grasp, load).force
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
