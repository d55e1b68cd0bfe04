"""Every start is balanced and strictly inside the cones, or says why there is none."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from problems import GRASPS, PAPER_WRENCH, closure_grasps
from scipy.optimize import minimize_scalar

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import (
    RULES,
    ForceOptimizer,
    LinearCombination,
    Objective,
    OfflineBasis,
    Repair,
    initial_rule,
    optimize_force,
    optimize_forces,
    start_replaced,
)
from grasp_env.force.rules import CoreStart
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches

MAGNITUDES = (0.0, 1e-9, 1e-3, 1.0, 1e4)


def _wrenches() -> list[np.ndarray]:
    """Random directions and the twelve axes, where starts degenerate, at every magnitude."""
    directions = wrenches.sample_magnitudes(np.random.default_rng(0), 4, 1.0, 1.0 + 1e-9)
    axes = np.concatenate([np.eye(6), -np.eye(6)]) * np.repeat([1.0, wrenches.MAGNITUDE_LENGTH], 3)
    return [magnitude * d for magnitude in MAGNITUDES for d in (*directions, *axes)]


def _assert_start(grasp: Grasp, wrench: np.ndarray, force: np.ndarray) -> None:
    assert force.shape == (grasp.n_contacts, 3)
    assert np.isfinite(force).all()
    assert grasp.cone_margin(force) > 0.0
    size = np.abs(force).max() + np.abs(wrench[:3]).max() + np.abs(wrench[3:]).max() / grasp.length
    # rounding of sums of forces of this size: far below what a flow may add
    assert grasp.residual(force, wrench) <= 1e-10 * size


_ALL = [*GRASPS.values(), *closure_grasps(15)]


@pytest.mark.parametrize("name", ["linear_combination", "single_value", "phase_one"])
@pytest.mark.parametrize("k", range(len(_ALL)))
def test_rules_that_always_have_a_start(k: int, name: str) -> None:
    grasp, rule = _ALL[k], initial_rule(name)
    few = _wrenches() if name != "phase_one" else _wrenches()[::3]  # milliseconds each
    for wrench in few:
        _assert_start(grasp, wrench, rule(grasp, wrench))


@pytest.mark.parametrize("name", GRASPS)
def test_printed_combination_has_a_start_for_every_wrench_but_none(name: str) -> None:
    rule = initial_rule("linear_combination_printed")
    for wrench in _wrenches():
        if wrench.any():
            _assert_start(GRASPS[name], wrench, rule(GRASPS[name], wrench))
    with pytest.raises(InfeasibleStartError, match="zero at w = 0"):
        rule(GRASPS[name], np.zeros(6))


def _best_lagrange_margin(grasp: Grasp, wrench: np.ndarray) -> float:
    """Largest cone margin over k >= 0 of argmin (f - k n)^T W (f - k n), G f = -w, by the KKT system of each k."""
    count = grasp.n_contacts
    weights = np.tile([1.0, 10.0, 10.0], count)
    normals = np.tile([1.0, 0.0, 0.0], count)
    kkt = np.block([[np.diag(weights), grasp.matrix.T], [grasp.matrix, np.zeros((6, 6))]])

    def force(k: float) -> np.ndarray:
        return np.linalg.solve(kkt, np.concatenate([weights * k * normals, -wrench]))[: 3 * count].reshape(-1, 3)

    at_zero, slope = force(0.0), force(1.0) - force(0.0)

    def loss(k: float) -> float:  # convex in k: minus a minimum of concave margins
        return -grasp.cone_margin(at_zero + k * slope)

    far = 1e4 * (1.0 + np.abs(at_zero).max())
    answers = [
        minimize_scalar(loss, bounds=(0.0, high), method="bounded").fun for high in (far, 0.01 * far, 1e-4 * far)
    ]
    return -min(answers)


def test_lagrange_has_a_start_or_none_exists() -> None:
    rule = CoreStart("lagrange")
    starts = misses = 0
    rng = np.random.default_rng(1)
    for grasp in (*GRASPS.values(), *closure_grasps(40)):
        for wrench in (np.zeros(6), *wrenches.sample_ball(rng, 5), *wrenches.sample_magnitudes(rng, 5, 1e-2, 1e3)):
            try:
                force = rule(grasp, wrench)
            except InfeasibleStartError:
                misses += 1
                # the scan's own accuracy, relative to the forces it cancels
                assert _best_lagrange_margin(grasp, wrench) <= 1e-6 * (1e-3 + np.abs(wrench).max())
            else:
                starts += 1
                _assert_start(grasp, wrench, force)
    # both happen: the notes call a miss usual on random grasps
    assert starts > 100
    assert misses > 20


def test_lagrange_minimises_what_it_says() -> None:
    """Some k makes the start the KKT point of that k: stationarity is linear, so k is found by least squares."""
    grasp = GRASPS["cuboid, 4"]
    force = CoreStart("lagrange")(grasp, PAPER_WRENCH).reshape(-1)
    weights = np.tile([1.0, 10.0, 10.0], 4)
    normals = np.tile([1.0, 0.0, 0.0], 4)
    # W (f - k n) = G^T nu for some (k, nu)
    system = np.column_stack([weights * normals, grasp.matrix.T])
    solution = np.linalg.lstsq(system, weights * force)[0]
    np.testing.assert_allclose(system @ solution, weights * force, atol=1e-11)
    assert solution[0] > 0.0


def test_single_value_is_the_pseudoinverse_plus_the_least_squeeze() -> None:
    grasp = GRASPS["cuboid, 4"]
    force = initial_rule("single_value")(grasp, PAPER_WRENCH)
    rest = OfflineBasis.of(grasp).rest
    particular = -(grasp.pseudoinverse @ PAPER_WRENCH).reshape(-1, 3)
    k = float(np.vdot(force - particular, rest) / np.vdot(rest, rest))
    np.testing.assert_allclose(force, particular + k * rest, atol=1e-12)
    # 1.1 times the least feasible factor: at k / 1.1 the margin is zero
    assert k > 1.0
    assert grasp.cone_margin(particular + k / 1.1 * rest) == pytest.approx(0.0, abs=1e-12)
    # and at no wrench it is the rest force itself
    np.testing.assert_allclose(initial_rule("single_value")(grasp, np.zeros(6)), rest, rtol=1e-14)


def test_combination_of_a_unit_wrench_is_its_optimum() -> None:
    grasp = GRASPS["cuboid, 5"]
    basis = OfflineBasis.of(grasp)
    rule = LinearCombination()
    for k in range(6):
        for sign, row in ((1.0, k), (-1.0, k + 6)):
            wrench = np.zeros(6)
            wrench[k] = sign
            np.testing.assert_array_equal(rule(grasp, wrench), basis.forces[row])
    np.testing.assert_array_equal(rule(grasp, np.zeros(6)), basis.rest)


def test_rules_take_the_objective_they_are_given() -> None:
    grasp = GRASPS["cuboid, 4"]
    for name in RULES:
        if name == "phase_one":
            continue
        cheap = initial_rule(name, Objective(1.0, 1e-4))(grasp, PAPER_WRENCH)
        dear = initial_rule(name, Objective(1.0, 10.0))(grasp, PAPER_WRENCH)
        assert cheap[:, 0].sum() < dear[:, 0].sum()


def test_grasp_without_closure_has_no_basis_but_phase_one_has_a_start() -> None:
    grasp = Grasp.from_contacts([[0.03, 0, 0], [-0.03, 0.02, 0], [-0.02, -0.03, 0]], [[0.0, 0.0, 1.0]] * 3, 0.4)
    down = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])
    for name in ("linear_combination", "single_value", "lagrange"):
        with pytest.raises(InfeasibleStartError, match=r"no force closure.*initial='phase_one'"):
            initial_rule(name)(grasp, down)
    for initial in (None, "previous"):  # no start was named, or there is none yet
        for method in ("newton", "reduced_flow"):
            solution = optimize_force(grasp, down, method=method, initial=initial)
            assert (solution.status.name, solution.initial) == ("OPTIMAL", "phase_one")
    with pytest.raises(InfeasibleStartError, match="no force closure"):
        optimize_force(grasp, down, initial="linear_combination")
    _assert_start(grasp, down, initial_rule("phase_one")(grasp, down))
    with pytest.raises(InfeasibleStartError, match="no force strictly inside the cones"):
        initial_rule("phase_one")(grasp, -down)


def squeezing(newtons: float) -> Callable[[Grasp, np.ndarray], np.ndarray]:
    """A rule of somebody who guesses so much force along every normal."""

    def squeeze(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        return Repair()(grasp, wrench, np.tile([newtons, 0.0, 0.0], (grasp.n_contacts, 1)))

    return squeeze


@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
@pytest.mark.parametrize("newtons", [1.0, 10.0, np.nan])
@pytest.mark.parametrize("weight", [0.01, 0.02])
def test_a_guess_of_which_nothing_is_left_is_told(method: str, newtons: float, weight: float) -> None:
    """Also by a rule that repairs in another Phi than the one that is solved; without a wrench there is nothing to replace."""
    grasp, rule, told = GRASPS["cuboid, 4"], squeezing(newtons), newtons != 1.0
    optimizer = ForceOptimizer(grasp, method=method, initial=rule, barrier_weight=weight)
    loads = wrenches.sample_ball(np.random.default_rng(0), 30)
    for wrench in loads:
        solution = optimizer.solve(wrench)
        assert solution.start_replaced is told
        assert solution.initial == ("linear_combination (squeeze was replaced)" if told else "squeeze")
        assert pickle.loads(pickle.dumps(solution)).start_replaced is told
        paper = LinearCombination()(grasp, wrench)
        assert told == (np.abs(solution.initial_force - paper).max() < 1e-9)
        assert start_replaced(grasp, wrench, solution.initial_force) is told
    batch = optimize_forces(grasp, loads, method=method, initial=rule, barrier_weight=weight)
    assert batch.initial == batch[0].initial
    assert all(each.start_replaced is told for each in batch)
    assert optimizer.solve(np.zeros(6)).start_replaced is False


def test_each_wrench_of_a_batch_says_whether_its_start_was_replaced() -> None:
    grasp, rule, loads = GRASPS["cuboid, 4"], squeezing(3.0), wrenches.sample_ball(np.random.default_rng(0), 60)
    batch = optimize_forces(grasp, loads, initial=rule)
    single = [ForceOptimizer(grasp, method="newton", initial=rule).solve(load) for load in loads]
    assert batch.initial == batch[0].initial
    assert [each.initial for each in batch] == [each.initial for each in single]
    assert 5 < sum(each.start_replaced for each in batch) < 55


@pytest.mark.parametrize(
    "rule",
    [None, "linear_combination", LinearCombination(), "single_value", CoreStart("lagrange"), CoreStart("phase_one")],
)
def test_starts_that_were_asked_for_are_not_called_replaced(rule: Any) -> None:
    for wrench in (PAPER_WRENCH, np.zeros(6)):
        solution = optimize_force(GRASPS["cuboid, 4"], wrench, initial=rule)
        assert not solution.start_replaced
        assert "replaced" not in solution.initial
