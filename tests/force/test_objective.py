"""Phi and its derivatives against their definitions, and the conic problem at any tolerance and at
the edge of feasibility."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import phi as oracle
from problems import GRASPS, OUTSIDE, PAPER_WRENCH, WEIGHTS, closure_grasps, inside_cones

from grasp_env.force import (
    ForceOptimizer,
    Objective,
    Status,
    description_matrix,
    optimize_forces,
)
from grasp_env.grasp import wrench as wrenches

CUBOID = GRASPS["cuboid, 4"]


@pytest.mark.parametrize(("omega", "lam"), WEIGHTS)
def test_phi_its_derivatives_and_bounds(omega, lam):
    """The trace of its definition; derivatives and dual bounds of the oracle, whose derivatives are
    checked by differences."""
    rng = np.random.default_rng(0)
    objective = Objective(omega, lam)
    weights = np.tile([omega, lam], (4, 1))
    for _ in range(40):
        x = inside_cones(rng, 4)
        friction = rng.uniform(0.2, 1.2, 4)
        matrix = description_matrix(
            x.reshape(-1, 3) / np.stack([friction, *np.ones((2, 4))], axis=1), friction
        )
        expected = omega * np.trace(matrix) + lam * np.trace(np.linalg.inv(matrix))
        # the inverse of P loses digits by its condition number, at most 100 here
        assert objective.value(x) == pytest.approx(expected, rel=1e-12)
        full = oracle.hessian(x, weights).reshape(4, 3, 4, 3)
        blocks = np.array([full[k, :, k] for k in range(4)])
        for found, want in (
            (objective.gradient(x), oracle.gradient(x, weights)),
            (objective.hessian(x), blocks),
        ):
            np.testing.assert_allclose(
                found, want.astype(float), rtol=0, atol=1e-11 * float(np.abs(want).max())
            )
    bounded = 0
    for grasp, wrench in zip(
        (*GRASPS.values(), *closure_grasps(15)) * 2, wrenches.sample_ball(rng, 40), strict=True
    ):
        nu = (
            rng.standard_normal(6)
            * omega
            * rng.choice([1e-3, 0.1, 0.5, 2.0])
            / np.repeat([1.0, grasp.length], 3)
        )
        bound = objective.lower_bound(nu, grasp.cone_matrix, wrench)
        want = oracle.lower_bound(
            nu, grasp.cone_matrix, wrench, np.tile([omega, lam], (grasp.n_contacts, 1))
        )
        assert bound == pytest.approx(float(want), rel=1e-11, abs=1e-13)
        bounded += np.isfinite(bound)
    assert bounded > 5


def test_phi_is_infinite_outside_and_on_the_cones():
    for outside in OUTSIDE:
        for x in ([1.0, 0.2, 0.1, *outside], [*outside, 1.0, 0.2, 0.1]):
            assert Objective().value(np.array(x)) == np.inf


# the conic problem


def test_conic_ends_although_rounding_makes_gaps_negative():
    """Once in ten thousand wrenches."""
    loads = np.random.default_rng(4).standard_normal((20_000, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    batch = optimize_forces(CUBOID, loads, method="conic", tolerance=1e-15)
    assert set(np.unique(batch.codes)) <= {0, 1, 2}
    assert (batch.cone_margin >= 0.0).all()


def test_a_pivot_of_rounding_is_lifted():
    """The general program closes the last digits of the largest normal force, which the registers
    leave. Both take 22 iterations on average; without the lift it stalls."""
    loads = np.random.default_rng(3).standard_normal((100, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    solver = ForceOptimizer(CUBOID, method="conic", criterion="max", tolerance=1e-12)
    found = [solver.solve(load) for load in (PAPER_WRENCH, *loads)]
    optimal = [each.status is Status.OPTIMAL for each in found]
    assert sum(optimal) >= 98
    assert np.mean([each.iterations for each in found]) <= 25.0
