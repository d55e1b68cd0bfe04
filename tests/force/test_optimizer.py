"""`ForceOptimizer`, the control loop's form, and what a `ForceSolution` says."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from problems import PAPER_WRENCH

from grasp_env.force import ForceOptimizer, LinearCombination, OfflineBasis, Status, optimize_force, optimize_forces
from grasp_env.grasp import presets
from grasp_env.grasp import wrench as wrenches

CUBOID = presets.paper_cuboid()
PULL = np.eye(6)[0]


@pytest.mark.parametrize(("method", "own"), [("newton", "internal_force"), ("reduced_flow", "linear_combination")])
def test_previous_starts_with_the_methods_own_and_then_remembers(method: str, own: str) -> None:
    optimizer = ForceOptimizer(CUBOID, method=method, initial="previous")
    first = optimizer.solve(PAPER_WRENCH)
    assert first.initial == own
    if own == "linear_combination":
        np.testing.assert_allclose(first.initial_force, LinearCombination()(CUBOID, PAPER_WRENCH), rtol=1e-15)
    again = optimizer.solve(PAPER_WRENCH)
    assert (again.initial, again.iterations) == ("previous", 0)
    # a function call with the solution is the same carry-over
    other = optimize_force(CUBOID, 1.03 * PAPER_WRENCH, method=method, initial=again)
    np.testing.assert_array_equal(other.force, optimizer.solve(1.03 * PAPER_WRENCH).force)
    # a solution that a call is given comes before the last one
    far = optimize_force(CUBOID, -2.0 * PAPER_WRENCH, method=method)
    other = ForceOptimizer(CUBOID, method=method).solve(PAPER_WRENCH, initial=far)
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH, initial=far).force, other.force)
    optimizer.forget()
    assert optimizer.previous is None
    np.testing.assert_array_equal(optimizer.solve(PAPER_WRENCH).force, first.force)
    # and so does another friction, there and back
    plain = ForceOptimizer(CUBOID, method=method)
    plain.update(friction=0.35)
    assert not np.array_equal(plain.solve(PAPER_WRENCH).force, first.force)
    plain.update(friction=0.4)
    np.testing.assert_array_equal(plain.solve(PAPER_WRENCH).force, first.force)


def test_warm_starts_on_the_papers_path_save_steps_and_follow_it() -> None:
    path = wrenches.paper_path(np.linspace(0.0, 2.0, 200)) * np.repeat([1.0, 0.05], 3)
    warm, cold = (ForceOptimizer(CUBOID, method="reduced_flow", initial=start) for start in ("previous", None))
    steps = np.array([(warm.solve(w).iterations, cold.solve(w).iterations) for w in path])
    # the notes measure none against tens of steps
    assert np.median(steps[:, 0]) <= 1
    assert steps[:, 0].sum() < 0.2 * steps[:, 1].sum()
    newton = ForceOptimizer(CUBOID, initial="previous", tolerance=1e-9)
    forces = np.array([newton.solve(w).raise_for_status().force for w in path])
    # the wrench moves by up to 0.13 N a sample; the optimum follows it with the gain of G^+ and the squeeze, about ten
    assert np.abs(np.diff(forces, axis=0)).max() < 10.0 * np.abs(np.diff(path[:, :3], axis=0)).max()
    first = optimize_force(CUBOID, PULL)
    optimizer = ForceOptimizer(CUBOID, initial=first)
    for k in range(1, 30):  # far from `first` in the end, 3 % at a time
        found = optimizer.solve([1 + 0.03 * k, 0.03 * k, 0, 0, 0, 0])
        assert found.initial == "previous"
    assert found.iterations <= 1


@pytest.mark.parametrize("method", ["newton", "conic"])
def test_the_answer_does_not_follow_the_wrench_that_the_caller_changes(method: str) -> None:
    optimizer, load = ForceOptimizer(CUBOID, method=method), PAPER_WRENCH.copy()
    first = optimizer.solve(load)
    np.testing.assert_array_equal(load, PAPER_WRENCH)
    force = first.force.copy()
    load[:] = 7.0
    optimizer.solve(load)
    np.testing.assert_array_equal(first.force, force)
    np.testing.assert_array_equal(first.wrench, PAPER_WRENCH)


def test_a_solution_certifies_itself() -> None:
    solution = optimize_force(CUBOID, PAPER_WRENCH)
    assert solution.raise_for_status() is solution
    assert solution.optimality_gap == (solution.objective - solution.lower_bound) / solution.lower_bound
    assert 0.0 < solution.optimality_gap <= 1e-4
    assert solution.total_normal_force == solution.force[:, 0].sum()
    assert solution.certificate is None
    with pytest.raises(ValueError, match="read-only"):
        solution.force[0, 0] = 0.0
    for status in Status:
        assert status.help.endswith((".", "it."))


def test_a_remembered_basis_does_not_keep_its_grasp_alive() -> None:
    grasp = presets.tripod()
    OfflineBasis.of(grasp)
    alive = weakref.ref(grasp)
    del grasp
    gc.collect()
    assert alive() is None


LOAD = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.0078125]).astype(np.float32).astype(float)


@pytest.mark.parametrize("method", ["conic", "newton", "reduced_flow"])
def test_numbers_in_any_form_and_order_are_the_same(method: str) -> None:
    optimizer, frozen = ForceOptimizer(CUBOID, method=method), LOAD.copy()
    frozen.flags.writeable = False
    want = optimizer.solve(LOAD)
    for given in (
        LOAD.tolist(), tuple(LOAD.tolist()), frozen, np.repeat(LOAD, 2)[::2], LOAD[::-1].copy()[::-1], LOAD.astype(np.float32),
        np.asfortranarray(np.tile(LOAD, (3, 1)))[1],
    ):  # fmt: skip
        np.testing.assert_array_equal(optimizer.solve(given)._record, want._record)
    assert ForceOptimizer(CUBOID, method=method, max_iterations=np.int64(1)).solve(LOAD).iterations == 1
    turned, loads = np.asfortranarray, np.random.default_rng(0).standard_normal((5, 6)) * [1, 1, 1, 0.03, 0.03, 0.03]
    rows = optimize_forces(CUBOID, loads, method=method)
    np.testing.assert_array_equal(optimize_forces(CUBOID, turned(loads), method=method).force, rows.force)
    if method != "conic":
        start = optimize_force(CUBOID, LOAD, method=method).initial_force
        known = optimizer.solve(LOAD, initial=start)
        for asked in (turned(start), lambda grasp, wrench: start, lambda grasp, wrench: turned(start)):
            np.testing.assert_array_equal(optimizer.solve(LOAD, initial=asked).force, known.force)
