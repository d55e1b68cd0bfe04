"""Repair of guesses and carry-over of solutions: balanced, strictly inside, and never worse than what is promised."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from force.test_starts import ALL, CUBOID, OBJECTIVE, assert_start, moved
from oracles.newton import tangent_correction
from oracles.phi import phi
from problems import PAPER_WRENCH

from grasp_env.force import OfflineBasis, Repair, carry_over, optimize_force
from grasp_env.force.repair import CORRECTIONS
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches


def wild(rng: np.random.Generator, safe: np.ndarray) -> np.ndarray:
    """A candidate: near `safe`, far away, nothing, or no numbers."""
    kind = rng.integers(0, 6)
    if kind == 0:
        return safe * rng.uniform(-2.0, 2.0)
    candidate = safe + rng.standard_normal(safe.shape) * 10.0 ** rng.uniform(-6, 9)
    if kind == 1:
        candidate[rng.integers(0, len(safe)), rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf, 1e308])
    return 0.0 * safe if kind == 2 else candidate


def test_repair_is_never_worse_than_the_combination_or_a_good_candidate() -> None:
    rng, repair, better, kept = np.random.default_rng(31), Repair(OBJECTIVE), 0, 0
    for k, load in enumerate(wrenches.sample_magnitudes(rng, 4000, 1e-3, 100.0)):
        grasp = ALL[k % 9]
        safe = OfflineBasis.of(grasp).combine(load)
        candidate = wild(rng, safe)
        force = repair(grasp, load, candidate)
        assert_start(grasp, load, force, 1e-9)  # what a candidate of 1e9 N leaves of its balance
        value, least = (OBJECTIVE.value(grasp.to_cone(f)) for f in (force, safe))
        # coordinates go to forces and back: one rounding, which the barrier amplifies by u / margin
        assert value <= least * (1.0 + 1e-11)
        better += value < 0.999 * least
        if np.isfinite(candidate).all() and np.abs(candidate).max() < 1e6:
            flat = candidate.reshape(-1) - grasp.pseudoinverse @ (grasp.matrix @ candidate.reshape(-1) + load)
            reached = OBJECTIVE.value(grasp.to_cone(flat.reshape(-1, 3)))
            assert value <= reached * (1.0 + 1e-9)
            kept += reached < np.inf
    assert min(better, kept) > 300
    # what is good already is kept: the optimum stays where it is, and what is no candidate is the combination
    best = optimize_force(CUBOID, PAPER_WRENCH, tolerance=1e-10).force
    np.testing.assert_allclose(repair(CUBOID, PAPER_WRENCH, best), best, rtol=1e-12, atol=1e-12)
    safe = OfflineBasis.of(CUBOID).combine(PAPER_WRENCH)
    for value in (np.nan, np.inf, 1e308):
        np.testing.assert_allclose(repair(CUBOID, PAPER_WRENCH, np.full((4, 3), value)), safe, rtol=1e-14)


@pytest.mark.parametrize("grasp", ALL[:9], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_carry_over_to_another_grasp_and_wrench(grasp: Grasp) -> None:
    """Inside and balanced. "tangent" follows the optimum while its Phi is at most twice what it was; the other is never worse than the combination."""
    rng, scale, followed = np.random.default_rng(33), np.array([1, 1, 1, 0.03, 0.03, 0.03]), 0
    load = rng.standard_normal(6) * scale
    previous = optimize_force(grasp, load, tolerance=1e-8).force
    for size in (0.0, 1e-3, 1e-2, 3e-2):
        there = moved(grasp, rng, size)
        OfflineBasis.of(grasp).moved_to(there)
        weights, rows = OBJECTIVE.weights(grasp.n_contacts), there.unit_frame @ there.cone_matrix
        for jump in (0.0, 1e-2, 0.3, 30.0):
            target = load + jump * rng.standard_normal(6) * scale
            made = {name: carry_over(there, target, previous, OBJECTIVE, name) for name in CORRECTIONS}
            for force in made.values():
                assert_start(there, target, force)
            x = there.to_cone(previous).reshape(-1)
            follows = tangent_correction(x, rows, there.unit_frame @ target, weights)
            if phi(follows, weights) <= 1.99 * phi(x, weights):
                followed += 1
                near = 1e-7 * np.abs(follows).max()
                np.testing.assert_allclose(there.to_cone(made["tangent"]).reshape(-1), follows, rtol=0, atol=near)
            safe = OBJECTIVE.value(there.to_cone(OfflineBasis.of(there).combine(target)))
            assert OBJECTIVE.value(there.to_cone(made["pseudoinverse"])) <= safe * (1.0 + 1e-14)
    assert followed >= 4


@pytest.mark.parametrize("grasp", ALL[:4], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_tangent_beats_the_pseudoinverse_on_small_steps(grasp: Grasp) -> None:
    path = wrenches.sample_path(np.random.default_rng(34), 60, step=0.03)
    optima = [optimize_force(grasp, load, tolerance=1e-10) for load in path]
    made = {name: [] for name in CORRECTIONS}
    for k, name in product(range(1, len(path)), CORRECTIONS):
        force = carry_over(grasp, path[k], optima[k - 1].force, OBJECTIVE, name)
        made[name].append(OBJECTIVE.value(grasp.to_cone(force)) / optima[k].objective)
    # first order against zeroth order: an order of magnitude at 3 % steps, whatever the grasp
    assert np.median(made["tangent"]) - 1.0 < 0.1 * (np.median(made["pseudoinverse"]) - 1.0)
