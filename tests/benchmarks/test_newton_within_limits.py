"""Newton on the problems of the benchmark that have limits: the exact solver has the same verdict,
and each force meets the conditions of the optimum of Phi, computed again from the record."""

from __future__ import annotations

import numpy as np
import pytest
from limited_tracks import TRACKS, made_soft
from oracles.phi import gradient

from benchmarks.force.package import grasp_of, margin_of
from benchmarks.force.problems import BARRIER_WEIGHT, Problem, load
from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceOptimizer, ForceSolution


def solved(problem: Problem, method: str) -> ForceSolution | None:
    """None: no force keeps the limits."""
    grasp, limits = grasp_of(problem)
    margin = margin_of(problem)
    optimizer = ForceOptimizer(grasp, method=method, limits=limits, margin=margin, tolerance=1e-10)
    try:
        return optimizer.solve(problem.wrench, contacts=problem.touching)
    except InfeasibleWrenchError:
        return None


def check(problem: Problem, solution: ForceSolution) -> None:
    """Balance, cones, limits, and slope of Phi + multipliers of limits = pull of the wrench."""
    p = problem.shifted()
    force = solution.force.copy()
    force[:, 0] -= problem.shift
    columns = [p.friction, np.ones(p.n_contacts), np.ones(p.n_contacts)]
    if p.width == 4:
        force = np.column_stack([force, solution.torsion])
        columns.append(p.friction / p.torsional_friction)
    scale = np.column_stack(columns)
    x = (scale * force)[p.active]
    assert (x[:, 0] > np.linalg.norm(x[:, 1:], axis=1)).all()
    slack = p.limit_bound - p.limit_matrix @ force.reshape(-1)
    assert (slack > 0.0).all()
    np.testing.assert_allclose(
        p.matrix @ force.reshape(-1), -p.wrench, atol=1e-9 * np.abs(force).max()
    )
    weights = np.tile([1.0, BARRIER_WEIGHT, p.width - 2.0], (len(x), 1))
    slope = np.zeros((p.n_contacts, p.width))
    slope[p.active] = scale[p.active] * gradient(x.reshape(-1), weights).reshape(x.shape)
    rows = p.limit_matrix.T @ solution.limit_multipliers
    pull = p.matrix.T @ solution.multipliers
    # a gap of 1e-10 is a step whose decrement is its root: 1e-5 of Phi in the metric of the Hessian
    np.testing.assert_allclose(slope.reshape(-1) + rows, pull, atol=5e-3 * np.abs(slope).max())
    # a row of length l in x has the multiplier lambda l / slack^2; l = 1 if no force changes it
    length = np.linalg.norm(p.limit_matrix / np.where(scale, scale, 1.0).reshape(-1), axis=1)
    length[length == 0.0] = 1.0
    most = solution.limit_multipliers.max(initial=0.0)
    np.testing.assert_allclose(
        solution.limit_multipliers, BARRIER_WEIGHT * length / slack**2, rtol=1e-3, atol=1e-3 * most
    )


@pytest.mark.parametrize("soft", [False, True], ids=["hard", "soft"])
@pytest.mark.parametrize("track", TRACKS)
def test_forces_are_optima_and_verdicts_those_of_the_exact_solver(track, soft):
    problems = [problem for session in load(track).sessions for problem in session.problems]
    forces = 0
    for problem in problems:
        if soft:
            problem = made_soft(problem)
        solution = solved(problem, "newton")
        assert (solution is None) == (solved(problem, "conic") is None)
        if solution is not None:
            check(problem, solution)
            forces += 1
    assert forces > 200 or track == "infeasible"
