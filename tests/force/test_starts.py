"""Every start is balanced and strictly inside the cones, or says why there is none; and whatever the start, the optimum is the same."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from force.named import NAMED
from oracles.newton import combine
from problems import GRASPS, LIGHT, PAPER_WRENCH, closure_grasps
from scipy.optimize import minimize_scalar

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    LinearCombination,
    Objective,
    OfflineBasis,
    Repair,
    Status,
    initial_rule,
    optimize_force,
    optimize_forces,
    start_replaced,
)
from grasp_env.force.rules import CoreStart
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches
from grasp_env.quality import feasibility

OBJECTIVE = Objective()
CUBOID = GRASPS["cuboid, 4"]
ALL = [*GRASPS.values(), *closure_grasps(15)]
FLOOR = NAMED["pushed"].grasp
"""Three contacts that only push up: no force closure."""


def some_wrenches() -> list[np.ndarray]:
    """Random directions and the twelve axes, where starts degenerate, at every magnitude."""
    directions = wrenches.sample_magnitudes(np.random.default_rng(0), 4, 1.0, 1.0 + 1e-9)
    axes = np.concatenate([np.eye(6), -np.eye(6)]) * np.repeat([1.0, wrenches.MAGNITUDE_LENGTH], 3)
    return [size * d for size in (0.0, 1e-9, 1e-3, 1.0, 1e4) for d in (*directions, *axes)]


def assert_start(grasp: Grasp, wrench: np.ndarray, force: np.ndarray, part: float = 1e-10) -> None:
    """part: rounding of sums of forces of this size, far below what a flow may add."""
    assert force.shape == (grasp.n_contacts, 3)
    assert np.isfinite(force).all()
    assert grasp.cone_margin(force) > 0.0
    size = np.abs(force).max() + np.abs(wrench[:3]).max() + np.abs(wrench[3:]).max() / grasp.length
    assert grasp.residual(force, wrench) <= part * size


@pytest.mark.parametrize("barrier", [0.01, 1e-3, 1.0])
@pytest.mark.parametrize("name", ["linear_combination", "single_value", "linear_combination_printed", "phase_one"])
@pytest.mark.parametrize("k", range(len(ALL)))
def test_rules_that_always_have_a_start(k: int, name: str, barrier: float) -> None:
    """On symmetric grasps the rest force has no tangential part: loads along a normal meet cones at their apex."""
    if k >= len(GRASPS) and (barrier != 0.01 or name.endswith("printed")):
        return  # the printed one has a start for every wrench but none, where fingers are placed well
    grasp, rule = ALL[k], initial_rule(name, None if barrier == 0.01 else Objective(barrier_weight=barrier))
    for wrench in some_wrenches()[:: 3 if name == "phase_one" else 1]:
        if wrench.any() or not name.endswith("printed"):
            assert_start(grasp, wrench, rule(grasp, wrench))
    if name.endswith("printed"):
        with pytest.raises(InfeasibleStartError, match="zero at w = 0"):
            rule(grasp, np.zeros(6))


def best_lagrange_margin(grasp: Grasp, wrench: np.ndarray) -> float:
    """Largest cone margin over k >= 0 of argmin (f - k n)^T W (f - k n), G f = -w, by the KKT system of each k."""
    weights, normals = np.tile([1.0, 10.0, 10.0], grasp.n_contacts), np.tile([1.0, 0.0, 0.0], grasp.n_contacts)
    kkt = np.block([[np.diag(weights), grasp.matrix.T], [grasp.matrix, np.zeros((6, 6))]])

    def force(k: float) -> np.ndarray:
        return np.linalg.solve(kkt, np.concatenate([weights * k * normals, -wrench]))[: len(weights)].reshape(-1, 3)

    at_zero, slope = force(0.0), force(1.0) - force(0.0)

    def loss(k: float) -> float:  # convex in k: minus a minimum of concave margins
        return -grasp.cone_margin(at_zero + k * slope)

    far = 1e4 * (1.0 + np.abs(at_zero).max())
    return -min(minimize_scalar(loss, bounds=(0.0, part * far), method="bounded").fun for part in (1.0, 0.01, 1e-4))


def test_lagrange_has_a_start_or_none_exists() -> None:
    rule, rng = CoreStart("lagrange"), np.random.default_rng(1)
    starts = misses = 0
    for grasp in (*GRASPS.values(), *closure_grasps(40)):
        for wrench in (np.zeros(6), *wrenches.sample_ball(rng, 5), *wrenches.sample_magnitudes(rng, 5, 1e-2, 1e3)):
            try:
                force = rule(grasp, wrench)
            except InfeasibleStartError:
                misses += 1
                # the scan's own accuracy, relative to the forces it cancels
                assert best_lagrange_margin(grasp, wrench) <= 1e-6 * (1e-3 + np.abs(wrench).max())
            else:
                starts += 1
                assert_start(grasp, wrench, force)
    # both happen: a miss is usual on random grasps
    assert starts > 100
    assert misses > 20


def test_lagrange_minimises_what_it_says() -> None:
    """Some k makes the start the KKT point of that k: stationarity is linear, so k is found by least squares."""
    force, weights = CoreStart("lagrange")(CUBOID, PAPER_WRENCH).reshape(-1), np.tile([1.0, 10.0, 10.0], 4)
    # W (f - k n) = G^T nu for some (k, nu)
    system = np.column_stack([weights * np.tile([1.0, 0.0, 0.0], 4), CUBOID.matrix.T])
    solution = np.linalg.lstsq(system, weights * force)[0]
    np.testing.assert_allclose(system @ solution, weights * force, atol=1e-11)
    assert solution[0] > 0.0


def test_single_value_is_the_pseudoinverse_plus_the_least_squeeze() -> None:
    force, rest = initial_rule("single_value")(CUBOID, PAPER_WRENCH), OfflineBasis.of(CUBOID).rest
    particular = -(CUBOID.pseudoinverse @ PAPER_WRENCH).reshape(-1, 3)
    k = float(np.vdot(force - particular, rest) / np.vdot(rest, rest))
    np.testing.assert_allclose(force, particular + k * rest, atol=1e-12)
    # 1.1 times the least feasible factor: at k / 1.1 the margin is zero
    assert k > 1.0
    assert CUBOID.cone_margin(particular + k / 1.1 * rest) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(initial_rule("single_value")(CUBOID, np.zeros(6)), rest, rtol=1e-14)


# the offline basis


def moved(grasp: Grasp, rng: np.random.Generator, size: float) -> Grasp:
    """Contacts and normals a little on."""
    normals = grasp.normals + size * rng.standard_normal(grasp.normals.shape)
    positions = grasp.positions + size * grasp.length * rng.standard_normal(grasp.positions.shape)
    return Grasp.from_contacts(positions, normals / np.linalg.norm(normals, axis=1)[:, None], grasp.friction)


@pytest.mark.parametrize("grasp", ALL[:9], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_the_basis_holds_optima_and_combines_them(grasp: Grasp) -> None:
    objective, rng = Objective(2.0, 0.05), np.random.default_rng(44)
    basis = OfflineBasis.compute(grasp, objective)
    units = [*np.eye(6), *-np.eye(6), np.zeros(6)]
    for unit, force in zip(units, [*basis.forces, basis.rest], strict=True):
        options = {"force_weight": 2.0, "barrier_weight": 0.05, "initial": "phase_one", "tolerance": 1e-10}
        best = optimize_force(grasp, unit, **options)
        # gaps of 1e-10 in Phi: roots of 1e-5 in force
        np.testing.assert_allclose(force, best.force, atol=1e-4 * np.abs(force).max())
        np.testing.assert_array_equal(basis.combine(unit), force)
    for size in (0.0, 1e-9, 0.1, 1.0, 100.0):
        load = size * rng.standard_normal(6)
        for printed in (False, True):
            wanted = combine(basis.cone_forces, load, printed)  # Eqs. 33 and 34
            made = grasp.to_cone(basis.combine(load, printed)).reshape(-1)
            # sums of at most seven terms
            np.testing.assert_allclose(made, wanted, atol=1e-15 * np.abs(basis.cone_forces).max() * (1 + 6 * size))
        assert_start(grasp, load, basis.combine(load))


@pytest.mark.parametrize("grasp", ALL[:9], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_a_moved_basis_is_that_of_the_new_grasp_and_remembered(grasp: Grasp) -> None:
    basis = OfflineBasis.of(grasp)
    assert OfflineBasis.of(grasp, Objective()) is basis
    assert OfflineBasis.of(grasp, Objective(1.0, 0.1)) is not basis
    for size in (1e-4, 1e-2):
        there = moved(grasp, np.random.default_rng(45), size)
        warm, cold = basis.moved_to(there), OfflineBasis.compute(there)
        assert OfflineBasis.of(there) is warm
        for one, other in zip(warm.cone_forces, cold.cone_forces, strict=True):
            # both within 1e-10 of the optimum, and the root of it in force
            assert OBJECTIVE.value(one) == pytest.approx(OBJECTIVE.value(other), rel=1e-9)
            assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max()


def test_rules_take_the_objective_they_are_given() -> None:
    for name in ("linear_combination", "linear_combination_printed", "single_value", "lagrange"):
        rules = [initial_rule(name, Objective(1.0, barrier)) for barrier in (1e-4, 10.0)]
        cheap, dear = (rule(CUBOID, PAPER_WRENCH)[:, 0].sum() for rule in rules)
        assert cheap < dear


def test_without_closure_there_is_no_basis_but_phase_one() -> None:
    down = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])
    for name in ("linear_combination", "single_value", "lagrange"):
        for call in (initial_rule(name), partial(optimize_force, initial=name)):
            with pytest.raises(InfeasibleStartError, match=r"no force closure.*initial='phase_one'"):
                call(FLOOR, down)
    for initial in (None, "previous"):  # no start was named, or there is none yet
        for method in ("newton", "reduced_flow"):
            solution = optimize_force(FLOOR, down, method=method, initial=initial)
            assert (solution.status.name, solution.initial) == ("OPTIMAL", "phase_one")
            # nothing can squeeze: three fingers share 2 N
            assert solution.total_normal_force == pytest.approx(2.0, abs=1e-9)
    assert_start(FLOOR, down, initial_rule("phase_one")(FLOOR, down))
    with pytest.raises(InfeasibleStartError, match="no force strictly inside the cones"):
        initial_rule("phase_one")(FLOOR, -down)


# what a solution says of its start


def squeezing(newtons: float) -> Callable[[Grasp, np.ndarray], np.ndarray]:
    """A rule of somebody who guesses so much force along every normal."""

    def squeeze(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        return Repair()(grasp, wrench, np.tile([newtons, 0.0, 0.0], (grasp.n_contacts, 1)))

    return squeeze


@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
@pytest.mark.parametrize("newtons", [1.0, 3.0, 10.0, np.nan])
@pytest.mark.parametrize("weight", [0.01, 0.02])
def test_a_guess_of_which_nothing_is_left_is_told(method: str, newtons: float, weight: float) -> None:
    """Also by a rule that repairs in another Phi than the one that is solved; without a wrench there is nothing to replace."""
    rule, replaced = squeezing(newtons), 0
    options = {"method": method, "initial": rule, "barrier_weight": weight}
    optimizer = ForceOptimizer(CUBOID, **options)
    loads = wrenches.sample_ball(np.random.default_rng(0), 10 if newtons != 3.0 else 60)
    for wrench, many in zip(loads, optimize_forces(CUBOID, loads, **options), strict=True):
        found = optimizer.solve(wrench)
        told = found.start_replaced
        assert found.initial == many.initial == ("linear_combination (squeeze was replaced)" if told else "squeeze")
        assert many.start_replaced is pickle.loads(pickle.dumps(found)).start_replaced is told
        paper = LinearCombination()(CUBOID, wrench)
        assert told == (np.abs(found.initial_force - paper).max() < 1e-9)
        assert start_replaced(CUBOID, wrench, found.initial_force) is told
        replaced += told
    least, most = {1.0: (0, 0), 3.0: (6, 54)}.get(newtons, (10, 10))  # of 3 N something is left now and then
    assert least <= replaced <= most
    assert optimizer.solve(np.zeros(6)).start_replaced is False


@pytest.mark.parametrize("rule", [None, LinearCombination(), "linear_combination", "single_value", "lagrange", "phase_one"])  # fmt: skip
def test_starts_that_were_asked_for_are_those_of_solve_and_not_called_replaced(rule: Any) -> None:
    optimizer = ForceOptimizer(CUBOID)
    for wrench in (PAPER_WRENCH, LIGHT, np.zeros(6)):
        solution = optimizer.solve(wrench, initial=rule)
        assert not solution.start_replaced
        assert "replaced" not in solution.initial
        np.testing.assert_allclose(solution.initial_force, optimizer.start(wrench, initial=rule), rtol=3e-16)


# whatever the start


@pytest.mark.parametrize("name", ["pinch", "soft", "mixed", "hard, normals", "hard, torques", "own joints", "all"])
def test_any_start_ends_at_the_same_optimum(name: str) -> None:
    p = NAMED[name]
    optimizer = ForceOptimizer(p.grasp, **p.options("newton"))
    want, deep = optimizer.solve(p.wrench), feasibility(p.grasp, p.wrench, p.limits)
    near = optimize_force(p.grasp, 1.05 * p.wrench, limits=p.limits)
    starts: list[Any] = [want, near, "previous", "phase_one"]
    if p.grasp.residual(want.initial_force, p.wrench) < 1e-9:  # arrays have no torsion
        starts.append(want.initial_force)
    if not p.grasp.models.torsional_friction.any():
        starts += [deep.force, deep.force.tolist(), lambda g, w: feasibility(g, w, p.limits).force]
    if p.grasp.n_contacts > 2:  # two soft fingers have no 12-basis of forces alone
        starts += ["linear_combination", "linear_combination_printed", "single_value", "lagrange"]
    for start in starts:
        found = optimizer.solve(p.wrench, initial=start)
        assert found.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=2e-9)
        np.testing.assert_allclose(found.force, want.force, atol=1e-3)
        assert p.grasp.cone_margin(found.initial_force) > 0.0


@pytest.mark.parametrize("name", ["soft", "hard, torques", "hard, largest normal", "own joints"])
def test_a_given_force_has_to_be_balanced_and_inside(name: str) -> None:
    """Also where the general program solves: soft contacts, joints that fingers share. Limits it may exceed."""
    p = NAMED[name]
    optimizer = ForceOptimizer(p.grasp, limits=p.limits, tolerance=1e-8)
    good = feasibility(CUBOID, p.wrench).force
    assert good is not None
    for start in (good, 3.0 * good - 2.0 * optimizer.solve(p.wrench).force if name == "own joints" else good):
        found = optimizer.solve(p.wrench, initial=start)
        assert found.initial in ("given", "phase_one (given was replaced)")
        assert found.objective == pytest.approx(p.known["newton"]["objective"], rel=2e-8)
    for bad, why in (
        (1.1 * good, "misses balance"), (-good, "misses balance|leaves the friction cones"), (0.0 * good, "misses balance"),
        (good[:3], "must have shape"), (np.nan * good, "must be finite"), (lambda grasp, wrench: None, "returned None"),
    ):  # fmt: skip
        with pytest.raises(InfeasibleStartError, match=why):
            optimizer.solve(p.wrench, initial=bad)


def test_starts_that_break_a_limit_are_starts() -> None:
    free = optimize_force(CUBOID, LIGHT, barrier_weight=1.0)
    tight = ForceLimits(max_normal=0.9 * float(free.force[:, 0].max()))
    want = optimize_force(CUBOID, LIGHT, limits=tight, tolerance=1e-8)
    for start in (free.force, free):
        found = optimize_force(CUBOID, LIGHT, limits=tight, tolerance=1e-8, initial=start)
        assert found.objective == pytest.approx(want.objective, rel=1e-7)
        assert (found.force[:, 0] < tight.max_normal).all()
