"""`ForceOptimizer`, the control loop's form, and what a `ForceSolution` says."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from problems import GRASPS, LIGHT, PAPER_WRENCH

from grasp_env.force import ForceOptimizer, LinearCombination, OfflineBasis, Status, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp import wrench as wrenches


def _shifted(grasp: Grasp, shift: float) -> Grasp:
    positions = grasp.positions.copy()
    positions[0, 0] += shift
    return Grasp.from_contacts(positions, grasp.normals, grasp.friction)


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
    # a solution that a call is given comes before the last one
    far = optimize_force(grasp, -2.0 * PAPER_WRENCH, method=method)
    other = ForceOptimizer(grasp, method=method).solve(PAPER_WRENCH, initial=far)
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH, initial=far).force, other.force)
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


@pytest.mark.parametrize("method", ["newton", "conic"])
def test_the_answer_does_not_follow_the_wrench_that_the_caller_changes(method: str) -> None:
    optimizer, load = ForceOptimizer(presets.paper_cuboid(), method=method), PAPER_WRENCH.copy()
    first = optimizer.solve(load)
    force = first.force.copy()
    load[:] = 7.0
    optimizer.solve(load)
    np.testing.assert_array_equal(first.force, force)
    np.testing.assert_array_equal(first.wrench, PAPER_WRENCH)


def test_a_solution_certifies_itself() -> None:
    solution = optimize_force(presets.paper_cuboid(), PAPER_WRENCH)
    assert solution.raise_for_status() is solution
    assert solution.optimality_gap == (solution.objective - solution.lower_bound) / solution.lower_bound
    assert 0.0 < solution.optimality_gap <= 1e-4
    assert solution.total_normal_force == solution.force[:, 0].sum()
    assert solution.certificate is None
    with pytest.raises(ValueError, match="read-only"):
        solution.force[0, 0] = 0.0
    for status in Status:
        assert status.help.endswith((".", "it."))


def test_flow_methods_take_the_same_steps() -> None:
    """One flow in two coordinates: the same count of steps and trials, whatever the number of fingers."""
    for grasp in GRASPS.values():
        full = optimize_force(grasp, LIGHT, method="full_flow", initial="single_value")
        reduced = optimize_force(grasp, LIGHT, method="reduced_flow", initial="single_value")
        assert (full.iterations, full.trials) == (reduced.iterations, reduced.trials)
        np.testing.assert_allclose(full.force, reduced.force, rtol=0, atol=1e-9 * np.abs(full.force).max())


def test_a_remembered_basis_does_not_keep_its_grasp_alive() -> None:
    grasp = presets.tripod()
    OfflineBasis.of(grasp)
    alive = weakref.ref(grasp)
    del grasp
    gc.collect()
    assert alive() is None


@pytest.mark.parametrize("method", ["newton", "reduced_flow"])
def test_going_back_to_a_grasp_gives_the_same_bits(method: str) -> None:
    optimizer = ForceOptimizer(presets.paper_cuboid(), method=method)
    first = optimizer.solve([1, 0, 0, 0, 0, 0]).force
    optimizer.update(friction=0.35)
    assert not np.array_equal(optimizer.solve([1, 0, 0, 0, 0, 0]).force, first)
    optimizer.update(friction=0.4)
    np.testing.assert_array_equal(optimizer.solve([1, 0, 0, 0, 0, 0]).force, first)


def test_an_optimizer_made_with_a_solution_goes_on_from_its_own() -> None:
    grasp = presets.paper_cuboid()
    first = optimize_force(grasp, [1, 0, 0, 0, 0, 0])
    optimizer = ForceOptimizer(grasp, initial=first)
    for k in range(1, 30):  # far from `first` in the end, 3 % at a time
        solution = optimizer.solve([1 + 0.03 * k, 0.03 * k, 0, 0, 0, 0])
        assert solution.initial == "previous"
    assert solution.iterations <= 1


def test_arrays_may_lie_in_any_order() -> None:
    """Transposes and columns of other arrays are everyday numpy: the same answers as from rows."""
    turned = np.asfortranarray
    plain = presets.paper_cuboid()
    grasp = Grasp.from_contacts(
        turned(plain.positions), turned(plain.normals), 0.4, tangents=turned(plain.frames[:, :, 1])
    )
    np.testing.assert_array_equal(grasp.matrix, plain.matrix)
    loads = np.random.default_rng(0).standard_normal((5, 6)) * [1, 1, 1, 0.03, 0.03, 0.03]
    for method in ("newton", "conic", "reduced_flow"):
        rows = optimize_forces(plain, loads, method=method)
        np.testing.assert_array_equal(optimize_forces(plain, turned(loads), method=method).force, rows.force)
        column = np.stack([loads[0], loads[1]], axis=1)[:, 0]
        # what the core cannot read as it lies takes the general path, and batches sum in another order: another rounding
        np.testing.assert_allclose(optimize_force(plain, column, method=method).force, rows.force[0], rtol=1e-9)
    start = optimize_force(plain, loads[0]).initial_force
    for initial in (start, lambda grasp, wrench: start):
        known = optimize_force(plain, loads[0], method="newton", initial=initial)
        asked = turned(start) if initial is start else lambda grasp, wrench: turned(start)
        np.testing.assert_array_equal(
            optimize_force(plain, loads[0], method="newton", initial=asked).force, known.force
        )
