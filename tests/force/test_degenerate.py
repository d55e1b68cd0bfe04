"""Geometry that is degenerate in exact arithmetic, and repairs in bulk: what once went wrong stays right."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.phi import phi
from problems import GRASPS, closure_grasps, pyramid_margin, random_grasp, weights

from grasp_env.force import ForceOptimizer, Objective, OfflineBasis, Repair, optimize_force
from grasp_env.force.basis import starter
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp import wrench as wrenches
from grasp_env.quality import feasibility


def _inside(rng: np.random.Generator) -> np.ndarray:
    return np.array([1.0, *rng.uniform(-0.6, 0.6, 2)])


def test_rays_straight_through_the_apex() -> None:
    """The discriminant is zero there and rounds to either side."""
    rng = np.random.default_rng(0)
    solver = starter(GRASPS["tripod"], Objective())
    for _ in range(2000):
        x, factor = np.tile(_inside(rng), 3), rng.uniform(0.1, 3.0)
        # a double root: half the digits
        low, high = solver.inside(-factor * x, x)
        assert low == pytest.approx(factor, rel=1e-6)
        assert high == np.inf
        low, high = solver.inside(factor * x, -x)
        assert low == 0.0
        assert high == pytest.approx(factor, rel=1e-6)


@pytest.mark.parametrize("name", GRASPS)
@pytest.mark.parametrize("barrier", [1e-3, 0.01, 1.0])
def test_every_named_grasp_has_a_basis_and_starts_on_the_axes(name: str, barrier: float) -> None:
    """On symmetric grasps the rest force has no tangential part: loads along a normal meet cones at their apex."""
    grasp = GRASPS[name]
    assert OfflineBasis.compute(grasp, Objective(1.0, barrier)).cone_forces.shape == (13, 3 * grasp.n_contacts)
    for k in range(3):
        for size in (-100.0, -1.0, -0.01, 0.01, 1.0, 100.0):
            wrench = size * np.eye(6)[k]
            for initial in ("single_value", "linear_combination"):
                optimize_force(grasp, wrench, initial=initial, barrier_weight=barrier, max_iterations=0)


def test_phase_one_on_grasps_next_to_a_symmetric_one() -> None:
    """Unit normals that nearly balance make the least margin unbounded but for the bound on it."""
    rng = np.random.default_rng(1)
    for preset in (presets.tripod(), presets.five_finger_cuboid()):
        noise = rng.standard_normal(preset.positions.shape)
        for size in 10.0 ** -np.arange(2, 17.0):
            grasp = Grasp.from_contacts(preset.positions + size * 0.05 * noise, preset.normals, preset.friction)
            force = feasibility(grasp, np.zeros(6)).force
            assert force is not None
            assert grasp.cone_margin(force) > 0.0
            assert grasp.residual(force, np.zeros(6)) < 1e-12 * np.abs(force).max()


def test_newton_stays_balanced_on_shallow_grasps_and_heavy_wrenches() -> None:
    """Contacts at very different depths in their cones: the Schur complement alone lost 1e-6 of balance."""
    rng = np.random.default_rng(2)
    tried = 0
    while tried < 25:
        grasp = random_grasp(rng, 3 + tried % 3)
        if not 0.02 < pyramid_margin(grasp, np.zeros(6), inner=True, limited=True)[0] < 0.2:
            continue
        tried += 1
        optimizer = ForceOptimizer(grasp, initial="phase_one", method="newton", tolerance=1e-8)
        for wrench in wrenches.sample_magnitudes(rng, 4, 1.0, 1e3):
            solution = optimizer.solve(wrench)
            size = np.abs(solution.force).max() + wrenches.magnitude(wrench)
            assert solution.equilibrium_residual <= 1e-10 * size
            assert solution.cone_margin > 0.0
            assert solution.lower_bound <= solution.objective * (1.0 + 1e-10)


def test_repair_of_twenty_thousand_candidates_through_the_class() -> None:
    rng = np.random.default_rng(3)
    objective = Objective()
    repair = Repair(objective)
    grasps = [*GRASPS.values(), *closure_grasps(5)]
    count = 20_000
    loads = wrenches.sample_magnitudes(rng, count, 1e-3, 100.0)
    better = 0
    for k in range(count):
        grasp, load = grasps[k % len(grasps)], loads[k]
        safe = OfflineBasis.of(grasp).combine(load)
        candidate = rng.standard_normal((grasp.n_contacts, 3)) * 10.0 ** rng.uniform(-9.0, 9.0)
        if k % 2:
            candidate += safe
        if k % 17 == 0:
            candidate[k % grasp.n_contacts, k % 3] = np.nan
        if k % 19 == 0:
            candidate *= 0.0
        force = repair(grasp, load, candidate)
        value, least = (phi(grasp.to_cone(f), weights(grasp.to_cone(f))) for f in (force, safe))
        # coordinates go to forces and back: one rounding, which the barrier amplifies by u / margin
        assert value <= least * (1.0 + 1e-11)
        assert grasp.cone_margin(force) > 0.0
        size = np.abs(force).max() + wrenches.magnitude(load)
        assert grasp.residual(force, load) <= 1e-9 * size
        better += value < 0.999 * least
    assert better > 1000
