"""Phase one against linear programs, its certificates, and the offline basis."""

from __future__ import annotations

import numpy as np
import pytest
from problems import closure_grasps, pyramid_margin, random_grasp

from grasp_env.errors import InfeasibleStartError, InfeasibleWrenchError
from grasp_env.force import ForceLimits, Objective, OfflineBasis, Status, optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.quality import feasibility

PRESETS = [presets.tripod(), presets.paper_cuboid(), presets.five_finger_cuboid()]


def assert_certificate(grasp: Grasp, wrench: np.ndarray, twist: np.ndarray) -> None:
    """The twist proves that nothing balances the wrench strictly inside: v . (G f + w) = 0 has no room."""
    assert np.abs(twist).max() == pytest.approx(1.0)
    blocks = (grasp.cone_matrix.T @ twist).reshape(-1, 3)
    assert np.abs(blocks).max() > 1e-6  # rank(G) = 6: a twist that moves no contact would be zero
    # 1e-9: the scaled gap at which a wrench counts as balanced on the boundary only
    assert (blocks[:, 0] - np.hypot(blocks[:, 1], blocks[:, 2]) >= -1e-7 * np.abs(blocks).max()).all()
    assert twist @ wrench >= -1e-7 * np.abs(wrench).max()


def mixed_grasps(number: int) -> list[Grasp]:
    rng = np.random.default_rng(40)
    return [random_grasp(rng, 3 + k % 5, cap=[-1.0, -0.3, 0.2][k % 3]) for k in range(number)]


def test_verdicts_against_linear_programs() -> None:
    rng = np.random.default_rng(41)
    verdicts = {True: 0, False: 0}
    undecided = 0
    for grasp in [*mixed_grasps(60), *closure_grasps()[:6], *PRESETS]:
        for size in (0.0, 1.0, 50.0):
            wrench = size * rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
            answer = feasibility(grasp, wrench)
            inner, outer = (pyramid_margin(grasp, wrench, inner=inside)[0] for inside in (True, False))
            # the linear solver's feasibility tolerance is 1e-7
            if inner > 1e-6:
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
    assert min(verdicts.values()) > 30
    assert undecided < 20


def test_force_closure_is_feasibility_of_every_wrench() -> None:
    rng = np.random.default_rng(42)
    for grasp in [*PRESETS, *closure_grasps()]:
        assert feasibility(grasp, np.zeros(6)).feasible
        for size in (1e-9, 1e-3, 1.0, 1e4):
            assert feasibility(grasp, size * rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]).feasible


def test_verdict_does_not_depend_on_the_size_of_the_wrench() -> None:
    rng = np.random.default_rng(43)
    for grasp in mixed_grasps(24):
        wrench = rng.standard_normal(6) * [1, 1, 1, 0.03, 0.03, 0.03]
        verdicts = {feasibility(grasp, size * wrench).feasible for size in (1e-6, 1.0, 1e6)}
        assert len(verdicts) == 1  # the cones are cones


def without_closure() -> tuple[Grasp, np.ndarray]:
    """Three fingers that only push up, and a load that pulls up."""
    positions = [[0.03, 0.0, 0.0], [-0.02, 0.03, 0.0], [-0.02, -0.03, 0.0]]
    return Grasp.from_contacts(positions, [[0.0, 0.0, 1.0]] * 3, 0.4), np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("rule", [None, "phase_one", "internal_force", "previous"])
def test_an_impossible_wrench_raises_with_its_certificate(rule: str | None) -> None:
    grasp, pull = without_closure()
    with pytest.raises(InfeasibleWrenchError, match="certificate") as caught:
        optimize_force(grasp, pull, initial=rule)
    solution = caught.value.solution
    assert solution is not None
    assert solution.status is Status.INFEASIBLE
    assert solution.certificate is not None
    assert_certificate(grasp, pull, solution.certificate)
    assert solution.certificate @ pull > 0.0
    np.testing.assert_array_equal(solution.wrench, pull)
    with pytest.raises(InfeasibleWrenchError) as again:
        solution.raise_for_status()
    assert again.value.solution is solution
    assert isinstance(caught.value, ValueError)


def test_no_closure_but_a_possible_wrench() -> None:
    grasp, pull = without_closure()
    for rule in ("linear_combination", "single_value", "lagrange"):
        with pytest.raises(InfeasibleStartError, match="force closure"):
            optimize_force(grasp, -pull, initial=rule)
    solution = optimize_force(grasp, -pull, initial="phase_one")
    assert solution.status is Status.OPTIMAL
    # nothing can squeeze: three fingers share 1 N
    assert solution.total_normal_force == pytest.approx(1.0, abs=1e-9)


def test_certificate_on_the_boundary() -> None:
    # at w = 0 fingers that only push up have the zero force and no other: v . w = 0, every contact on its boundary
    grasp, _ = without_closure()
    answer = feasibility(grasp, np.zeros(6))
    assert answer.certificate is not None
    assert_certificate(grasp, np.zeros(6), answer.certificate)


@pytest.mark.parametrize("grasp", [*PRESETS, *closure_grasps()[:6]], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_combination_is_linear_on_an_orthant_and_balanced(grasp: Grasp) -> None:
    rng = np.random.default_rng(44)
    basis = OfflineBasis.of(grasp)
    rest_scale = np.abs(basis.rest).max()
    for _ in range(20):
        sign = rng.choice([-1.0, 1.0], 6)
        one, two = (sign * rng.random(6) * [1, 1, 1, 0.03, 0.03, 0.03] for _ in range(2))
        a, b = rng.random(2) * 5.0
        both = basis.combine(a * one + b * two, printed=True)
        # fifteen additions
        parts = a * basis.combine(one, printed=True) + b * basis.combine(two, printed=True)
        np.testing.assert_allclose(both, parts, rtol=0.0, atol=1e-14 * np.abs(both).max() * 10)
        assert grasp.residual(both, a * one + b * two) <= 1e-10 * np.abs(both).max()  # that of the offline optima
        force = basis.combine(one)
        assert grasp.residual(force, one) <= 1e-10 * np.abs(force).max()
        assert grasp.cone_margin(force) > 0.0
        share = max(0.0, 1.0 - np.abs(one).sum())
        np.testing.assert_allclose(
            force, basis.combine(one, printed=True) + share * basis.rest, atol=1e-13 * rest_scale * 100
        )
    np.testing.assert_array_equal(basis.combine(np.zeros(6), printed=True), 0.0)
    np.testing.assert_array_equal(basis.combine(np.zeros(6)), basis.rest)


@pytest.mark.parametrize("grasp", [*PRESETS, *closure_grasps()[:6]], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_basis_holds_the_optima_of_the_unit_wrenches(grasp: Grasp) -> None:
    objective = Objective(2.0, 0.05)
    basis = OfflineBasis.compute(grasp, objective)
    for k, force in enumerate([*basis.forces, basis.rest]):
        unit = np.zeros(6) if k == 12 else np.concatenate([np.eye(6), -np.eye(6)])[k]
        best = optimize_force(
            grasp, unit, method="newton", initial="phase_one", tolerance=1e-10, force_weight=2.0, barrier_weight=0.05
        )
        # gaps of 1e-10 in Phi: roots of 1e-5 in force
        np.testing.assert_allclose(force, best.force, atol=1e-4 * np.abs(force).max())


@pytest.mark.parametrize("grasp", [*PRESETS, *closure_grasps()[:6]], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_moved_basis_is_the_basis_of_the_new_grasp(grasp: Grasp) -> None:
    rng = np.random.default_rng(45)
    basis = OfflineBasis.compute(grasp)
    for size in (1e-4, 1e-2, 5e-2):
        normals = grasp.normals + size * rng.standard_normal(grasp.normals.shape)
        positions = grasp.positions + size * grasp.length * rng.standard_normal(grasp.positions.shape)
        there = Grasp.from_contacts(positions, normals / np.linalg.norm(normals, axis=1)[:, None], grasp.friction)
        if pyramid_margin(there, np.zeros(6), inner=True)[0] < 0.01:
            continue  # lost its force closure on the way
        warm, cold = basis.moved_to(there), OfflineBasis.compute(there)
        assert OfflineBasis.of(there) is warm
        for one, other in zip(warm.cone_forces, cold.cone_forces, strict=True):
            gap = Objective().value(one) / Objective().value(other) - 1.0
            assert abs(gap) <= 1e-9  # both within 1e-10 of the optimum
            assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max()  # the root of the gap


def test_the_basis_is_remembered_per_grasp_and_objective() -> None:
    grasp = presets.tripod()
    assert OfflineBasis.of(grasp) is OfflineBasis.of(grasp, Objective())
    assert OfflineBasis.of(grasp) is not OfflineBasis.of(grasp, Objective(1.0, 0.1))
    assert OfflineBasis.of(presets.tripod()) is not OfflineBasis.of(grasp)


@pytest.mark.parametrize("most", [1e-12, 1e-8, 1e-3, 1.0])
def test_a_rest_within_limits_knows_no_size(most: float) -> None:
    """How deep a force without wrench lies is a part of the tightest limit."""
    found = feasibility(presets.paper_cuboid(), np.zeros(6), ForceLimits(max_normal=most))
    unit = feasibility(presets.paper_cuboid(), np.zeros(6), ForceLimits(max_normal=1.0))
    assert found.feasible
    assert found.margin == pytest.approx(unit.margin, rel=1e-6)
