"""Rays, segments, repair and carry-over: dense scans, and never worse than a safe force."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from oracles import newton as oracle
from oracles.phi import phi
from problems import PAPER_WRENCH, closure_grasps, random_grasp, weights

from grasp_env import core
from grasp_env.force import ForceOptimizer, Objective, OfflineBasis, Repair, carry_over, optimize_force
from grasp_env.force.basis import core_contacts, starter
from grasp_env.force.repair import CORRECTIONS, Correction
from grasp_env.grasp import Grasp, presets, wrench

OBJECTIVE = Objective()
GRASPS = [presets.tripod(), presets.paper_cuboid(), presets.five_finger_cuboid(), *closure_grasps()[:5]]
GRID = np.arange(0, 64 * 64) / 64.0  # dyadic: with small integers the scan below has no rounding at all


def inside(point: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Which k of GRID have point + k * ray strictly inside every cone."""
    u, o, t = (point.reshape(-1, 3)[None] + GRID[:, None, None] * ray.reshape(-1, 3)[None]).transpose(2, 0, 1)
    return ((u > 0.0) & (u * u > o * o + t * t)).all(axis=1)


@cache
def solver(count: int) -> core.Newton:
    """Of any contacts: rays know cone coordinates only."""
    rng = np.random.default_rng(count)
    return core.Newton.make(core_contacts(random_grasp(rng, count), OBJECTIVE), 1.0, 0)


def ray_interval(point: np.ndarray, ray: np.ndarray) -> tuple[float, float]:
    """By the core, which knows three contacts or more: others stay on the axis of their cone, where they limit nothing."""
    more = max(3 - len(point) // 3, 0)
    axis, stays = np.tile([1.0, 0.0, 0.0], more), np.zeros(3 * more)
    return solver(len(point) // 3 + more).inside(np.concatenate([point, axis]), np.concatenate([ray, stays]))


# more contacts than four take other registers
@pytest.mark.parametrize("contacts", [1, 2, 4, 5, 9])
def test_ray_interval_against_an_exact_scan(contacts: int) -> None:
    # integers from -3 to 3 hit every degenerate case: zero rays, zero points, rays and points on the cone, rays
    # through the apex, rays along the cone that start on it
    rng = np.random.default_rng(contacts)
    found = {True: 0, False: 0}
    for _ in range(4000):
        point = rng.integers(-3, 4, 3 * contacts).astype(float)
        ray = rng.integers(-3, 4, 3 * contacts).astype(float)
        ray[0::3] = np.abs(ray[0::3]) if rng.random() < 0.5 else ray[0::3]
        if contacts > 4:  # so many at random are never inside together
            still = rng.permutation(contacts)[: contacts - 4]
            point.reshape(-1, 3)[still] = [rng.integers(2, 4), 1.0, -1.0]
            ray.reshape(-1, 3)[still] = [rng.integers(0, 3), 0.0, 0.0]
        low, high = ray_interval(point, ray)
        scan = inside(point, ray)
        # roots of quadratics with integer coefficients: off by some 1e-16 relative, grid points at them are left out
        clear = (np.abs(GRID - low) > 1e-9 * (1 + GRID)) & (np.abs(GRID - high) > 1e-9 * (1 + GRID))
        claimed = (low < GRID) & (high > GRID)
        assert (claimed == scan)[clear].all(), (point, ray, low, high)
        if scan.any():
            assert low < high
        found[bool(scan.any())] += 1
    assert min(found.values()) > 20


def test_ray_interval_on_real_numbers() -> None:
    rng = np.random.default_rng(9)
    for kind in range(2000):
        point, ray = rng.standard_normal(9) * 10.0 ** rng.uniform(-3, 3), rng.standard_normal(9)
        if kind % 4 == 0:
            ray[0::3] = np.hypot(ray[1::3], ray[2::3]) * rng.uniform(1.0, 2.0, 3)  # into the cones
        if kind % 7 == 0:
            point = -rng.random() * ray  # through the apex
        low, high = ray_interval(point, ray)
        scan = inside(point, ray)
        # near a tangent root half the digits are lost: 1e-6 of the scale of k is left out
        clear = (np.abs(GRID - low) > 1e-6 * (1 + GRID)) & (np.abs(GRID - high) > 1e-6 * (1 + GRID))
        assert (((low < GRID) & (high > GRID)) == scan)[clear].all(), (point, ray, low, high)


def best_on_segment(grasp: Grasp, safe: np.ndarray, candidate: np.ndarray) -> tuple[float, np.ndarray]:
    """How far along, and the force there."""
    out = candidate.copy()
    return starter(grasp, OBJECTIVE).segment(safe, out), out


ROUNDING = 1e-14
"""Part of Phi by which the best may seem worse than an end: the core compares sums of another order than the oracle."""


@pytest.mark.parametrize("grasp", GRASPS, ids=lambda grasp: f"N{grasp.n_contacts}")
def test_best_on_segment_is_the_best_of_the_segment(grasp: Grasp) -> None:
    rng = np.random.default_rng(30)
    basis = OfflineBasis.of(grasp)
    thetas = np.linspace(0.0, 1.0, 1001)
    for _ in range(100):
        load = rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
        safe = grasp.to_cone(basis.combine(load))
        candidate = safe + rng.standard_normal(safe.size) * safe.max() * 10.0 ** rng.uniform(-3, 0)
        theta, out = best_on_segment(grasp, safe, candidate)
        assert 0.0 <= theta <= 1.0
        value = phi(out, weights(safe))
        assert grasp.cone_margin(grasp.to_force(out)) > 0.0
        assert value <= phi(safe, weights(safe)) * (1.0 + ROUNDING)
        assert value <= phi(candidate, weights(safe)) * (1.0 + ROUNDING)
        scan = min(phi(safe + k * (candidate - safe), weights(safe)) for k in thetas)
        # twelve halvings end within 1e-3 of theta: far less than a tenth of what the segment can gain
        assert value - scan <= 0.1 * (phi(safe, weights(safe)) - scan) + 1e-12 * value


def wild(rng: np.random.Generator, safe: np.ndarray) -> np.ndarray:
    kind = rng.integers(0, 6)
    if kind == 0:
        return safe * rng.uniform(-2.0, 2.0)
    candidate = safe + rng.standard_normal(safe.size) * 10.0 ** rng.uniform(-6, 8)
    if kind == 1:
        candidate[rng.integers(0, safe.size)] = rng.choice([np.nan, np.inf, -np.inf])
    if kind == 2:
        candidate = np.zeros_like(safe)
    return candidate


def test_combinations_are_equations_33_and_34() -> None:
    rng = np.random.default_rng(30)
    for grasp in GRASPS:
        basis, out = OfflineBasis.of(grasp).cone_forces, np.empty(3 * grasp.n_contacts)
        for size in (0.0, 1e-9, 0.1, 1.0, 100.0):
            load = size * rng.standard_normal(6)
            for printed in (False, True):
                wanted = oracle.combine(basis, load, printed)
                core.combine(basis, load, printed, out)
                # sums of at most seven terms
                np.testing.assert_allclose(out, wanted, rtol=0, atol=1e-15 * np.abs(basis).max() * (1.0 + 6 * size))


def test_repair_of_twenty_thousand_candidates_is_never_worse_than_the_basis() -> None:
    rng = np.random.default_rng(31)
    better = 0
    for k in range(20_000):
        grasp = GRASPS[k % len(GRASPS)]
        if k < len(GRASPS):
            OfflineBasis.of(grasp)
        load = rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03] * 10.0 ** rng.uniform(-3, 1)
        safe = np.empty(3 * grasp.n_contacts)
        core.combine(OfflineBasis.of(grasp).cone_forces, load, False, safe)
        candidate = wild(rng, safe)
        flat = candidate / grasp.models.cone_divisor.reshape(-1)
        if np.isfinite(flat).all():  # the steps of `Repair`, without its set-up
            flat = flat - grasp.pseudoinverse @ (grasp.matrix @ flat + load)
            x = grasp.to_cone(flat.reshape(-1, 3))
        else:
            x = safe.copy()
        _, out = best_on_segment(grasp, safe, x)
        assert phi(out, weights(safe)) <= phi(safe, weights(safe)) * (1.0 + ROUNDING)
        assert grasp.cone_margin(grasp.to_force(out)) > 0.0
        force = grasp.to_force(out)
        # what a candidate of 1e8 N leaves of its balance is 1e-7 N, times the part of it that is taken
        assert grasp.residual(force, load) <= 1e-9 * (np.abs(force).max() + np.abs(load).max() / grasp.length)
        better += phi(out, weights(safe)) < phi(safe, weights(safe))
    assert better > 2000


def test_repair_through_the_class() -> None:
    rng = np.random.default_rng(32)
    repair = Repair(OBJECTIVE)
    for k in range(400):
        grasp = GRASPS[k % len(GRASPS)]
        load = rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
        safe = grasp.to_cone(OfflineBasis.of(grasp).combine(load))
        candidate = wild(rng, safe).reshape(-1, 3) / grasp.models.cone_divisor
        if np.isinf(candidate).any():
            candidate[:] = np.nan  # an infinite one overflows inside numpy before the class sees it
        force = repair(grasp, load, candidate)
        # the core compares sums of another order than `Objective.value`
        assert OBJECTIVE.value(grasp.to_cone(force)) <= OBJECTIVE.value(safe) * (1.0 + 1e-14)
        assert grasp.cone_margin(force) > 0.0
        assert grasp.residual(force, load) <= 1e-9 * (np.abs(force).max() + np.abs(load).max() / grasp.length)
        # what is good already is kept: the optimum stays where it is
    solution = optimize_force(GRASPS[1], PAPER_WRENCH, method="newton", tolerance=1e-10)
    np.testing.assert_allclose(repair(GRASPS[1], PAPER_WRENCH, solution.force), solution.force, rtol=1e-12, atol=1e-12)


def moved(grasp: Grasp, rng: np.random.Generator, size: float) -> Grasp:
    normals = grasp.normals + size * rng.standard_normal(grasp.normals.shape)
    positions = grasp.positions + size * grasp.length * rng.standard_normal(grasp.positions.shape)
    return Grasp.from_contacts(positions, normals / np.linalg.norm(normals, axis=1)[:, None], grasp.friction)


@pytest.mark.parametrize("correction", CORRECTIONS)
@pytest.mark.parametrize("grasp", GRASPS, ids=lambda grasp: f"N{grasp.n_contacts}")
def test_carry_over_to_another_grasp_and_wrench(grasp: Grasp, correction: Correction) -> None:
    rng = np.random.default_rng(33)
    load = rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
    previous = optimize_force(grasp, load, method="newton", tolerance=1e-8).force
    for size in (0.0, 1e-3, 1e-2, 3e-2):
        there = moved(grasp, rng, size)
        OfflineBasis.of(grasp).moved_to(there)
        for jump in (0.0, 1e-2, 0.3, 30.0):
            target = load + jump * rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
            force = carry_over(there, target, previous, OBJECTIVE, correction)
            assert there.cone_margin(force) > 0.0
            # rounding of G^+ and of the 12-basis
            assert there.residual(force, target) <= 1e-10 * (np.abs(force).max() + np.abs(target).max() / there.length)
            safe = there.to_cone(OfflineBasis.of(there).combine(target))
            # as above
            assert OBJECTIVE.value(there.to_cone(force)) <= OBJECTIVE.value(safe) * (1.0 + 1e-14)


@pytest.mark.parametrize("grasp", GRASPS[:4], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_tangent_beats_the_pseudoinverse_on_small_steps(grasp: Grasp) -> None:
    path = wrench.sample_path(np.random.default_rng(34), 60, step=0.03)
    optimizer = ForceOptimizer(grasp, method="newton", tolerance=1e-10)
    optima = [optimizer.solve(load) for load in path]
    excess = {
        name: [
            OBJECTIVE.value(grasp.to_cone(carry_over(grasp, path[k], optima[k - 1].force, OBJECTIVE, name)))
            / optima[k].objective
            - 1.0
            for k in range(1, len(path))
        ]
        for name in CORRECTIONS
    }
    # first order against zeroth order: an order of magnitude at 3 % steps, whatever the grasp
    assert np.median(excess["tangent"]) < 0.1 * np.median(excess["pseudoinverse"])
