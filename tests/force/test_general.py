"""Soft, elliptic and frictionless contacts, limits on normal forces and joint torques: conic and newton."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference, random_limits, random_wrench, some_grasp
from force.general_problems import CUBOID, LOAD, NAMES, PROBLEMS, jacobian, mixed, soft
from force.test_conic import certified
from scipy.linalg import null_space
from scipy.optimize import minimize

from grasp_env.errors import (
    InfeasibleWrenchError,
)
from grasp_env.force import ForceLimits, ForceOptimizer, ForceSolution, Status, joint_torques, optimize_force
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility


def prices(found: ForceSolution, reference: Reference) -> np.ndarray:
    """The multipliers of the given limits: torsion's own rows come first."""
    return found.limit_multipliers[len(found.limit_multipliers) - len(reference.bound) :]


# conic


@pytest.mark.parametrize("criterion", ["sum", "max"])
@pytest.mark.parametrize("name", NAMES)
def test_conic_is_certified_and_clarabel_agrees(name: str, criterion: str) -> None:
    pytest.importorskip("clarabel")
    grasp, load, limits = PROBLEMS[name]
    found = optimize_force(grasp, load, method="conic", criterion=criterion, limits=limits)
    assert found.status is Status.OPTIMAL
    reference = Reference(grasp, limits)
    answer = reference.solve(load, criterion)
    assert answer.error < 1e-8
    assert found.objective == pytest.approx(answer.objective, rel=1e-6)
    objective, bound = certified(grasp, load, found, criterion, limits)
    assert objective - bound <= 1.01e-6 * objective


@pytest.mark.parametrize("name", [n for n in NAMES if PROBLEMS[n][2] is not None])
@pytest.mark.parametrize("method", ["conic", "newton"])
def test_prices_of_limits_are_positive_and_complementary(name: str, method: str) -> None:
    grasp, load, limits = PROBLEMS[name]
    options = {"tolerance": 1e-8} if method == "conic" else {"tolerance": 1e-10, "barrier_weight": 1e-6}
    optimizer = ForceOptimizer(grasp, method=method, limits=limits, **options)
    found = optimizer.solve(load)
    assert len(optimizer.limit_labels) == len(found.limit_multipliers)
    reference = Reference(grasp, limits)
    assert (found.limit_multipliers >= 0.0).all()
    f = np.column_stack([found.force, found.torsion])
    room = reference.bound - np.einsum("kna,na->k", reference.rows, f)
    assert (room >= -1e-12).all()
    assert float(room @ prices(found, reference)) <= (1e-6 if method == "conic" else 1e-2) * found.objective


def test_limit_labels_name_the_rows() -> None:
    optimizer = ForceOptimizer(mixed(), method="conic", limits=PROBLEMS["all"][2])
    own = [text for text in optimizer.limit_labels if "torsion" in text]
    given = optimizer.limit_labels[len(own) :]
    assert given == PROBLEMS["all"][2].rows(mixed()).labels
    assert len(Reference(mixed(), PROBLEMS["all"][2]).bound) == len(given)
    assert ForceOptimizer(CUBOID, method="conic").limit_labels == ()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("method", ["conic", "newton"])
def test_multipliers_are_the_derivative(name: str, method: str) -> None:
    grasp, load, limits = PROBLEMS[name]

    def solve(w: np.ndarray) -> ForceSolution:
        return optimize_force(grasp, w, method=method, limits=limits, tolerance=1e-10)

    found = solve(load)
    for axis in range(6):
        unit = 1.0 if axis < 3 else grasp.length
        step = np.zeros(6)
        step[axis] = 1e-4 * unit
        slope = (solve(load + step).objective - solve(load - step).objective) / 2e-4
        # a kink of the conic value, or 1e-10 of it, over the step
        assert slope == pytest.approx(-found.multipliers[axis] * unit, abs=2e-3 * found.objective), axis


@pytest.mark.parametrize("method", ["conic", "newton"])
def test_prices_are_the_derivative_with_respect_to_the_limit(method: str) -> None:
    most = np.array([3.5, 2.0, 2.0, 3.0])

    def solve(limit: np.ndarray) -> ForceSolution:
        return optimize_force(CUBOID, LOAD, method=method, limits=ForceLimits(max_normal=limit), tolerance=1e-10)

    found = solve(most)
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-4
        slope = (solve(most + step).objective - solve(most - step).objective) / 2e-4
        assert slope == pytest.approx(-found.limit_multipliers[k], abs=1e-3)


@pytest.mark.parametrize("method", ["conic", "newton"])
@pytest.mark.parametrize("rows", [3, 6])
@pytest.mark.parametrize("limit", [0.6, 0.35, 0.3])
def test_torque_limits_hold(method: str, rows: int, limit: float) -> None:
    grasp, jac = soft(), jacobian(rows=rows)
    bias = np.array([0.05, -0.05, 0.02, 0.0, 0.0])
    limits = ForceLimits(jacobian=jac, torque_limit=limit, torque_bias=bias)
    try:
        found = optimize_force(grasp, LOAD, method=method, limits=limits)
    except InfeasibleWrenchError as error:
        pytest.importorskip("clarabel")
        twist = getattr(error.solution, "certificate", np.zeros(6))
        assert Reference(grasp, limits).separates(twist, LOAD) > 0.0
        return
    moment = found.torsion[:, None] * grasp.normals if rows == 6 else None
    torque = joint_torques(jac, grasp.to_object_frame(found.force), bias, moment=moment)
    assert np.abs(torque).max() <= limit * (1.0 + 1e-14)
    assert limits.violations(grasp, found.force, found.torsion, tolerance=1e-14) == []
    # and they are what holds the objective up
    free = optimize_force(grasp, LOAD, method=method)
    assert found.objective >= free.objective * (1.0 - 1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_infeasible_limits_come_with_a_separating_twist(seed: int) -> None:
    pytest.importorskip("clarabel")
    rng = np.random.default_rng(seed)
    checked = 0
    while checked < 4:
        grasp = some_grasp(rng, str(rng.choice(["hard", "soft", "mixed"])), most=8)
        load = random_wrench(rng, grasp)
        limits = random_limits(rng, grasp, float(np.abs(Reference(grasp).load(load)).max()))
        reference = Reference(grasp, limits)
        if reference.margin(load) > -1e-6:
            continue
        for method in ("conic", "newton"):
            with pytest.raises(InfeasibleWrenchError) as caught:
                optimize_force(grasp, load, method=method, limits=limits)
            assert caught.value.solution is not None
            assert reference.separates(caught.value.solution.certificate, load) > 0.0
        checked += 1


def test_huge_limits_change_nothing() -> None:
    for grasp in (CUBOID, soft(), mixed()):
        loose = ForceLimits(max_normal=1e4, jacobian=jacobian(grasp.n_contacts), torque_limit=1e4)
        for criterion in ("sum", "max"):
            free, held = (
                optimize_force(grasp, LOAD, method="conic", criterion=criterion, limits=limits)
                for limits in (None, loose)
            )
            assert held.objective == pytest.approx(free.objective, rel=2e-6)
            assert prices(held, Reference(grasp, loose)).max() < 1e-5
        free, held = (
            optimize_force(grasp, LOAD, method="newton", limits=limits, tolerance=1e-8) for limits in (None, loose)
        )
        np.testing.assert_allclose(held.force, free.force, atol=1e-3)


@pytest.mark.parametrize("method", ["conic", "newton"])
def test_limits_without_a_finite_entry_are_no_limits(method: str) -> None:
    empty = ForceLimits(jacobian=np.zeros((4, 3, 2)), torque_limit=np.inf)
    want = optimize_force(CUBOID, LOAD, method=method, tolerance=1e-8)
    for limits in (ForceLimits(), empty):
        got = optimize_force(CUBOID, LOAD, method=method, limits=limits, tolerance=1e-8)
        assert got.objective == pytest.approx(want.objective, rel=2e-8)


@pytest.mark.parametrize("ratio", [1e-9, 1e-6, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_limits_far_from_the_wrench_in_size(ratio: float, criterion: str) -> None:
    """A load that is nothing to the least normal forces, and a limit that is nothing to the load."""
    limits = ForceLimits(min_normal=1.0, max_normal=100.0 * max(1.0, ratio))
    found = optimize_force(CUBOID, ratio * LOAD, method="conic", criterion=criterion, limits=limits)
    assert found.status is Status.OPTIMAL
    assert limits.violations(CUBOID, found.force, tolerance=0.0) == []
    assert CUBOID.residual(found.force, ratio * LOAD) <= 1e-9 * ratio + 1e-14 * np.abs(found.force).max()


@pytest.mark.parametrize("method", ["conic", "newton"])
@pytest.mark.parametrize("name", NAMES)
def test_no_wrench(method: str, name: str) -> None:
    grasp, _, limits = PROBLEMS[name]
    found = optimize_force(grasp, np.zeros(6), method=method, limits=limits)
    assert found.status is Status.OPTIMAL
    reference = Reference(grasp, limits)
    assert reference.residual(found.force, found.torsion, np.zeros(6)) <= 1e-14 * max(1.0, np.abs(found.force).max())
    assert reference.violation(found.force, found.torsion) <= 1e-14
    assert found.optimality_gap <= (1e-6 if method == "conic" else 1e-4)


@pytest.mark.parametrize("method", ["conic", "newton"])
def test_least_normals_that_squeeze_without_a_wrench(method: str) -> None:
    found = optimize_force(CUBOID, np.zeros(6), method=method, limits=ForceLimits(min_normal=1.0), barrier_weight=1e-8)
    assert found.force[:, 0].min() >= 1.0
    assert found.total_normal_force == pytest.approx(6.0, rel=1e-3)  # thumb 3 against 1 + 1 + 1


# newton against mathematics written again


def phi(grasp: Grasp, reference: Reference, limits: ForceLimits | None, f: np.ndarray, omega=1.0, lam=0.01) -> float:
    """Phi of forces and torsions (N, 4) by eigenvalues, and of all limits by their distances; +inf outside."""
    mu_o, mu_t = reference.mu.T
    rough, is_soft = mu_o > 0.0, reference.gamma > 0.0
    mu = np.where(rough, np.sqrt(mu_o * mu_t), 1.0)
    u = mu * f[:, 0]
    s = np.where(rough, mu * np.hypot(f[:, 1] / np.where(rough, mu_o, 1.0), f[:, 2] / np.where(rough, mu_t, 1.0)), 0.0)
    spin = np.where(is_soft, mu * f[:, 3] / np.where(is_soft, reference.gamma, 1.0), 0.0)
    sizes = np.array([1.0 / mu, np.where(rough, mu_o / mu, 0.0), np.where(rough, mu_t / mu, 0.0)])
    rooms = []
    if limits is not None:
        for row, bound in zip(reference.rows, reference.bound, strict=True):
            # in cone coordinates (u, o, t, u - v)
            spins = row[:, 3] * np.where(is_soft, reference.gamma / mu, 0.0)
            scaled = np.column_stack([row[:, 0] * sizes[0] + spins, row[:, 1] * sizes[1], row[:, 2] * sizes[2], -spins])
            touched = (scaled != 0.0).any(axis=1)
            rooms.append((bound - float((row * f).sum())) / np.sqrt((scaled[touched] ** 2).sum()))
    distances = np.concatenate([u, u - s, u + s, (u - spin)[is_soft], (u + spin)[is_soft], rooms])
    return float(3.0 * omega * u.sum() + lam * (1.0 / distances).sum()) if (distances > 0.0).all() else np.inf


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("lam", [1.0, 0.01, 1e-5])
def test_newton_is_stationary_and_reports_its_phi(name: str, lam: float) -> None:
    grasp, load, limits = PROBLEMS[name]
    found = optimize_force(grasp, load, method="newton", limits=limits, barrier_weight=lam, tolerance=1e-10)
    assert found.status is Status.OPTIMAL
    reference = Reference(grasp, limits)
    assert reference.residual(found.force, found.torsion, load) < 1e-12
    assert reference.violation(found.force, found.torsion) < 0.0
    f = np.column_stack([found.force, found.torsion])
    assert phi(grasp, reference, limits, f, lam=lam) == pytest.approx(found.objective, rel=1e-9)
    # along every internal direction the derivative vanishes: the parabola through three points has its vertex here
    free = reference.transmits.reshape(-1) > 0.0
    units = np.where(np.arange(4 * grasp.n_contacts) % 4 == 3, 0.005, 1.0)[free]
    basis = null_space(reference.matrix.reshape(6, -1)[:, free] * units)
    for direction in basis.T:
        move = np.zeros(4 * grasp.n_contacts)
        move[free] = units * direction
        move = move.reshape(-1, 4)
        step = 1e-4 * -reference.violation(found.force, found.torsion)
        up, here, down = (phi(grasp, reference, limits, f + k * step * move, lam=lam) for k in (1.0, 0.0, -1.0))
        bend = (up - 2.0 * here + down) / step**2
        slope = (up - down) / (2.0 * step)
        # what could still be gained along it, within the tolerance and the rounding of the differences
        rounding = 1e-15 * here / step
        gain = max(abs(slope) - rounding, 0.0) ** 2 / max(2.0 * bend, 1e-12)
        assert gain <= 1e-7 * here


@pytest.mark.parametrize("name", ["pinch", "soft", "mixed", "hard, largest normal", "hard, torques", "all"])
def test_newton_agrees_with_scipy(name: str) -> None:
    grasp, load, limits = PROBLEMS[name]
    found = optimize_force(grasp, load, method="newton", limits=limits, tolerance=1e-9)
    reference = Reference(grasp, limits)
    start = feasibility(grasp, load, limits)
    free = reference.transmits.reshape(-1) > 0.0
    units = np.where(np.arange(4 * grasp.n_contacts) % 4 == 3, 0.005, 1.0)[free]
    basis = null_space(reference.matrix.reshape(6, -1)[:, free] * units)
    offset = np.column_stack([start.force, start.torsion]).reshape(-1)

    def value(x: np.ndarray) -> float:
        f = offset.copy()
        f[free] += units * (basis @ x)
        return phi(grasp, reference, limits, f.reshape(-1, 4))

    x = np.zeros(basis.shape[1])
    for _ in range(4):
        x = minimize(lambda x: min(value(x), 1e9), x, method="BFGS", options={"gtol": 1e-7, "maxiter": 400}).x
    assert found.objective <= value(x) * (1.0 + 1e-9)
    assert found.objective == pytest.approx(value(x), rel=2e-6)


@pytest.mark.parametrize("name", NAMES)
def test_newton_with_a_vanishing_barrier_tends_to_conic(name: str) -> None:
    grasp, load, limits = PROBLEMS[name]
    friction = np.where(grasp.friction > 0.0, grasp.friction, 1.0)
    if np.ptp(friction) > 0.0:
        pytest.skip("Phi prices u = mu * normal, the conic objective normal")
    want = optimize_force(grasp, load, method="conic", limits=limits).objective
    last = np.inf
    for lam in (1e-2, 1e-4, 1e-6, 1e-8):
        found = optimize_force(grasp, load, method="newton", limits=limits, barrier_weight=lam, tolerance=1e-7)
        excess = found.total_normal_force / want - 1.0
        assert -1e-6 < excess < last
        last = excess
    assert last < 2e-3


@pytest.mark.parametrize("kind", ["soft", "mixed", "limits"])
def test_newton_under_heavy_wrenches_is_inside_with_a_true_bound(kind: str) -> None:
    """Wrenches of 100 to 10000 N with lambda of 1e-4 to 1: no bound lies above an objective, no force outside."""
    rng = np.random.default_rng(42)
    for _ in range(40):
        grasp = some_grasp(rng, "hard" if kind == "limits" else kind, most=12)
        load, lam = random_wrench(rng, grasp, 100.0, 1e4), 10.0 ** rng.uniform(-4.0, 0.0)
        size = float(np.abs(Reference(grasp).load(load)).max())
        limits = random_limits(rng, grasp, size) if kind == "limits" else None
        try:
            answers = [
                optimize_force(grasp, load, method="newton", limits=limits, barrier_weight=lam, tolerance=tolerance)
                for tolerance in (1e-4, 1e-8)
            ]
        except InfeasibleWrenchError:
            continue
        reference = Reference(grasp, limits)
        best = min(found.objective for found in answers)
        for found in answers:
            assert found.status is Status.OPTIMAL, (found, lam)
            # most take twenty; where forces lie at depths from lambda to thousands of newtons, some hundreds of short steps
            assert found.iterations < 500
            assert found.lower_bound <= best * (1.0 + 1e-10)
            assert reference.violation(found.force, found.torsion) < 0.0
            assert found.cone_margin > 0.0
            assert reference.residual(found.force, found.torsion, load) < 1e-9 * size
            f = np.column_stack([found.force, found.torsion])
            assert phi(grasp, reference, limits, f, lam=lam) == pytest.approx(found.objective, rel=1e-8)


@pytest.mark.parametrize("size", [1e-5, 1e-3, 1.0, 1e3])
def test_newton_with_limits_of_the_wrench_own_size(size: float) -> None:
    """lambda in units of the wrench: the same problem at every scale, so the same answer; also far from these units."""
    limits = ForceLimits(max_normal=5.0 * size, jacobian=jacobian(), torque_limit=size)
    same = optimize_force(CUBOID, size * LOAD, method="newton", limits=limits, barrier_weight=0.01 * size**2)
    one = optimize_force(
        CUBOID, LOAD, method="newton", limits=ForceLimits(max_normal=5.0, jacobian=jacobian(), torque_limit=1.0)
    )
    assert same.status is Status.OPTIMAL
    np.testing.assert_allclose(same.force, size * one.force, rtol=0, atol=1e-6 * size)
    for lam in (1e-4, 1.0):
        found = optimize_force(CUBOID, size * LOAD, method="newton", limits=limits, barrier_weight=lam)
        assert found.status is Status.OPTIMAL, found
        assert limits.violations(CUBOID, found.force, tolerance=0.0) == []


@pytest.mark.parametrize("seed", range(3))
def test_phase_one_decides_tight_limits(seed: int) -> None:
    """Found by the trial: it gave up on wrenches that are feasible with a clear margin."""
    pytest.importorskip("clarabel")
    rng = np.random.default_rng(1000 + seed)
    for _ in range(60):
        grasp = some_grasp(rng, str(rng.choice(["hard", "elliptic", "soft", "mixed"])))
        load = random_wrench(rng, grasp)
        limits = random_limits(rng, grasp, float(np.abs(Reference(grasp).load(load)).max()))
        margin = Reference(grasp, limits).margin(load)
        if abs(margin) > 1e-6:
            assert feasibility(grasp, load, limits).feasible == (margin > 0.0)
