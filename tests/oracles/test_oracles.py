"""The oracles themselves: derivatives by differences, optima of the named problems, a null space
made another way."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import geometry, newton, phi
from problems import PROBLEMS

WEIGHTS = np.array([[1.0, 0.01], [0.3, 2.0], [2.5, 1e-3]])
X = np.array([1.0, 0.3, -0.2, 0.4, 0.1, 0.35, 2.0, 0.0, 0.0], dtype=np.longdouble)


def test_derivatives_by_differences():
    h = np.longdouble(1e-6)
    for k, e in enumerate(np.eye(9, dtype=np.longdouble)):
        slope = (phi.phi(X + h * e, WEIGHTS) - phi.phi(X - h * e, WEIGHTS)) / (2 * h)
        # the third derivative times h^2: at most 1e-12 of lambda / depth^4
        assert float(slope) == pytest.approx(float(phi.gradient(X, WEIGHTS)[k]), rel=1e-7, abs=1e-9)
        bend = (phi.gradient(X + h * e, WEIGHTS) - phi.gradient(X - h * e, WEIGHTS)) / (2 * h)
        hessian = phi.hessian(X, WEIGHTS)
        np.testing.assert_allclose(
            bend.astype(float),
            hessian[k].astype(float),
            rtol=1e-6,
            atol=1e-8 * float(hessian.max()),
        )
    for k in range(3):
        block = slice(3 * k, 3 * k + 3)
        inverse = phi.inverse_hessian(X[block], *WEIGHTS[k])
        np.testing.assert_allclose(
            (hessian[block, block] @ inverse).astype(float), np.eye(3), atol=1e-14
        )


@pytest.mark.parametrize("problem", PROBLEMS, ids=str)
def test_optima_are_those_of_the_named_problems(problem):
    grasp = problem.grasp
    weights = np.tile([problem.force_weight, problem.barrier_weight], (grasp.n_contacts, 1))
    frames = np.array([geometry.frame(n) for n in grasp.normals])
    unit = geometry.unit_frame(grasp.positions)[2]
    scale = np.column_stack([grasp.friction, np.ones((grasp.n_contacts, 2))]).reshape(-1)
    rows = unit @ geometry.grasp_matrix(grasp.positions, frames) / scale
    rest = newton.internal_force(rows, weights)
    x, multipliers = newton.minimum(rest, rows, unit @ problem.wrench, weights)
    # certified to 1e-11 there
    assert phi.phi(x, weights) == pytest.approx(problem.optimum, rel=5e-11)
    assert phi.lower_bound(multipliers, rows, unit @ problem.wrench, weights) == pytest.approx(
        problem.optimum, rel=5e-11
    )
    if problem.total_normal is not None:
        assert (x[0::3] / grasp.friction).sum() == pytest.approx(problem.total_normal, abs=5e-3)
