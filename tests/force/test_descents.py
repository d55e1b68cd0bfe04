"""One optimum, whatever the start and the method, in few steps."""

from __future__ import annotations

import numpy as np
import pytest
from problems import PROBLEMS, Problem, closure_grasps

from grasp_env.errors import NotConvergedError
from grasp_env.force import Objective, Status, optimize_force
from grasp_env.force.options import DESCENTS, FLOWS
from grasp_env.force.rules import RULES


def weights_of(problem: Problem) -> dict[str, float]:
    return {"force_weight": problem.force_weight, "barrier_weight": problem.barrier_weight}


@pytest.mark.parametrize("method", DESCENTS)
def test_stopped_early_it_says_so_and_every_step_was_better(method):
    """Theorem 1: each iterate is inside, balanced and better than the one before."""
    problem = PROBLEMS[0]
    options = {"initial": "single_value", "method": method, "trace": True}
    found = optimize_force(
        problem.grasp, problem.wrench, max_iterations=2, **options, **weights_of(problem)
    )
    assert (found.status, found.iterations, len(found.objective_trace)) == (
        Status.ITERATION_LIMIT,
        2,
        3,
    )
    assert (np.diff(found.objective_trace) < 0.0).all()
    assert found.objective_trace[-1] == found.objective
    assert found.lower_bound <= problem.optimum * (1.0 + 1e-9)
    assert problem.grasp.residual(found.force, problem.wrench) < 1e-10
    assert problem.grasp.cone_margin(found.force) > 0.0
    with pytest.raises(
        NotConvergedError, match=rf"{method} ended after 2 iterations.*raise max_iterations"
    ):
        found.raise_for_status()


@pytest.mark.parametrize("method", FLOWS)
def test_an_impossible_tolerance_stalls_at_the_optimum(method):
    problem = PROBLEMS[0]
    options = {"tolerance": 1e-300, "trace": True, **weights_of(problem)}
    found = optimize_force(problem.grasp, problem.wrench, method=method, **options)
    assert len(found.objective_trace) == found.iterations + 1
    assert (found.status, found.objective) == (
        Status.STALLED,
        pytest.approx(problem.optimum, rel=1e-9),
    )
    with pytest.raises(NotConvergedError, match="more digits than the problem has"):
        found.raise_for_status()


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("start", RULES)
@pytest.mark.parametrize("problem", PROBLEMS[::2], ids=str)
def test_start_and_method_do_not_matter(problem, start, method):
    # the dense flow takes a millisecond a step; the others show the tighter agreement
    tolerance = 1e-6 if method == "full_flow" else 1e-8
    options = {"initial": start, "method": method, "tolerance": tolerance}
    solution = optimize_force(
        problem.grasp, problem.wrench, **options, **weights_of(problem)
    ).raise_for_status()
    # the printed start has no force at w = 0 and at no other wrench; the Lagrange start need not
    # have one
    none = start == "lagrange" or (
        start == "linear_combination_printed" and not problem.wrench.any()
    )
    own = "internal_force" if method == "newton" else "linear_combination"
    assert solution.initial == start or (
        none and solution.initial == f"{own} ({start} was replaced)"
    )
    # from above by no more than its certificate, from below by the digits written
    assert -1e-9 <= solution.objective / problem.optimum - 1.0 <= tolerance + 1e-9
    assert (
        problem.optimum * (1.0 - tolerance) - 1e-9
        <= solution.lower_bound
        <= problem.optimum * (1.0 + 1e-9)
    )


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
@pytest.mark.parametrize("size", [1e2, 1e5])
def test_large_forces_take_few_steps(size, tolerance):
    """Below 60 although forces exceed their distance to the cones by up to 1e8; crawling took
    thousands."""
    phi = Objective()
    rng = np.random.default_rng(3)
    for grasp in closure_grasps():
        wrench = rng.standard_normal(6) * np.repeat([1.0, rng.choice([0.0, 0.05, 1.0])], 3)
        wrench *= size / np.linalg.norm(wrench)
        found = optimize_force(grasp, wrench, tolerance=tolerance).raise_for_status()
        assert found.iterations < 60
        value = phi.value(grasp.to_cone(found.force))
        # u^2 - s^2 is known to a rounding of u^2: Phi beside it to 1e-12 here
        assert found.objective == pytest.approx(value, rel=1e-11)
        # moments about the origin, not the contacts' centre: the last digits take multipliers out
        # of the dual cones
        bound = phi.lower_bound((1.0 - 1e-10) * found.multipliers, grasp.cone_matrix, wrench)
        assert value - bound <= 2.0 * tolerance * value + 1e-11 * value
        assert grasp.residual(found.force, wrench) <= 1e-13 * np.abs(found.force).max()
