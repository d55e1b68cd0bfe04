"""Feasibility of a wrench against linear programs and Clarabel, and its certificates."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import problem
from force.named import NAMED
from problems import closure_grasps, pyramid_margin, random_grasp

from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility

PRESETS = [presets.tripod(), presets.paper_cuboid(), presets.five_finger_cuboid()]


def assert_certificate(grasp: Grasp, wrench: np.ndarray, twist: np.ndarray) -> None:
    """The twist proves that nothing balances the wrench strictly inside: v . (G f + w) = 0 has no room."""
    assert np.abs(twist).max() == pytest.approx(1.0)
    assert np.abs(grasp.cone_matrix.T @ twist).max() > 1e-6  # rank(G) = 6: a twist that moves no contact would be zero
    # 1e-9: the scaled gap at which a wrench counts as balanced on the boundary only
    assert Reference.of(grasp).separates(twist, wrench) >= -1e-7


def test_verdicts_against_linear_programs() -> None:
    rng, verdicts, undecided = np.random.default_rng(41), {True: 0, False: 0}, 0
    closed = [*PRESETS, *closure_grasps()]
    for grasp in [*(random_grasp(rng, 3 + k % 5, cap=[-1.0, -0.3, 0.2][k % 3]) for k in range(60)), *closed]:
        for size in (0.0, 1.0, 50.0):
            wrench = size * rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
            answer = feasibility(grasp, wrench)
            inner, outer = (pyramid_margin(grasp, wrench, inner=inside)[0] for inside in (True, False))
            # the linear solver's feasibility tolerance is 1e-7
            if inner > 1e-6 or grasp in closed:  # force closure is feasibility of every wrench
                assert answer.feasible
            elif outer < 1e-6:
                assert not answer.feasible
            else:
                undecided += 1  # between the pyramids the program cannot tell
            verdicts[answer.feasible] += 1
            assert (answer.force is None) == (answer.certificate is not None)
            if answer.force is not None:
                assert grasp.cone_margin(answer.force) > 0.0
                scale = np.abs(answer.force).max() + np.abs(wrench).max() / grasp.length
                assert grasp.residual(answer.force, wrench) <= 1e-9 * scale
            else:
                assert_certificate(grasp, wrench, answer.certificate)
            if size == 1.0:  # the cones are cones
                assert {feasibility(grasp, k * wrench).feasible for k in (1e-9, 1e-6, 1e4, 1e6)} == {answer.feasible}
    assert min(verdicts.values()) > 30
    assert undecided < 20


def test_certificate_on_the_boundary() -> None:
    """Without a wrench fingers that only push up have the zero force and no other: v . w = 0, every contact on its boundary."""
    floor = NAMED["pushed"].grasp
    assert_certificate(floor, np.zeros(6), feasibility(floor, np.zeros(6)).certificate)


@pytest.mark.parametrize("seed", range(3))
def test_tight_limits_are_decided(seed: int) -> None:
    """Random contacts and limits: feasible exactly where Clarabel finds them feasible."""
    pytest.importorskip("clarabel")
    for index in range(60):
        p = problem("limited", 1000 + seed, index)
        margin = Reference.of(p.grasp, p.limits).margin(p.wrench)
        if abs(margin) > 1e-6:
            assert feasibility(p.grasp, p.wrench, p.limits).feasible == (margin > 0.0)


@pytest.mark.parametrize("size", 10.0 ** -np.arange(2, 17.0, 2))
def test_grasps_next_to_a_symmetric_one(size: float) -> None:
    """Unit normals that nearly balance make the least margin unbounded but for the bound on it."""
    rng = np.random.default_rng(1)
    for preset in (presets.tripod(), presets.five_finger_cuboid()):
        positions = preset.positions + size * 0.05 * rng.standard_normal(preset.positions.shape)
        grasp = Grasp.from_contacts(positions, preset.normals, preset.friction)
        force = feasibility(grasp, np.zeros(6)).force
        assert force is not None
        assert grasp.cone_margin(force) > 0.0
        assert grasp.residual(force, np.zeros(6)) < 1e-12 * np.abs(force).max()


@pytest.mark.parametrize("most", [1e-12, 1e-8, 1e-3, 1.0])
def test_a_rest_within_limits_knows_no_size(most: float) -> None:
    """How deep a force without wrench lies is a part of the tightest limit."""
    found = feasibility(presets.paper_cuboid(), np.zeros(6), ForceLimits(max_normal=most))
    unit = feasibility(presets.paper_cuboid(), np.zeros(6), ForceLimits(max_normal=1.0))
    assert found.feasible
    assert found.margin == pytest.approx(unit.margin, rel=1e-6)
