"""One optimum, whatever the start and the method; every iterate is balanced, strictly inside and never worse than before (Theorem 1)."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from problems import PROBLEMS, Problem, closure_grasps

from grasp_env.errors import NotConvergedError
from grasp_env.force import ForceSolution, Objective, Status, optimize_force
from grasp_env.force.options import DESCENTS
from grasp_env.force.rules import RULES
from grasp_env.grasp import Grasp


def weights_of(problem: Problem) -> dict[str, float]:
    return {"force_weight": problem.force_weight, "barrier_weight": problem.barrier_weight}


def assert_valid(solution: ForceSolution, grasp: Grasp) -> None:
    """Balanced, inside, and its summary and trace true; Newton accepts a step of equal Phi at the rounding level."""
    reference = Reference(grasp)
    load = np.abs(reference.load(solution.wrench)).max()
    for force in (solution.force, solution.initial_force):
        assert np.isfinite(force).all()
        size = np.abs(force).max() + load
        assert reference.residual(force, np.zeros(len(force)), solution.wrench) <= 1e-10 * size
        assert reference.cone_margin(force) > 0.0
    # the solver sums in another order and in cone coordinates: rounding of twelve products
    rounding = 1e-14 * (np.abs(solution.force).max() + load) / min(grasp.length, 1.0)
    residual = reference.residual(solution.force, solution.torsion, solution.wrench)
    assert abs(solution.cone_margin - reference.cone_margin(solution.force)) <= rounding
    assert abs(solution.equilibrium_residual - residual) <= rounding
    assert solution.lower_bound <= solution.objective * (1.0 + 1e-10)
    trace, slack = solution.objective_trace, 1e-15 if solution.method == "newton" else -1e-300
    if trace.size:
        assert (np.diff(trace) <= slack * trace[:-1]).all()
        assert (len(trace), trace[-1]) == (solution.iterations + 1, solution.objective)


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("problem", PROBLEMS[::2], ids=str)
def test_stopping_anywhere_leaves_a_valid_grasp(problem: Problem, method: str) -> None:
    options = {"initial": "single_value", "tolerance": 1e-6, "method": method, "trace": True, **weights_of(problem)}

    def stop(limit: int) -> ForceSolution:
        return optimize_force(problem.grasp, problem.wrench, max_iterations=limit, **options)

    end = stop(20_000).raise_for_status()
    assert_valid(end, problem.grasp)
    for limit in (0, 1, 2, 5, 20):
        if limit < end.iterations:
            solution = stop(limit)
            assert (solution.status, solution.iterations) == (Status.ITERATION_LIMIT, limit)
            assert_valid(solution, problem.grasp)
            assert solution.lower_bound <= problem.optimum * (1.0 + 1e-9)
            np.testing.assert_array_equal(solution.objective_trace, end.objective_trace[: limit + 1])
    if end.iterations:
        with pytest.raises(NotConvergedError, match=rf"{method} ended after 0 iterations.*raise max_iterations"):
            stop(0).raise_for_status()
    np.testing.assert_allclose(stop(0).force, end.initial_force, rtol=3e-16)


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("start", RULES)
@pytest.mark.parametrize("problem", PROBLEMS[::2], ids=str)
def test_start_and_method_do_not_matter(problem: Problem, start: str, method: str) -> None:
    # the dense flow takes a millisecond a step; the others show the tighter agreement
    tolerance = 1e-6 if method == "full_flow" else 1e-8
    options = {"initial": start, "method": method, "tolerance": tolerance}
    solution = optimize_force(problem.grasp, problem.wrench, **options, **weights_of(problem)).raise_for_status()
    # the printed start has no force at w = 0 and at no other wrench; the Lagrange start need not have one
    none = start == "lagrange" or (start == "linear_combination_printed" and not problem.wrench.any())
    own = "internal_force" if method == "newton" else "linear_combination"
    assert solution.initial == start or (none and solution.initial == f"{own} ({start} was replaced)")
    # from above by no more than its certificate, from below by the digits written
    assert -1e-9 <= solution.objective / problem.optimum - 1.0 <= tolerance + 1e-9
    assert problem.optimum * (1.0 - tolerance) - 1e-9 <= solution.lower_bound <= problem.optimum * (1.0 + 1e-9)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
@pytest.mark.parametrize("size", [1e2, 1e5])
def test_large_forces_take_few_steps(size: float, tolerance: float) -> None:
    """Below 60 although forces exceed their distance to the cones by up to 1e8; crawling took thousands."""
    phi, rng = Objective(), np.random.default_rng(3)
    for grasp in closure_grasps():
        wrench = rng.standard_normal(6) * np.repeat([1.0, rng.choice([0.0, 0.05, 1.0])], 3)
        wrench *= size / np.linalg.norm(wrench)
        found = optimize_force(grasp, wrench, tolerance=tolerance).raise_for_status()
        assert found.iterations < 60
        value = phi.value(grasp.to_cone(found.force))
        # u^2 - s^2 is known to a rounding of u^2: Phi beside it to 1e-12 here
        assert found.objective == pytest.approx(value, rel=1e-11)
        # moments about the origin, not the contacts' centre: the last digits take multipliers out of the dual cones
        bound = phi.lower_bound((1.0 - 1e-10) * found.multipliers, grasp.cone_matrix, wrench)
        assert value - bound <= 2.0 * tolerance * value + 1e-11 * value
        assert grasp.residual(found.force, wrench) <= 1e-13 * np.abs(found.force).max()
