"""`criterion="torque"`: the least norm of joint torques, against Clarabel and a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import KINDS, some_grasp

from grasp_env.errors import InfeasibleWrenchError, UnsupportedProblemError
from grasp_env.force import ForceLimits, ForceOptimizer, Margin, optimize_force
from grasp_env.grasp import Grasp, presets

CUBOID = presets.paper_cuboid()


def drawn(seed: int) -> tuple[Grasp, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A grasp, a wrench, the Jacobian (N, 6, J), torque limits (J,), a bias (J,)."""
    rng = np.random.default_rng(1000 + seed)
    grasp = some_grasp(rng, KINDS[seed % len(KINDS)], most=6)
    joints = int(rng.integers(1, 14))
    jacobian = grasp.length * rng.standard_normal((grasp.n_contacts, 6, joints))
    jacobian[:, 3:] /= grasp.length
    size = 10.0 ** rng.uniform(-1.0, 2.0)
    wrench = size * rng.standard_normal(6) * ([1.0] * 3 + [grasp.length] * 3)
    bias = 0.5 * size * grasp.length * rng.standard_normal(joints) * (seed % 2)
    return grasp, wrench, jacobian, np.full(joints, np.inf), bias


def torque_rows(grasp: Grasp, jacobian: np.ndarray) -> np.ndarray:
    """(J, N, 4) torques of unit forces (normal, o, t) and torsions."""
    forces = np.einsum("nrj,nra->jna", jacobian[:, :3], grasp.frames)
    turns = np.einsum("nrj,nr->jn", jacobian[:, 3:], grasp.normals)
    turns = turns * (grasp.models.torsional_friction > 0.0)
    return np.concatenate([forces, turns[:, :, None]], axis=2)


@pytest.mark.parametrize("seed", range(40))
def test_the_norm_is_that_of_clarabel(seed):
    grasp, wrench, jacobian, most, bias = drawn(seed)
    limits = ForceLimits(jacobian=jacobian, torque_limit=most, torque_bias=bias)
    rows = torque_rows(grasp, jacobian)
    exact = Reference(grasp).least_torque(wrench, rows, bias)
    try:
        found = optimize_force(grasp, wrench, method="conic", criterion="torque", limits=limits)
    except InfeasibleWrenchError:
        assert np.isnan(exact)
        return
    norm = float(np.linalg.norm(found.torques))
    scale = float(np.abs(rows).max()) * np.abs(found.force).max()
    assert found.objective == pytest.approx(norm, rel=1e-9, abs=1e-8 * scale)
    assert norm == pytest.approx(exact, rel=2e-6, abs=1e-7 * scale)
    assert found.lower_bound <= norm + 1e-9 * scale
    assert found.lower_bound >= norm * (1.0 - 1.1e-6) - 1e-8 * scale
    reference = Reference(grasp)
    assert (
        reference.residual(found.force, found.torsion, wrench) <= 1e-9 * np.abs(found.force).max()
    )
    assert reference.violation(found.force, found.torsion) <= 1e-12 * np.abs(found.force).max()


def test_no_other_force_of_the_hand_needs_less_torque():
    rng = np.random.default_rng(3)
    jacobian = 0.05 * rng.standard_normal((4, 3, 12))
    limits = ForceLimits(jacobian=jacobian, torque_limit=20.0, max_normal=40.0)
    smaller = 0
    for _ in range(20):
        wrench = rng.standard_normal(6) * [5, 5, 5, 0.1, 0.1, 0.1]
        norms = {}
        for criterion in ("sum", "max", "torque"):
            solution = optimize_force(
                CUBOID, wrench, method="conic", criterion=criterion, limits=limits
            )
            norms[criterion] = np.linalg.norm(solution.torques)
        assert norms["torque"] <= min(norms.values()) * (1.0 + 1e-6)
        smaller += norms["torque"] < 0.99 * norms["sum"]
    assert smaller >= 10  # it is another force


def test_margin_and_limits_hold():
    rng = np.random.default_rng(4)
    jacobian = 0.05 * rng.standard_normal((4, 3, 12))
    tight = ForceLimits(jacobian=jacobian, torque_limit=2.0, torque_bias=0.02 * np.ones(12))
    free = ForceLimits(jacobian=jacobian, torque_limit=np.inf, torque_bias=0.02 * np.ones(12))
    margin = Margin(0.8, 0.3)
    rows = torque_rows(CUBOID, np.concatenate([jacobian, np.zeros((4, 3, 12))], axis=1))
    solver = ForceOptimizer(CUBOID, method="conic", criterion="torque", limits=tight, margin=margin)
    for _ in range(10):
        wrench = rng.standard_normal(6) * [2, 2, 2, 0.05, 0.05, 0.05]
        found = solver.solve(wrench)
        assert found.friction_used.max() <= 0.8 + 1e-9
        assert np.abs(found.torques).max() <= 2.0 + 1e-9
        narrowed = CUBOID.with_friction(0.8 * CUBOID.models.friction)
        preload = np.array([0.3, 0.0, 0.0, 0.0])
        shifted = ForceLimits(
            jacobian=jacobian,
            torque_limit=2.0,
            torque_bias=0.02 + np.einsum("jna,a->j", rows, preload),
        )
        exact = Reference(narrowed, shifted).least_torque(
            wrench + CUBOID.matrix[:, ::3].sum(axis=1) * 0.3,
            rows,
            0.02 + np.einsum("jna,a->j", rows, preload),
        )
        assert found.objective == pytest.approx(exact, rel=2e-6)
        open_norm = optimize_force(
            CUBOID, wrench, method="conic", criterion="torque", limits=free, margin=margin
        ).objective
        assert open_norm <= found.objective * (1.0 + 1e-6)


def test_torques_that_can_vanish_vanish():
    jacobian = np.zeros((4, 3, 1))
    jacobian[0, 0, 0] = 0.05
    limits = ForceLimits(jacobian=jacobian, torque_limit=np.inf, torque_bias=[-0.2])
    found = optimize_force(
        CUBOID, [0, 0, -1, 0, 0, 0], method="conic", criterion="torque", limits=limits
    )
    assert np.abs(found.torques).max() <= 1e-7
    assert found.optimality_gap <= 1e-6


def test_one_motor_of_a_jaw():
    jaw = Grasp.from_contacts(
        [[-0.02, 0, 0], [0.02, 0, 0]],
        [[1, 0, 0], [-1, 0, 0]],
        0.5,
        contact_model="soft",
        torsional_friction=0.005,
    )
    jacobian = np.zeros((2, 3, 1))
    jacobian[0, 0, 0], jacobian[1, 0, 0] = 0.03, -0.03  # both pads close with one motor
    limits = ForceLimits(jacobian=jacobian, torque_limit=np.inf)
    load = [0, 0, -5.0, -0.05, 0, 0]
    found = optimize_force(jaw, load, method="conic", criterion="torque", limits=limits)
    normal = np.hypot(5.0 / 2 / 0.5, 0.05 / 2 / 0.005)
    assert found.objective == pytest.approx(2 * 0.03 * normal, rel=1e-6)


def test_it_needs_a_jacobian_and_conic():
    with pytest.raises(UnsupportedProblemError, match="jacobian"):
        optimize_force(CUBOID, np.zeros(6), method="conic", criterion="torque")
    limits = ForceLimits(max_normal=10.0)
    with pytest.raises(UnsupportedProblemError, match="jacobian"):
        optimize_force(CUBOID, np.zeros(6), method="conic", criterion="torque", limits=limits)
    with pytest.raises(UnsupportedProblemError, match="conic"):
        optimize_force(CUBOID, np.zeros(6), criterion="torque")
    motors = ForceLimits(jacobian=np.ones((4, 3, 2)), torque_limit=np.inf)
    options = {"criterion": "torque", "limits": motors, "force_weight": 2.0}
    with pytest.raises(UnsupportedProblemError, match="force_weight=2"):
        optimize_force(CUBOID, np.zeros(6), method="conic", **options)


def test_infeasible_problems_have_their_proof():
    jacobian = np.zeros((4, 3, 2))
    jacobian[0, 0, 0], jacobian[2, 0, 1] = 0.05, 0.05
    limits = ForceLimits(jacobian=jacobian, torque_limit=0.05, max_normal=5.0)
    with pytest.raises(InfeasibleWrenchError) as caught:
        optimize_force(
            CUBOID, [0, 0, -40, 0, 0, 0], method="conic", criterion="torque", limits=limits
        )
    proof = caught.value.solution
    reference = Reference(CUBOID, limits)
    assert (
        reference.proof(proof.certificate, [0, 0, -40, 0, 0, 0], proof.limit_multipliers) >= -1e-9
    )


def test_a_squeeze_that_costs_no_torque():
    # fingers 0 and 2 push against each other without any motor
    jacobian = np.zeros((4, 3, 2))
    jacobian[1, 1, 0], jacobian[3, 2, 1] = 0.05, 0.05
    limits = ForceLimits(jacobian=jacobian, torque_limit=np.inf)
    found = optimize_force(
        CUBOID, [1, 2, -3, 0.01, 0, 0], method="conic", criterion="torque", limits=limits
    )
    assert np.linalg.norm(found.torques) <= 1e-6 * np.abs(found.force).max()
    assert found.lower_bound == 0.0


@pytest.mark.parametrize("seed", range(30))
def test_fingers_without_motors_press_as_hard_as_it_helps(seed):
    rng = np.random.default_rng(seed)
    jacobian = np.zeros((4, 3, 3))
    jacobian[[1, 3]] = 0.05 * rng.standard_normal((2, 3, 3))
    bias = 0.1 * rng.standard_normal(3)
    limits = ForceLimits(jacobian=jacobian, torque_limit=np.inf, torque_bias=bias)
    wrench = rng.standard_normal(6) * [5, 5, 5, 0.2, 0.2, 0.2]
    found = optimize_force(CUBOID, wrench, method="conic", criterion="torque", limits=limits)
    rows = torque_rows(CUBOID, np.concatenate([jacobian, np.zeros((4, 3, 3))], axis=1))
    exact = Reference(CUBOID).least_torque(wrench, rows, bias)
    assert found.objective == pytest.approx(np.linalg.norm(found.torques), abs=1e-9)
    assert found.objective == pytest.approx(exact, rel=2e-6, abs=1e-6)
    # the best forces have no largest one: the bound pays for rounding, and some calls end stalled
    assert found.optimality_gap <= 1e-4
