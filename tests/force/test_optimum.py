"""One optimum: whatever the start, the method, or the solver."""

from __future__ import annotations

import numpy as np
import pytest
from problems import CONIC_LEAST, GRASPS, PAPER_WRENCH, PROBLEMS, Problem, closure_grasps, solve_by_scipy

from grasp_env.force import DESCENTS, RULES, ForceOptimizer, Status, optimize_force
from grasp_env.grasp import wrench as wrenches

STARTS = tuple(name for name in RULES)


@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_written_optima_are_scipys(problem: Problem) -> None:
    value, force = solve_by_scipy(problem)
    # numbers are written to 12 digits, the heavy one to 9; scipy stops at a gradient of 1e-9
    assert value == pytest.approx(problem.optimum, rel=1e-10)
    solution = optimize_force(
        problem.grasp,
        problem.wrench,
        method="newton",
        tolerance=1e-10,
        force_weight=problem.force_weight,
        barrier_weight=problem.barrier_weight,
    ).raise_for_status()
    assert solution.objective == pytest.approx(value, rel=2e-10)
    # Phi is flat to second order: a gap of 1e-10 leaves about its square root in the force
    np.testing.assert_allclose(solution.force, force, atol=3e-5 * np.abs(force).max())


@pytest.mark.parametrize("problem", [p for p in PROBLEMS if p.total_normal], ids=str)
def test_total_normal_force_of_the_notes(problem: Problem) -> None:
    solution = optimize_force(
        problem.grasp, problem.wrench, barrier_weight=problem.barrier_weight, tolerance=1e-8
    ).raise_for_status()
    assert solution.total_normal_force == pytest.approx(problem.total_normal, abs=0.01)


def test_vanishing_barrier_meets_the_conic_optimum() -> None:
    totals = [
        optimize_force(GRASPS["cuboid, 4"], PAPER_WRENCH, method="newton", barrier_weight=barrier, tolerance=1e-9)
        .raise_for_status()
        .total_normal_force
        for barrier in (1e-2, 1e-4, 1e-6)
    ]
    assert totals[0] > totals[1] > totals[2] > CONIC_LEAST
    assert totals[2] == pytest.approx(CONIC_LEAST, rel=0.01)


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_start_and_method_do_not_matter(problem: Problem, start: str, method: str) -> None:
    # the dense flow pays a millisecond a step; the others show the tighter agreement
    tolerance = 1e-6 if method == "full_flow" else 1e-8
    solution = optimize_force(
        problem.grasp,
        problem.wrench,
        initial=start,
        method=method,
        tolerance=tolerance,
        force_weight=problem.force_weight,
        barrier_weight=problem.barrier_weight,
    )
    assert solution.status is Status.OPTIMAL
    assert solution.method == method
    # the printed start has no force at w = 0 and at no other wrench; the Lagrange start need not have one
    none = start == "lagrange" or (start == "linear_combination_printed" and not problem.wrench.any())
    own = "internal_force" if method == "newton" else "linear_combination"
    assert solution.initial == start or (none and solution.initial == f"{own} ({start} was replaced)")
    assert solution.optimality_gap <= tolerance
    # from above by no more than its certificate, from below by the digits written
    assert -1e-9 <= solution.objective / problem.optimum - 1.0 <= tolerance + 1e-9
    assert problem.optimum * (1.0 - tolerance) - 1e-9 <= solution.lower_bound <= problem.optimum * (1.0 + 1e-9)


def test_random_grasps_agree_over_methods_and_starts() -> None:
    rng = np.random.default_rng(0)
    compared = 0
    for grasp in closure_grasps(15):
        wrench = wrenches.sample_ball(rng, 1)[0]
        oracle = optimize_force(grasp, wrench, method="newton", tolerance=1e-10).raise_for_status()
        for method in ("reduced_flow", "newton"):
            optimizer = ForceOptimizer(grasp, method=method, tolerance=1e-6, max_iterations=200_000)
            for start in STARTS:
                solution = optimizer.solve(wrench, initial=start).raise_for_status()
                assert not solution.start_replaced or start == "lagrange"
                compared += 1
                assert -1e-9 <= solution.objective / oracle.objective - 1.0 <= 1e-6 + 1e-9
    assert compared > 100


def test_random_problems_against_scipy() -> None:
    rng = np.random.default_rng(1)
    for grasp in closure_grasps(10):
        problem = Problem("random", grasp, wrenches.sample_ball(rng, 1)[0], 1.0, 0.05, 0.0)
        value, _ = solve_by_scipy(problem)
        solution = optimize_force(grasp, problem.wrench, method="newton", barrier_weight=0.05, tolerance=1e-10)
        assert solution.raise_for_status().objective == pytest.approx(value, rel=1e-8)


@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_known_optimum_replaces_the_certificate(problem: Problem) -> None:
    solution = optimize_force(
        problem.grasp,
        problem.wrench,
        initial="single_value",
        optimum=problem.optimum,
        tolerance=1e-3,
        force_weight=problem.force_weight,
        barrier_weight=problem.barrier_weight,
        trace=True,
    )
    assert solution.status is Status.OPTIMAL
    # it stops at the first iterate within the gap, not an eighth later
    gaps = solution.objective_trace / problem.optimum - 1.0
    assert gaps[-1] <= 1e-3
    assert (gaps[:-1] > 1e-3).all()


def test_scaling_laws_of_phi() -> None:
    """w -> k w with lambda -> k^2 lambda scales the optimal force by k, and Phi too: lambda / omega is in N^2."""
    grasp, k = GRASPS["cuboid, 5"], 7.0
    one = optimize_force(grasp, PAPER_WRENCH, method="newton", barrier_weight=0.01, tolerance=1e-11)
    big = optimize_force(grasp, k * PAPER_WRENCH, method="newton", barrier_weight=0.01 * k**2, tolerance=1e-11)
    assert big.objective == pytest.approx(k * one.objective, rel=1e-10)
    np.testing.assert_allclose(big.force, k * one.force, rtol=0, atol=1e-4)
