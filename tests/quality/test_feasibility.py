"""Feasibility and force closure against linear programs and Clarabel, with their witnesses."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import own_joints
from force.named import NAMED
from problems import GRASPS, closure_grasps, pyramid_margin, random_grasp

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceOptimizer, optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility, force_closure

CUBOID = presets.paper_cuboid()
PALM = Grasp.from_contacts(CUBOID.positions, [[0, 0, 1]] * 4, 0.4)
NOTHING = np.zeros(6)


def assert_certificate(grasp: Grasp, wrench: np.ndarray, twist: np.ndarray) -> None:
    """The twist proves that nothing balances the wrench strictly inside: v . (G f + w) = 0 has no
    room."""
    assert np.abs(twist).max() == pytest.approx(1.0)
    # rank(G) = 6: a twist moves some contact
    assert np.abs(grasp.cone_matrix.T @ twist).max() > 1e-6
    assert Reference(grasp).proof(twist, wrench) >= -1e-7


def test_verdicts_against_linear_programs():
    rng = np.random.default_rng(41)
    verdicts = {True: 0, False: 0}
    undecided = 0
    closed = [*GRASPS.values(), *closure_grasps(8)]
    for k, grasp in enumerate(
        [*(random_grasp(rng, 3 + k % 5, cap=[-1.0, -0.3, 0.2][k % 3]) for k in range(30)), *closed]
    ):
        wrench = [1.0, 50.0][k % 2] * rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
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
        if answer.force is not None:
            assert answer.certificate is None
            assert grasp.cone_margin(answer.force) > 0.0
            scale = np.abs(answer.force).max() + np.abs(wrench).max() / grasp.length
            assert grasp.residual(answer.force, wrench) <= 1e-9 * scale
        else:
            assert_certificate(grasp, wrench, answer.certificate)
        # the cones are cones
        assert {feasibility(grasp, size * wrench).feasible for size in (1e-9, 1e6)} == {
            answer.feasible
        }
    assert min(verdicts.values()) > 8
    assert undecided < 8


@pytest.mark.parametrize("model", ["hard", "soft"])
@pytest.mark.parametrize("what", ["normals", "own joints", "shared joints", "bias"])
def test_without_closure_nothing_needs_no_limit(what, model):
    rng = np.random.default_rng(3)
    jacobian = (
        0.05 * rng.standard_normal((4, 3, 5)) if what == "shared joints" else own_joints(rng, 4)
    )
    bias = 0.01 * (what == "bias") * rng.standard_normal(jacobian.shape[2])
    limits = (
        ForceLimits(max_normal=5.0)
        if what == "normals"
        else ForceLimits(0.0, 7.0, jacobian, 0.3, bias)
    )
    palm = Grasp.from_contacts(
        CUBOID.positions, PALM.normals, 0.4, contact_model=model, torsional_friction=0.01
    )
    with pytest.raises(
        InfeasibleWrenchError, match="strictly inside the friction cones balances"
    ) as caught:
        optimize_force(palm, NOTHING, limits=limits)
    solution = caught.value.solution
    assert not solution.limit_multipliers.any()
    assert Reference(palm).proof(solution.certificate, NOTHING) >= -1e-7


def test_closure_against_linear_programs():
    rng = np.random.default_rng(11)
    verdicts = {True: 0, False: 0}
    for k in range(24):
        grasp = random_grasp(rng, 3 + k % 5)
        found = force_closure(grasp)
        inner, outer = (
            pyramid_margin(grasp, NOTHING, inside, limited=True)[0] for inside in (True, False)
        )
        assert found or not inner > 1e-6
        assert not found or outer > 1e-6
        verdicts[found.closed] += 1
        reversed_ = force_closure(
            Grasp.from_contacts(grasp.positions, -grasp.normals, grasp.friction)
        )
        assert (found.closed, found.margin) == (
            reversed_.closed,
            pytest.approx(reversed_.margin, rel=1e-6, abs=1e-9),
        )
        if not found:
            assert (found.force, found.margin, found.witness is found.twist) == (None, 0.0, True)
            assert found.error <= 1e-8
            assert_certificate(grasp, NOTHING, found.twist)
            assert "normals round gives no force closure either" in found.help + reversed_.help
            continue
        assert (found.twist, found.witness is found.force) == (None, True)
        assert grasp.residual(found.force, NOTHING) <= 1e-14 * np.abs(found.force).sum()
        assert (grasp.friction * found.force[:, 0]).sum() == pytest.approx(1.0)
        least = grasp.cone_margin(found.force)
        assert found.margin == pytest.approx(least / (1.0 + least), rel=1e-5, abs=1e-8)
        # the pyramids inside and outside enclose the depth, for mu * normal that sum to one
        deep = found.margin / (1.0 - found.margin) * grasp.n_contacts
        assert inner * (1.0 - 1e-6) - 1e-7 <= deep <= outer * (1.0 + 1e-6) + 1e-7
    assert min(verdicts.values()) > 4


def test_margins_by_hand_and_soft_contacts():
    pinch = Grasp.from_contacts(
        [[0, 0, -0.02], [0, 0, 0.02]],
        [[0, 0, 1], [0, 0, -1]],
        0.5,
        contact_model="soft",
        torsional_friction=0.005,
    )
    assert force_closure(presets.tripod()).margin == pytest.approx(1 / 4, rel=1e-7)
    outward = Grasp.from_contacts(
        presets.tripod().positions, presets.tripod().normals * [[1.0], [-1.0], [1.0]], 0.5
    )
    assert "normals of contacts [1] point away" in force_closure(outward).help
    assert force_closure(pinch).margin == pytest.approx(1 / 3, rel=1e-7)
    positions = [[0.005, 0, -0.02], [-0.005, 0, 0.02], [0, 0.03, 0], [0, -0.03, 0]]
    normals = [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0, 1, 0]]
    models = ["soft"] * 2 + ["frictionless"] * 2
    grasp = Grasp.from_contacts(
        positions, normals, [[0.5, 0.3]] * 4, contact_model=models, torsional_friction=0.004
    )
    found = force_closure(grasp)
    assert grasp.residual(found.force, NOTHING, found.torsion) <= 1e-14
    assert (np.abs(found.torsion) < 0.004 * found.force[:, 0])[:2].all()
    alone = Grasp.from_contacts(
        positions[:2], [[0, 0, 1]] * 2, 0.5, contact_model="soft", torsional_friction=0.004
    )
    assert_certificate(alone, NOTHING, force_closure(alone).twist)


def test_closure_within_limits():
    limits, impossible = (
        ForceLimits(min_normal=[0.0, 2.0, 2.0, 2.0], max_normal=most) for most in (7.0, 5.0)
    )
    found = force_closure(CUBOID, limits)
    without = force_closure(CUBOID, impossible)
    assert limits.violations(CUBOID, found.force, tolerance=0.0) == []
    assert CUBOID.residual(found.force, NOTHING) <= 1e-13
    assert not without
    assert without.margin < 0.0
    assert "widen the limits" in without.help
    # what the cones forbid, limits do not mend; without a wrench the zero force is on the boundary
    np.testing.assert_array_equal(force_closure(PALM, limits).twist, force_closure(PALM).twist)
    floor = NAMED["pushed"].grasp
    assert_certificate(floor, NOTHING, feasibility(floor, NOTHING).certificate)
    # the depth of a force without wrench is a fraction of the tightest limit
    margins = [
        feasibility(CUBOID, NOTHING, ForceLimits(max_normal=most)).margin
        for most in (1e-12, 1e-3, 1.0)
    ]
    assert margins == pytest.approx([margins[-1]] * 3, rel=1e-6)


@pytest.mark.parametrize("size", [1e-2, 1e-6, 1e-10, 1e-16])
def test_grasps_next_to_a_symmetric_one(size):
    """The margin of unit normals that nearly balance is unbounded but for its own bound."""
    rng = np.random.default_rng(1)
    preset = presets.five_finger_cuboid()
    positions = preset.positions + size * 0.05 * rng.standard_normal(preset.positions.shape)
    grasp = Grasp.from_contacts(positions, preset.normals, preset.friction)
    force = feasibility(grasp, NOTHING).force
    assert grasp.cone_margin(force) > 0.0
    assert grasp.residual(force, NOTHING) < 1e-12 * np.abs(force).max()


def test_a_start_that_does_not_exist_has_the_prices_of_its_proof():
    shared = 0.05 * np.random.default_rng(3).standard_normal((4, 3, 5))
    limits = ForceLimits(jacobian=shared, torque_limit=0.1)
    optimizer = ForceOptimizer(CUBOID, limits=limits)
    wrench = np.array([1.0, 0.5, -20.0, -0.1, 0.2, 0.0])
    optimizer.solve(0.01 * wrench)
    with pytest.raises(InfeasibleWrenchError) as caught:
        optimizer.start(wrench)
    solution = caught.value.solution
    assert solution.limit_multipliers.any()
    assert (
        Reference(CUBOID, limits).proof(solution.certificate, wrench, solution.limit_multipliers)
        >= -1e-6
    )
