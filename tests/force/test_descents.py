"""One optimum, whatever the start and the method; every iterate is balanced, strictly inside and never worse than before (Theorem 1)."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from problems import GRASPS, PAPER_WRENCH, PROBLEMS, Problem, closure_grasps

from benchmarks.problem import closed_grasps
from grasp_env.errors import NotConvergedError
from grasp_env.force import DESCENTS, RULES, ForceOptimizer, ForceSolution, Objective, Status, optimize_force
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches

BALANCE = 1e-10
"""Allowed residual, relative to the forces that have to cancel."""
CUBOID = GRASPS["cuboid, 4"]


def weights_of(problem: Problem) -> dict[str, float]:
    return {"force_weight": problem.force_weight, "barrier_weight": problem.barrier_weight}


def assert_valid(solution: ForceSolution, grasp: Grasp) -> None:
    """With a trace: Newton accepts a step of equal Phi at the rounding level; the flows only strict decreases."""
    reference = Reference.of(grasp)
    load = np.abs(reference.load(solution.wrench)).max()
    for force in (solution.force, solution.initial_force):
        assert np.isfinite(force).all()
        size = np.abs(force).max() + load
        assert reference.residual(force, np.zeros(len(force)), solution.wrench) <= BALANCE * size
        assert reference.cone_margin(force) > 0.0
    # the solver sums in another order and in cone coordinates: rounding of twelve products
    rounding = 1e-14 * (np.abs(solution.force).max() + load) / min(grasp.length, 1.0)
    residual = reference.residual(solution.force, solution.torsion, solution.wrench)
    assert abs(solution.cone_margin - reference.cone_margin(solution.force)) <= rounding
    assert abs(solution.equilibrium_residual - residual) <= rounding
    trace, slack = solution.objective_trace, 1e-15 if solution.method == "newton" else -1e-300
    if trace.size:
        assert np.isfinite(trace).all()
        assert (np.diff(trace) <= slack * trace[:-1]).all()
        assert (len(trace), trace[-1]) == (solution.iterations + 1, solution.objective)


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_stopping_anywhere_leaves_a_valid_grasp(problem: Problem, method: str) -> None:
    options = {"initial": "single_value", "tolerance": 1e-6, "method": method, "trace": True, **weights_of(problem)}

    def stop(limit: int) -> ForceSolution:
        return optimize_force(problem.grasp, problem.wrench, max_iterations=limit, **options)

    end = stop(20_000)
    assert end.status is Status.OPTIMAL
    assert_valid(end, problem.grasp)
    every = 3 if method != "full_flow" else 20  # the dense flow costs a thousand times more per step
    for limit in (0, 1, 2, *range(3, min(end.iterations, 60), every)):
        if limit < end.iterations:
            solution = stop(limit)
            assert solution.status is Status.ITERATION_LIMIT
            assert (solution.iterations, solution.trials >= limit) == (limit, True)
            assert_valid(solution, problem.grasp)
            assert solution.lower_bound <= problem.optimum * (1.0 + 1e-9)
            # the same iterates, only fewer
            np.testing.assert_array_equal(solution.objective_trace, end.objective_trace[: limit + 1])


@pytest.mark.parametrize("method", DESCENTS)
def test_no_iterations_returns_the_start(method: str) -> None:
    solution = optimize_force(CUBOID, PAPER_WRENCH, method=method, max_iterations=0)
    assert (solution.iterations, solution.trials, solution.objective_trace.size) == (0, 0, 0)
    np.testing.assert_allclose(solution.force, solution.initial_force, rtol=3e-16)
    with pytest.raises(NotConvergedError, match=rf"{method} ended after 0 iterations.*raise max_iterations") as caught:
        solution.raise_for_status()
    assert isinstance(caught.value, RuntimeError)


@pytest.mark.parametrize("name", GRASPS)
def test_balance_does_not_drift_over_many_thousand_steps(name: str) -> None:
    options = {"barrier_weight": 1e-5, "tolerance": 1e-14, "max_iterations": 20_000, "trace": True}
    solution = optimize_force(GRASPS[name], 3.0 * PAPER_WRENCH, method="reduced_flow", **options)
    assert solution.iterations > 1000
    assert_valid(solution, GRASPS[name])


def test_random_grasps_and_wrenches() -> None:
    """Newton; the flows with every rule are tried in `test_flows`."""
    rng = np.random.default_rng(0)
    for grasp in closure_grasps():
        optimizer = ForceOptimizer(grasp, max_iterations=300)
        for wrench in (*wrenches.sample_ball(rng, 4), *wrenches.sample_magnitudes(rng, 4, 1e-3, 1e3)):
            solution = optimizer.solve(wrench, trace=True)
            assert_valid(solution, grasp)
            assert solution.lower_bound <= solution.objective * (1.0 + 1e-10)


@pytest.mark.parametrize("method", DESCENTS)
def test_impossible_tolerance_stalls_or_converges_but_stays_valid(method: str) -> None:
    solution = optimize_force(CUBOID, PAPER_WRENCH, method=method, tolerance=1e-300, max_iterations=3000)
    assert_valid(solution, CUBOID)
    if solution.status is Status.STALLED:
        with pytest.raises(NotConvergedError, match="more digits than the problem has"):
            solution.raise_for_status()
    else:  # the bound reached Phi in floating point
        assert (solution.status, solution.optimality_gap) == (Status.OPTIMAL, 0.0)
    # whatever it says, it is the optimum to rounding
    assert solution.objective == pytest.approx(PROBLEMS[0].optimum, rel=1e-9)


# one optimum


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("start", RULES)
@pytest.mark.parametrize("problem", PROBLEMS[::2], ids=str)
def test_start_and_method_do_not_matter(problem: Problem, start: str, method: str) -> None:
    # the dense flow pays a millisecond a step; the others show the tighter agreement
    tolerance = 1e-6 if method == "full_flow" else 1e-8
    options = {"initial": start, "method": method, "tolerance": tolerance}
    solution = optimize_force(problem.grasp, problem.wrench, **options, **weights_of(problem))
    assert (solution.status, solution.method) == (Status.OPTIMAL, method)
    # the printed start has no force at w = 0 and at no other wrench; the Lagrange start need not have one
    none = start == "lagrange" or (start == "linear_combination_printed" and not problem.wrench.any())
    own = "internal_force" if method == "newton" else "linear_combination"
    assert solution.initial == start or (none and solution.initial == f"{own} ({start} was replaced)")
    # from above by no more than its certificate, from below by the digits written
    assert -1e-9 <= solution.objective / problem.optimum - 1.0 <= tolerance + 1e-9
    assert problem.optimum * (1.0 - tolerance) - 1e-9 <= solution.lower_bound <= problem.optimum * (1.0 + 1e-9)


def test_random_grasps_agree_over_methods_and_starts() -> None:
    for grasp, wrench in zip(closure_grasps(15), wrenches.sample_ball(np.random.default_rng(0), 15), strict=True):
        least = optimize_force(grasp, wrench, tolerance=1e-10).raise_for_status().objective
        for method in ("reduced_flow", "newton"):
            optimizer = ForceOptimizer(grasp, method=method, tolerance=1e-6, max_iterations=200_000)
            for start in RULES:
                solution = optimizer.solve(wrench, initial=start).raise_for_status()
                assert not solution.start_replaced or start == "lagrange"
                assert -1e-9 <= solution.objective / least - 1.0 <= 1e-6 + 1e-9


@pytest.mark.parametrize("problem", PROBLEMS[::3], ids=str)
def test_known_optimum_replaces_the_certificate(problem: Problem) -> None:
    options = {"initial": "single_value", "optimum": problem.optimum, "tolerance": 1e-3, "trace": True}
    solution = optimize_force(problem.grasp, problem.wrench, **options, **weights_of(problem))
    assert solution.status is Status.OPTIMAL
    # it stops at the first iterate within the gap, not an eighth later
    gaps = solution.objective_trace / problem.optimum - 1.0
    assert gaps[-1] <= 1e-3
    assert (gaps[:-1] > 1e-3).all()


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
@pytest.mark.parametrize("size", [1e2, 1e5])
def test_large_forces_take_few_steps(size: float, tolerance: float) -> None:
    """Less than 60 where forces exceed their distance to the cones by up to 1e8; crawling took thousands."""
    phi = Objective()
    for count in (3, 4, 5, 7, 12):
        rng = np.random.default_rng(count)
        for grasp in closed_grasps(rng, count, 4):
            for moment in (0.0, 0.05, 1.0):
                wrench = np.concatenate([rng.standard_normal(3), moment * rng.standard_normal(3)])
                wrench *= size / np.linalg.norm(wrench)
                found = optimize_force(grasp, wrench, tolerance=tolerance).raise_for_status()
                assert found.iterations < 60
                value = phi.value(grasp.to_cone(found.force))
                # u^2 - s^2 is known to a rounding of u^2: Phi beside it to 1e-12 here
                assert found.objective == pytest.approx(value, rel=1e-11)
                # moments about the origin, not the contacts' centre: the last digits take multipliers out of the dual cones
                bound = phi.lower_bound((1.0 - 1e-10) * found.multipliers, grasp.cone_matrix, wrench)
                assert value - bound <= 2.0 * tolerance * value + 1e-11 * value
                assert grasp.cone_margin(found.force) > 0.0
                assert grasp.residual(found.force, wrench) <= 1e-13 * np.abs(found.force).max()
