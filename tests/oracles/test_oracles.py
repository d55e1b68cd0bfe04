"""The oracles themselves: derivatives by differences, Phi and its bound by their definitions, optima
of the named problems, margins and Clarabel's reference by hand."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from oracles import geometry, margin, newton, phi, pinch
from problems import PROBLEMS

from grasp_env.force import ForceLimits
from grasp_env.grasp import Grasp

WEIGHTS = np.array([[1.0, 0.01], [0.3, 2.0], [2.5, 1e-3]])
X = np.array([1.0, 0.3, -0.2, 0.4, 0.1, 0.35, 2.0, 0.0, 0.0], dtype=np.longdouble)
OF_ANY_KIND = np.column_stack([WEIGHTS[[0, 1, 1, 2]], [2.0, 2.0, 1.0, -1.0]])
"""Two soft contacts, a hard one and a frictionless one."""
Y = np.array(
    [[1.0, 0.3, -0.2, 0.5], [0.4, 0.0, 0.0, 0.0], [0.4, 0.1, 0.35, 0.0], [2.0, 0.0, 0.0, 0.0]],
    dtype=np.longdouble,
).reshape(-1)


@pytest.mark.parametrize(("x", "weights"), [(X, WEIGHTS), (Y, OF_ANY_KIND)])
def test_derivatives_by_differences(x, weights):
    h = np.longdouble(1e-6)
    hessian = phi.hessian(x, weights)
    for k, e in enumerate(np.eye(len(x), dtype=np.longdouble)):
        slope = (phi.phi(x + h * e, weights) - phi.phi(x - h * e, weights)) / (2 * h)
        # the third derivative times h^2: at most 1e-12 of lambda / depth^4
        assert float(slope) == pytest.approx(float(phi.gradient(x, weights)[k]), rel=1e-7, abs=1e-9)
        bend = (phi.gradient(x + h * e, weights) - phi.gradient(x - h * e, weights)) / (2 * h)
        np.testing.assert_allclose(
            bend.astype(float),
            hessian[k].astype(float),
            rtol=1e-6,
            atol=1e-8 * float(hessian.max()),
        )
    wide = len(x) // len(weights)
    for k, weight in enumerate(weights):
        block = slice(wide * k, wide * (k + 1))
        inverse = phi.inverse_hessian(x[block], *weight)
        np.testing.assert_allclose(
            (hessian[block, block] @ inverse).astype(float), np.eye(wide), atol=1e-14
        )


def test_phi_is_the_trace_of_its_definition():
    """Three units of squeezing for all kinds, and lambda tr P^-1 of the contact's own size."""
    for row, (omega, lam, axial) in zip(Y.astype(float).reshape(-1, 4), OF_ANY_KIND, strict=True):
        parts = row[1 : int(axial) + 2]
        matrix = row[0] * np.eye(len(parts) + 1)
        matrix[0, 1:] = matrix[1:, 0] = parts
        want = 3.0 * omega * row[0] + lam * np.trace(np.linalg.inv(matrix))
        assert phi.phi(row, np.array([[omega, lam, axial]])) == pytest.approx(want, rel=1e-13)
    # outside, although it is inside both of the cones of friction and of torsion
    corner = np.array([1.0, 0.8, 0.0, 0.8])
    assert phi.phi(corner, OF_ANY_KIND[:1]) == np.inf
    assert phi.phi(corner * [1, 1, 1, 0.5], OF_ANY_KIND[:1]) < np.inf


@pytest.mark.parametrize(("x", "weights"), [(X, WEIGHTS), (Y, OF_ANY_KIND)])
def test_the_lagrangian_is_least_where_its_gradient_vanishes(x, weights):
    """phi(x) - y . x is convex: with y = grad phi(x) it is least at x."""
    wide = len(x) // len(weights)
    for row, weight in zip(x.reshape(-1, wide), weights, strict=True):
        pull = phi.gradient(row, weight[None])
        least, ratio = phi.least_of_lagrangian(pull, *weight)
        s = np.sqrt(row[1:] @ row[1:])
        assert least == pytest.approx(
            float(phi.phi(row, weight[None]) - pull @ row), rel=1e-13, abs=1e-15
        )
        assert ratio == pytest.approx(float((row[0] - s) / (row[0] + s)), rel=1e-12)
    # the bound of all contacts, with a wrench that x balances
    matrix = np.random.default_rng(0).standard_normal((6, len(x)))
    gradient = phi.gradient(x, weights).astype(float)
    fitted = np.vstack([matrix[:5], gradient])  # gradient = fitted^T e_6
    bound = phi.lower_bound(np.eye(6)[5], fitted, -fitted @ x.astype(float), weights)
    assert bound == pytest.approx(float(phi.phi(x, weights)), rel=1e-12)


def test_friction_and_torsion_share_a_margin_s_cone():
    """3-4-5 triangles: a soft, a hard and a frictionless contact."""
    mu = np.array([[0.5, 0.5], [0.4, 0.9], [0.0, 0.0]])
    gamma = np.array([0.01, 0.0, 0.0])
    force = np.array([[10.0, 0.0, 3.0, 0.08], [5.0, 0.4, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]])
    # (3 / 0.5, 0.08 / 0.01) = (6, 8)
    np.testing.assert_allclose(margin.friction_used(force, mu, gamma), [1.0, 0.2, 0.0])
    none = np.zeros(3)
    assert margin.cone_margin(force[:1], mu[:1], gamma[:1], 1.0, none[:1]) == pytest.approx(0.0)
    assert margin.cone_margin(force[1:2], mu[1:2], gamma[1:2], 1.0, none[1:2]) == pytest.approx(
        0.6 * (5.0 - 1.0)
    )
    preload = np.array([2.0, 1.0, 1.5])
    assert margin.cone_margin(force, mu, gamma, 0.5, preload) == pytest.approx(
        0.5 * (0.5 * 8.0 - 10.0)
    )
    assert margin.cone_margin(force[2:], mu[2:], gamma[2:], 0.5, preload[2:]) == 0.5


def test_a_proof_against_a_margin_by_hand():
    """The pinch squeezes with 10 N at most: its reach is hypot(F / mu, M / gamma) = 2 m (10 - s),
    and the slope there proves it."""
    mu, gamma = np.full((2, 2), pinch.MU), np.full(2, pinch.GAMMA)
    m, preload = 0.8, np.ones(2)
    matrix = np.zeros((6, 2, 4))
    matrix[:3, :, :3] = pinch.FRAMES.transpose(1, 0, 2)
    matrix[3:, :, :3] = np.cross(
        pinch.POSITIONS[:, None], pinch.FRAMES.transpose(0, 2, 1)
    ).transpose(2, 0, 1)
    matrix[3:, :, 3] = pinch.NORMALS.T
    rows = np.zeros((2, 2, 4))
    rows[0, 0, 0] = rows[1, 1, 0] = 1.0
    reach = 2.0 * m * (10.0 - 1.0)
    load = 0.6 * reach * pinch.MU, 0.8 * reach * pinch.GAMMA
    assert pinch.least_normal(*load, m, 1.0) == pytest.approx(10.0)
    made = np.einsum("rna,na->r", matrix, pinch.forces(10.0, *load))
    np.testing.assert_allclose(made, -pinch.wrench(*load), atol=1e-15)
    twist = -pinch.multipliers(*load)
    for factor, proves in ((1.001, True), (0.999, False)):
        cones, balance = margin.proof_slacks(
            (twist, np.full(2, m)),
            (rows, np.full(2, 10.0)),
            matrix,
            factor * pinch.wrench(*load),
            (mu, gamma),
            (m, preload),
        )
        assert cones == pytest.approx(0.0, abs=1e-15)
        assert (balance > 0.0) == proves
    # a little more torsion leaves the dual cone
    twist[3] *= 1.01
    proof = (twist, np.full(2, m)), (rows, np.full(2, 10.0))
    assert margin.proof_slacks(*proof, matrix, twist, (mu, gamma), (m, preload))[0] < -1e-5


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


def test_clarabel_s_reference_couples_torsion():
    """The least sum, the largest force and their bounds are those of the pinch; the least Phi is
    one of a number."""
    pytest.importorskip("clarabel")
    load = 3.0, 0.08
    wrench, slope = pinch.wrench(*load), pinch.multipliers(*load)
    grasp = Grasp.from_contacts(
        pinch.POSITIONS,
        pinch.NORMALS,
        pinch.MU,
        contact_model="soft",
        torsional_friction=pinch.GAMMA,
    )
    reference = Reference(grasp)
    limited = Reference(grasp, ForceLimits(max_normal=4.9))  # of 5 N
    for criterion, nu, optimum in (("sum", slope, 10.0), ("max", 0.5 * slope, 5.0)):
        found = reference.solve(wrench, criterion)
        assert found.objective == pytest.approx(optimum, rel=1e-9)
        bound, theta = reference.dual_bound(nu, np.zeros(0), wrench, criterion)
        assert (bound, theta) == pytest.approx((optimum, 1.0))
    assert limited.proof(-slope, wrench, np.ones(2)) >= -1e-15
    assert limited.proof(-slope, 0.97 * wrench, np.ones(2)) < 0.0
    assert min(reference.margin(wrench), limited.margin(0.97 * wrench)) > 0.0
    assert limited.margin(wrench) < 0.0
    assert limited.least_excess(wrench) == pytest.approx(5.0 / 4.9 - 1.0, rel=1e-6)

    def at(normal: float) -> tuple[np.ndarray, np.ndarray]:
        f = pinch.forces(normal, *load)
        pushed = np.einsum("nab,nb->na", pinch.FRAMES, f[:, :3])
        return np.einsum("nab,na->nb", grasp.frames, pushed), f[:, 3]

    def phi_at(normal: float) -> float:
        scale = [pinch.MU, 1.0, 1.0, pinch.MU / pinch.GAMMA]
        x = pinch.forces(normal, *load) * scale
        return float(phi.phi(x.reshape(-1), np.tile([1.3, 0.02, 2.0], (2, 1))))

    assert reference.residual(*at(5.0), wrench) < 1e-14
    assert reference.violation(*at(5.0)) == pytest.approx(0.0, abs=1e-14)
    assert reference.violation(*at(pinch.least_normal_apart(*load))) == pytest.approx(1.0)
    assert reference.cone_margin(*at(7.0)) == pytest.approx(pinch.MU * 2.0)
    assert reference.phi(*at(5.3), 1.3, 0.02) == pytest.approx(phi_at(5.3), rel=1e-12)
    values = [phi_at(normal) for normal in np.linspace(5.0, 6.0, 2001)[1:]]
    least, error = reference.least_phi(wrench, 1.3, 0.02)
    assert error < 1e-6
    assert min(values) * (1.0 - 1e-5) <= least <= min(values) * (1.0 + 1e-8)
