"""Every iterate is a valid grasp: balanced, strictly inside, never worse than the one before (Theorem 1)."""

from __future__ import annotations

import numpy as np
import pytest
from problems import GRASPS, PAPER_WRENCH, PROBLEMS, Problem, closure_grasps

from grasp_env.errors import NotConvergedError
from grasp_env.force import DESCENTS, AdaptiveStep, ForceOptimizer, ForceSolution, Status, optimize_force
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches

BALANCE = 1e-10
"""Allowed residual, relative to the forces that have to cancel."""


def _assert_valid(solution: ForceSolution, grasp: Grasp) -> None:
    for force in (solution.force, solution.initial_force):
        assert np.isfinite(force).all()
        # G f + w written without the package's residual
        left = np.concatenate(
            [
                grasp.to_object_frame(force).sum(axis=0) + solution.wrench[:3],
                (np.cross(grasp.positions, grasp.to_object_frame(force)).sum(axis=0) + solution.wrench[3:])
                / grasp.length,
            ]
        )
        size = (
            np.abs(force).max() + np.abs(solution.wrench[:3]).max() + np.abs(solution.wrench[3:]).max() / grasp.length
        )
        assert np.abs(left).max() <= BALANCE * size
        assert grasp.cone_margin(force) > 0.0
    # the solver sums in another order and in cone coordinates: rounding of twelve products
    rounding = 1e-14 * (np.abs(solution.force).max() + np.abs(solution.wrench).max() / grasp.length)
    assert abs(solution.cone_margin - grasp.cone_margin(solution.force)) <= rounding
    assert (
        abs(solution.equilibrium_residual - grasp.residual(solution.force, solution.wrench)) <= rounding / grasp.length
    )


def _assert_monotone(solution: ForceSolution, slack: float = 0.0) -> None:
    trace = solution.objective_trace
    assert len(trace) == solution.iterations + 1
    assert np.isfinite(trace).all()
    assert (np.diff(trace) <= slack * trace[:-1]).all()
    assert trace[-1] == solution.objective


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_stopping_anywhere_leaves_a_valid_grasp(problem: Problem, method: str) -> None:
    def stop(limit: int) -> ForceSolution:
        return optimize_force(
            problem.grasp,
            problem.wrench,
            method=method,
            initial="single_value",
            force_weight=problem.force_weight,
            barrier_weight=problem.barrier_weight,
            tolerance=1e-6,
            max_iterations=limit,
            trace=True,
        )

    end = stop(20_000)
    assert end.status is Status.OPTIMAL
    _assert_valid(end, problem.grasp)
    # Newton accepts a step of equal Phi at the rounding level; the flows only strict decreases
    _assert_monotone(end, 1e-15 if method == "newton" else -1e-300)
    every = 1 if method != "full_flow" else 10  # the dense flow costs a thousand times more per step
    for limit in range(0, min(end.iterations, 80), every):
        solution = stop(limit)
        assert solution.status is Status.ITERATION_LIMIT
        assert solution.iterations == limit
        assert solution.trials >= limit
        _assert_valid(solution, problem.grasp)
        # the same iterates, only fewer
        np.testing.assert_array_equal(solution.objective_trace, end.objective_trace[: limit + 1])


@pytest.mark.parametrize("method", DESCENTS)
def test_no_iterations_returns_the_start(method: str) -> None:
    solution = optimize_force(GRASPS["cuboid, 4"], PAPER_WRENCH, method=method, max_iterations=0, trace=True)
    assert solution.status is Status.ITERATION_LIMIT
    assert (solution.iterations, solution.trials) == (0, 0)
    np.testing.assert_allclose(solution.force, solution.initial_force, rtol=3e-16)
    _assert_valid(solution, GRASPS["cuboid, 4"])
    with pytest.raises(NotConvergedError, match=rf"{method} ended after 0 iterations.*raise max_iterations") as caught:
        solution.raise_for_status()
    assert isinstance(caught.value, RuntimeError)


@pytest.mark.parametrize("name", GRASPS)
def test_balance_does_not_drift_over_many_thousand_steps(name: str) -> None:
    grasp = GRASPS[name]
    solution = optimize_force(
        grasp,
        3.0 * PAPER_WRENCH,
        method="reduced_flow",
        barrier_weight=1e-5,
        tolerance=1e-14,
        max_iterations=20_000,
        trace=True,
    )
    assert solution.iterations > 1000
    _assert_valid(solution, grasp)
    _assert_monotone(solution, -1e-300)


@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
def test_random_grasps_and_wrenches(method: str) -> None:
    rng = np.random.default_rng(0)
    for grasp in closure_grasps():
        optimizer = ForceOptimizer(grasp, method=method, max_iterations=300)
        for wrench in (*wrenches.sample_ball(rng, 4), *wrenches.sample_magnitudes(rng, 4, 1e-3, 1e3)):
            solution = optimizer.solve(wrench, trace=True)
            _assert_valid(solution, grasp)
            _assert_monotone(solution, 1e-15 if method == "newton" else -1e-300)
            assert solution.lower_bound <= solution.objective * (1.0 + 1e-10)


@pytest.mark.parametrize("method", ["reduced_flow", "full_flow"])
@pytest.mark.parametrize(
    "rule",
    [AdaptiveStep(1e-3, grow=1.0), AdaptiveStep(1e6), AdaptiveStep(0.3, grow=10.0, shrink=0.9), AdaptiveStep(1e-12)],
    ids=["constant", "huge", "wild", "tiny"],
)
def test_any_step_rule_keeps_the_grasp_valid(method: str, rule: AdaptiveStep) -> None:
    grasp = GRASPS["cuboid, 4"]
    solution = optimize_force(grasp, PAPER_WRENCH, method=method, step_rule=rule, max_iterations=100, trace=True)
    _assert_valid(solution, grasp)
    _assert_monotone(solution, -1e-300)
    assert solution.iterations > 0


def test_constant_step_accepts_every_trial_where_it_is_admissible() -> None:
    solution = optimize_force(
        GRASPS["cuboid, 4"], PAPER_WRENCH, method="reduced_flow", step_rule=AdaptiveStep(1e-3, grow=1.0),
        max_iterations=100, tolerance=1e-12,
    )  # fmt: skip
    assert solution.iterations == solution.trials == 100


@pytest.mark.parametrize("method", DESCENTS)
def test_impossible_tolerance_stalls_or_converges_but_stays_valid(method: str) -> None:
    grasp = GRASPS["cuboid, 4"]
    solution = optimize_force(grasp, PAPER_WRENCH, method=method, tolerance=1e-300, max_iterations=3000)
    _assert_valid(solution, grasp)
    if solution.status is Status.STALLED:
        with pytest.raises(NotConvergedError, match="more digits than the problem has"):
            solution.raise_for_status()
    else:  # the bound reached Phi in floating point
        assert solution.status is Status.OPTIMAL
        assert solution.optimality_gap == 0.0
    # whatever it says, it is the optimum to rounding
    assert solution.objective == pytest.approx(PROBLEMS[0].optimum, rel=1e-9)


@pytest.mark.parametrize("method", DESCENTS)
def test_same_call_same_bits(method: str) -> None:
    def run() -> np.ndarray:
        return optimize_force(GRASPS["cuboid, 5"], PAPER_WRENCH, method=method).force

    np.testing.assert_array_equal(run(), run())
