"""`ForceOptimizer`, the control loop's form, and what a `ForceSolution` says."""

from __future__ import annotations

import numpy as np
import pytest
from problems import GRASPS, LIGHT, PAPER_WRENCH

from grasp_env.force import DESCENTS, ForceOptimizer, LinearCombination, Status, optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp import wrench as wrenches


def _shifted(grasp: Grasp, shift: float) -> Grasp:
    positions = grasp.positions.copy()
    positions[0, 0] += shift
    return Grasp.from_contacts(positions, grasp.normals, grasp.friction)


@pytest.mark.parametrize("method", DESCENTS)
@pytest.mark.parametrize("name", GRASPS)
def test_optimizer_and_function_are_the_same(name: str, method: str) -> None:
    once = optimize_force(GRASPS[name], LIGHT, method=method)
    optimizer = ForceOptimizer(GRASPS[name], method=method)
    for _ in range(2):
        again = optimizer.solve(LIGHT)
        np.testing.assert_array_equal(again.force, once.force)
        assert (again.iterations, again.trials, again.objective) == (once.iterations, once.trials, once.objective)


@pytest.mark.parametrize(("method", "own"), [("newton", "internal_force"), ("reduced_flow", "linear_combination")])
def test_previous_starts_with_the_methods_own_and_then_remembers(method: str, own: str) -> None:
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, method=method, initial="previous")
    first = optimizer.solve(PAPER_WRENCH)
    assert first.initial == own
    if own == "linear_combination":
        np.testing.assert_allclose(first.initial_force, LinearCombination()(grasp, PAPER_WRENCH), rtol=1e-15)
    again = optimizer.solve(PAPER_WRENCH)
    assert (again.initial, again.iterations) == ("previous", 0)
    # a function call with the solution is the same carry-over
    other = optimize_force(grasp, 1.03 * PAPER_WRENCH, method=method, initial=again)
    np.testing.assert_array_equal(other.force, optimizer.solve(1.03 * PAPER_WRENCH).force)
    optimizer.forget()
    assert optimizer.previous is None
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, first.force)


def test_warm_starts_on_the_papers_path_save_steps() -> None:
    path = wrenches.paper_path(np.linspace(0.0, 2.0, 200)) * np.repeat([1.0, 0.05], 3)
    grasp = presets.paper_cuboid()
    warm, cold = (ForceOptimizer(grasp, method="reduced_flow", initial=start) for start in ("previous", None))
    steps = np.array([(warm.solve(w).iterations, cold.solve(w).iterations) for w in path])
    # the notes measure none against tens of steps
    assert np.median(steps[:, 0]) <= 1
    assert steps[:, 0].sum() < 0.2 * steps[:, 1].sum()


def test_forces_along_the_papers_path_are_continuous_and_valid() -> None:
    times = np.linspace(0.0, 2.0, 200)
    path = wrenches.paper_path(times) * np.repeat([1.0, 0.05], 3)
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, initial="previous", method="newton", tolerance=1e-9)
    solutions = [optimizer.solve(w).raise_for_status() for w in path]
    forces = np.array([solution.force for solution in solutions])
    for solution in solutions:
        assert solution.cone_margin > 0.0
        assert solution.equilibrium_residual <= 1e-10 * np.abs(solution.force).max()
    # the wrench moves by up to 0.13 N a sample; the optimum follows it with the gain of G^+ and the squeeze, about ten
    moves = np.abs(np.diff(forces, axis=0)).max(axis=(1, 2))
    assert moves.max() < 10.0 * np.abs(np.diff(path[:, :3], axis=0)).max()


def test_moving_the_grasp_keeps_basis_and_solution_useful() -> None:
    grasp = presets.paper_cuboid()
    optimizer = ForceOptimizer(grasp, method="reduced_flow", initial="previous", tolerance=1e-6)
    optimizer.solve(PAPER_WRENCH)
    moved = _shifted(grasp, 0.0005)
    optimizer.update(positions=moved.positions)
    np.testing.assert_array_equal(optimizer.grasp.positions, moved.positions)
    warm = optimizer.solve(PAPER_WRENCH)
    cold = optimize_force(moved, PAPER_WRENCH, method="reduced_flow", tolerance=1e-6)
    assert warm.initial == "previous"
    assert warm.iterations < cold.iterations
    assert warm.equilibrium_residual < 1e-12
    assert warm.objective == pytest.approx(cold.objective, rel=2e-6)
    # and the other rules read the new grasp
    for rule in ("linear_combination", "single_value", "lagrange", "phase_one"):
        start = optimizer.start(PAPER_WRENCH, initial=rule)
        assert moved.residual(start, PAPER_WRENCH) < 1e-11
        assert moved.cone_margin(start) > 0.0


def test_a_solution_certifies_itself() -> None:
    solution = optimize_force(presets.paper_cuboid(), PAPER_WRENCH)
    assert solution.raise_for_status() is solution
    assert solution.optimality_gap == (solution.objective - solution.lower_bound) / solution.lower_bound
    assert 0.0 < solution.optimality_gap <= 1e-4
    assert solution.total_normal_force == solution.force[:, 0].sum()
    assert solution.certificate is None
    for status in Status:
        assert status.help.endswith((".", "it."))


def test_flow_methods_take_the_same_steps() -> None:
    """One flow in two coordinates: the same count of steps and trials, whatever the number of fingers."""
    for grasp in GRASPS.values():
        full = optimize_force(grasp, LIGHT, method="full_flow", initial="single_value")
        reduced = optimize_force(grasp, LIGHT, method="reduced_flow", initial="single_value")
        assert (full.iterations, full.trials) == (reduced.iterations, reduced.trials)
        np.testing.assert_allclose(full.force, reduced.force, rtol=0, atol=1e-9 * np.abs(full.force).max())
