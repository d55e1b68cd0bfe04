"""Regressions: grasps die with their last reference, tiny printed starts converge, wild candidates are refused kindly."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import ForceOptimizer, OfflineBasis, Repair, Status, optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility


def test_a_remembered_basis_does_not_keep_its_grasp_alive():
    grasp = presets.tripod()
    OfflineBasis.of(grasp)
    alive = weakref.ref(grasp)
    del grasp
    gc.collect()
    assert alive() is None


@pytest.mark.parametrize("method", ["newton", "reduced_flow"])
def test_going_back_to_a_grasp_gives_the_same_bits(method):
    optimizer = ForceOptimizer(presets.paper_cuboid(), method=method)
    first = optimizer.solve([1, 0, 0, 0, 0, 0]).force
    optimizer.update(friction=0.35)
    assert not np.array_equal(optimizer.solve([1, 0, 0, 0, 0, 0]).force, first)
    optimizer.update(friction=0.4)
    np.testing.assert_array_equal(optimizer.solve([1, 0, 0, 0, 0, 0]).force, first)


@pytest.mark.parametrize("method", ["reduced_flow", "full_flow"])
def test_the_printed_start_of_a_tiny_wrench_converges(method):
    """It starts at Phi = 6e8 next to the apex, jumps far, and once kept the tiny step it had there."""
    wrench = [1e-9, 0, 0, 0, 0, 0]
    solution = optimize_force(presets.paper_cuboid(), wrench, initial="linear_combination_printed", method=method)
    assert solution.status is Status.OPTIMAL


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
def test_repair_of_wild_candidates_is_the_combination(value):
    grasp, wrench = presets.paper_cuboid(), np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])
    safe = OfflineBasis.of(grasp).combine(wrench)
    np.testing.assert_allclose(Repair()(grasp, wrench, np.full((4, 3), value)), safe, rtol=1e-14)


def test_an_optimizer_made_with_a_solution_goes_on_from_its_own():
    grasp = presets.paper_cuboid()
    first = optimize_force(grasp, [1, 0, 0, 0, 0, 0])
    optimizer = ForceOptimizer(grasp, initial=first)
    for k in range(1, 30):  # far from `first` in the end, 3 % at a time
        solution = optimizer.solve([1 + 0.03 * k, 0.03 * k, 0, 0, 0, 0])
        assert solution.initial == "previous"
    assert solution.iterations <= 1


def test_wrong_kinds():
    grasp = presets.paper_cuboid()
    for initial in (3, 1.5, {}):
        with pytest.raises(InvalidInputError, match="initial must be"):
            optimize_force(grasp, np.zeros(6), initial=initial)  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="shape"):
        Repair()(grasp, np.zeros(6), np.zeros((3, 3)))
    with pytest.raises(InvalidInputError, match="1e\\+12"):
        optimize_force(grasp, [1e200] * 6)
    with pytest.raises(InvalidInputError, match="finite"):
        feasibility(grasp, np.full(6, np.nan))
    with pytest.raises(UnknownNameError, match="preset"):
        presets.preset(["a"])  # type: ignore[arg-type]


def test_arrays_may_lie_in_any_order():
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
