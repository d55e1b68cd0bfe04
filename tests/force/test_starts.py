"""Starts, repairs and carried-over solutions: balanced and strictly inside the cones, or an error
that says why not."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from force.generators import closed
from force.named import NAMED
from oracles.newton import combine, tangent_correction
from oracles.phi import phi
from problems import GRASPS, LIGHT, PAPER_WRENCH, closure_grasps

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import (
    ForceLimits,
    ForceOptimizer,
    Objective,
    OfflineBasis,
    Repair,
    Status,
    optimize_force,
    optimize_forces,
)
from grasp_env.force.initial import LinearCombination
from grasp_env.force.repair import CORRECTIONS, carry_over, start_replaced
from grasp_env.force.rules import CoreRule, initial_rule
from grasp_env.grasp import Grasp
from grasp_env.grasp import wrench as wrenches
from grasp_env.quality import feasibility

OBJECTIVE = Objective()
CUBOID = GRASPS["cuboid, 4"]
ALL = [*GRASPS.values(), *closure_grasps(8)]
FLOOR = NAMED["pushed"].grasp
"""Three contacts that only push up: no force closure."""
SCALE = np.repeat([1.0, 0.03], 3)


def some_wrenches() -> list[np.ndarray]:
    """Random directions and the twelve axes, where starts degenerate, at every magnitude."""
    directions = wrenches.sample_magnitudes(np.random.default_rng(0), 2, 1.0, 1.0 + 1e-9)
    axes = np.concatenate([np.eye(6), -np.eye(6)]) * np.repeat([1.0, wrenches.MAGNITUDE_LENGTH], 3)
    return [size * d for size in (0.0, 1e-9, 1.0, 1e4) for d in (*directions, *axes)]


def assert_start(grasp: Grasp, wrench: np.ndarray, force: np.ndarray, part: float = 1e-10) -> None:
    """part: rounding of sums of forces of this size, far below what a flow may add."""
    assert force.shape == (grasp.n_contacts, 3)
    assert grasp.cone_margin(force) > 0.0
    size = np.abs(force).max() + np.abs(wrench[:3]).max() + np.abs(wrench[3:]).max() / grasp.length
    assert grasp.residual(force, wrench) <= part * size


@pytest.mark.parametrize(
    "name", ["linear_combination", "single_value", "linear_combination_printed", "phase_one"]
)
@pytest.mark.parametrize("k", range(len(ALL)))
def test_rules_that_always_have_a_start(k, name):
    """On symmetric grasps the internal optimum has no tangential part: loads along a normal meet
    cones at their apex."""
    grasp = ALL[k]
    rule = initial_rule(name, Objective(barrier_weight=[0.01, 1e-3, 1.0][k % 3]))
    printed = name.endswith("printed")
    if printed and k >= len(GRASPS):
        return  # the printed start exists for every wrench but zero if fingers are placed well
    for wrench in some_wrenches()[:: 3 if name == "phase_one" else 1]:
        if wrench.any() or not printed:
            assert_start(grasp, wrench, rule(grasp, wrench))
    if printed:
        with pytest.raises(InfeasibleStartError, match="zero at w = 0"):
            rule(grasp, np.zeros(6))


def test_lagrange_starts_are_stationary():
    rule = CoreRule("lagrange")
    rng = np.random.default_rng(1)
    starts = 0
    misses = 0
    for grasp in (*GRASPS.values(), *closure_grasps(12)):
        for wrench in (
            np.zeros(6),
            *wrenches.sample_ball(rng, 3),
            *wrenches.sample_magnitudes(rng, 3, 1e-2, 1e3),
        ):
            try:
                force = rule(grasp, wrench)
            except InfeasibleStartError:
                misses += 1
            else:
                starts += 1
                assert_start(grasp, wrench, force)
    assert min(starts, misses) > 10  # a miss is usual on random grasps
    # stationary: W (f - k n) = G^T nu for some (k, nu)
    force = rule(CUBOID, PAPER_WRENCH).reshape(-1)
    weights = np.tile([1.0, 10.0, 10.0], 4)
    system = np.column_stack([weights * np.tile([1.0, 0.0, 0.0], 4), CUBOID.matrix.T])
    solution = np.linalg.lstsq(system, weights * force, rcond=None)[0]
    np.testing.assert_allclose(system @ solution, weights * force, atol=1e-11)
    assert solution[0] > 0.0


def test_single_value_is_the_pseudoinverse_plus_the_least_squeeze():
    force = initial_rule("single_value")(CUBOID, PAPER_WRENCH)
    rest = OfflineBasis.of(CUBOID).rest
    particular = -(CUBOID.pseudoinverse @ PAPER_WRENCH).reshape(-1, 3)
    k = float(np.vdot(force - particular, rest) / np.vdot(rest, rest))
    np.testing.assert_allclose(force, particular + k * rest, atol=1e-12)
    assert k > 1.0  # 1.1 times the least feasible factor: at k / 1.1 the margin is zero
    assert CUBOID.cone_margin(particular + k / 1.1 * rest) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(initial_rule("single_value")(CUBOID, np.zeros(6)), rest, rtol=1e-14)


# the 12-basis, repairs and carried-over solutions


def moved(grasp: Grasp, rng: np.random.Generator, size: float) -> Grasp:
    normals = grasp.normals + size * rng.standard_normal(grasp.normals.shape)
    positions = grasp.positions + size * grasp.length * rng.standard_normal(grasp.positions.shape)
    return Grasp.from_contacts(
        positions, normals / np.linalg.norm(normals, axis=1)[:, None], grasp.friction
    )


@pytest.mark.parametrize("grasp", ALL[:7], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_the_basis_holds_optima_combines_them_and_moves(grasp):
    weights = {"force_weight": 2.0, "barrier_weight": 0.05}
    rng = np.random.default_rng(44)
    basis = OfflineBasis.of(grasp, Objective(**weights))
    assert OfflineBasis.of(grasp, Objective(**weights)) is basis is not OfflineBasis.of(grasp)
    for unit, force in zip(
        [*np.eye(6), *-np.eye(6), np.zeros(6)], [*basis.forces, basis.rest], strict=True
    ):
        best = optimize_force(grasp, unit, **weights, initial="phase_one", tolerance=1e-10)
        # gaps of 1e-10 in Phi: roots of 1e-5 in force
        np.testing.assert_allclose(force, best.force, atol=1e-4 * np.abs(force).max())
        np.testing.assert_array_equal(basis.combine(unit), force)
    for size in (0.0, 1e-9, 1.0, 100.0):
        load = size * rng.standard_normal(6)
        for printed in (False, True):
            # Eqs. 33 and 34: at most seven terms
            wanted = combine(basis.cone_forces, load, printed)
            made = grasp.to_cone(basis.combine(load, printed)).reshape(-1)
            np.testing.assert_allclose(
                made, wanted, atol=1e-15 * np.abs(basis.cone_forces).max() * (1 + 6 * size)
            )
        assert_start(grasp, load, basis.combine(load))
    for size in (1e-4, 1e-2):
        there = moved(grasp, rng, size)
        warm = basis.moved_to(there)
        cold = OfflineBasis.compute(there, basis.objective)
        assert OfflineBasis.of(there, basis.objective) is warm
        assert (
            np.abs(warm.cone_forces - cold.cone_forces).max()
            <= 1e-4 * np.abs(cold.cone_forces).max()
        )


def test_repair_is_never_worse_than_the_combination():
    rng = np.random.default_rng(31)
    repair = Repair(OBJECTIVE)
    better = 0
    for k, load in enumerate(wrenches.sample_magnitudes(rng, 500, 1e-3, 100.0)):
        grasp = ALL[k % 9]
        safe = OfflineBasis.of(grasp).combine(load)
        candidate = safe + rng.standard_normal(safe.shape) * 10.0 ** rng.uniform(-6, 9)
        if k % 6 == 0:
            candidate = safe * rng.uniform(-2.0, 2.0)
        force = repair(grasp, load, candidate)
        assert_start(grasp, load, force, 1e-9)  # what a candidate of 1e9 N leaves of its balance
        value, least = (OBJECTIVE.value(grasp.to_cone(f)) for f in (force, safe))
        # coordinates go to forces and back: one rounding, which the barrier amplifies by u / margin
        assert value <= least * (1.0 + 1e-11)
        better += value < 0.999 * least
    assert better > 80
    # an optimum stays; without a usable candidate the result is the combination
    best = optimize_force(CUBOID, PAPER_WRENCH, tolerance=1e-10).force
    np.testing.assert_allclose(repair(CUBOID, PAPER_WRENCH, best), best, rtol=1e-12, atol=1e-12)
    safe = OfflineBasis.of(CUBOID).combine(PAPER_WRENCH)
    for value in (np.nan, np.inf, 1e308):
        np.testing.assert_allclose(
            repair(CUBOID, PAPER_WRENCH, np.full((4, 3), value)), safe, rtol=1e-14
        )


@pytest.mark.parametrize("grasp", ALL[:7], ids=lambda grasp: f"N{grasp.n_contacts}")
def test_carry_over_to_another_grasp_and_wrench(grasp):
    """ "tangent" follows the optimum while its Phi is at most twice what it was; the other is never
    worse than the combination."""
    rng = np.random.default_rng(33)
    followed = 0
    load = rng.standard_normal(6) * SCALE
    previous = optimize_force(grasp, load, tolerance=1e-8).force
    for size in (0.0, 1e-3, 3e-2):
        there = moved(grasp, rng, size)
        OfflineBasis.of(grasp).moved_to(there)
        weights = OBJECTIVE.weights(grasp.n_contacts)
        rows = there.unit_frame @ there.cone_matrix
        for jump in (0.0, 1e-2, 30.0):
            target = load + jump * rng.standard_normal(6) * SCALE
            made = {
                name: carry_over(there, target, previous, OBJECTIVE, name) for name in CORRECTIONS
            }
            for force in made.values():
                assert_start(there, target, force)
            x = there.to_cone(previous).reshape(-1)
            follows = tangent_correction(x, rows, there.unit_frame @ target, weights)
            if phi(follows, weights) <= 1.99 * phi(x, weights):
                followed += 1
                near = 1e-7 * np.abs(follows).max()
                np.testing.assert_allclose(
                    there.to_cone(made["tangent"]).reshape(-1), follows, rtol=0, atol=near
                )
            safe = OBJECTIVE.value(there.to_cone(OfflineBasis.of(there).combine(target)))
            assert OBJECTIVE.value(there.to_cone(made["pseudoinverse"])) <= safe * (1.0 + 1e-14)
    assert followed >= 3


# what a solution says of its start


def squeezing(newtons: float) -> Callable[[Grasp, np.ndarray], np.ndarray]:
    """A user's rule that guesses a uniform squeeze."""

    def squeeze(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        return Repair()(grasp, wrench, np.tile([newtons, 0.0, 0.0], (grasp.n_contacts, 1)))

    return squeeze


@pytest.mark.parametrize("method", ["reduced_flow", "newton"])
@pytest.mark.parametrize(
    ("newtons", "weight"), [(1.0, 0.01), (3.0, 0.02), (10.0, 0.01), (np.nan, 0.02)]
)
def test_a_guess_of_which_nothing_is_left_is_reported(method, newtons, weight):
    """Also for a rule that repairs in another Phi than the one that is solved; never for zero
    wrench."""
    rule = squeezing(newtons)
    replaced = 0
    options = {"method": method, "initial": rule, "barrier_weight": weight}
    optimizer = ForceOptimizer(CUBOID, **options)
    loads = wrenches.sample_ball(np.random.default_rng(0), 30)
    for wrench, many in zip(loads, optimize_forces(CUBOID, loads, **options), strict=True):
        found = optimizer.solve(wrench)
        reported = found.start_replaced
        assert (
            found.initial
            == many.initial
            == ("linear_combination (squeeze was replaced)" if reported else "squeeze")
        )
        assert many.start_replaced is pickle.loads(pickle.dumps(found)).start_replaced is reported
        paper = LinearCombination()(CUBOID, wrench)
        assert reported == (np.abs(found.initial_force - paper).max() < 1e-9)
        assert start_replaced(CUBOID, wrench, found.initial_force) is reported
        replaced += reported
    least, most = {1.0: (0, 0), 3.0: (3, 27)}.get(newtons, (30, 30))
    assert least <= replaced <= most
    assert optimizer.solve(np.zeros(6)).start_replaced is False


def test_without_closure_only_phase_one_has_a_start():
    down = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])
    for name in ("linear_combination", "single_value", "lagrange"):
        for call in (initial_rule(name), partial(optimize_force, initial=name)):
            with pytest.raises(
                InfeasibleStartError, match=r"no force closure.*initial='phase_one'"
            ):
                call(FLOOR, down)
    for initial in (None, "previous"):  # no start was named, or there is no previous solution yet
        for method in ("newton", "reduced_flow"):
            solution = optimize_force(FLOOR, down, method=method, initial=initial)
            assert (solution.status.name, solution.initial) == ("OPTIMAL", "phase_one")
            # nothing can squeeze
            assert solution.total_normal_force == pytest.approx(2.0, abs=1e-9)
    assert_start(FLOOR, down, initial_rule("phase_one")(FLOOR, down))
    with pytest.raises(InfeasibleStartError, match="no force strictly inside the cones"):
        initial_rule("phase_one")(FLOOR, -down)


# whatever the start


@pytest.mark.parametrize(
    "name", ["pinch", "soft", "mixed", "hard, normals", "hard, torques", "own joints", "all"]
)
def test_any_start_ends_at_the_same_optimum(name):
    p = NAMED[name]
    optimizer = ForceOptimizer(p.grasp, **p.options("newton"))
    want = optimizer.solve(p.wrench)
    deep = feasibility(p.grasp, p.wrench, p.limits)
    near = optimize_force(p.grasp, 1.05 * p.wrench, limits=p.limits)
    starts: list[Any] = [want, near, "previous", "phase_one"]
    if not p.grasp.models.torsional_friction.any():  # arrays have no torsion
        free = optimize_force(p.grasp, p.wrench, barrier_weight=1.0).force
        starts += [
            want.initial_force,
            free,
            deep.force.tolist(),
            lambda g, w: feasibility(g, w, p.limits).force,
        ]
        for bad, why in ((1.1 * free, "misses balance"), (-free, "misses balance|leaves")):
            with pytest.raises(InfeasibleStartError, match=why):
                optimizer.solve(p.wrench, initial=bad)
    if p.grasp.n_contacts > 2:  # two soft fingers have no 12-basis of forces alone
        starts += ["linear_combination", "linear_combination_printed", "single_value", "lagrange"]
    for start in starts:
        found = optimizer.solve(p.wrench, initial=start)
        assert found.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=2e-9)
        np.testing.assert_allclose(found.force, want.force, atol=1e-3)
        assert p.grasp.cone_margin(found.initial_force) > 0.0


def test_a_rule_gets_the_contacts_of_the_call():
    """Those that touch, where they are, along the tangents of the optimizer's grasp."""
    seen: list[Grasp] = []

    def rule(grasp: Grasp, wrench: np.ndarray) -> np.ndarray:
        seen.append(grasp)
        return CoreRule("single_value")(grasp, wrench)

    five = GRASPS["cuboid, 5"]
    tangents = np.random.default_rng(7).standard_normal((5, 3))
    rough = np.linspace(0.4, 0.8, 10).reshape(5, 2)
    there = moved(five, np.random.default_rng(6), 0.01)
    there = Grasp.from_contacts(there.positions, there.normals, rough, tangents=tangents)
    optimizer = ForceOptimizer(
        Grasp.from_contacts(five.positions, five.normals, 0.4, tangents=tangents)
    )
    touching = np.array([True, False, True, True, True])
    contacts = {"positions": there.positions, "normals": there.normals, "friction": rough}
    found = optimizer.solve(LIGHT, initial=rule, **contacts, contacts=touching)
    np.testing.assert_array_equal(seen[0].positions, there.positions[touching])
    np.testing.assert_allclose(seen[0].frames, there.frames[touching], atol=1e-15)
    np.testing.assert_array_equal(seen[0].models.friction, rough[touching])
    assert (found.initial, found.force[1].any()) == ("rule", False)
    assert optimizer.solve(LIGHT, initial=rule, **contacts).initial == "rule"
    tight = ForceLimits(max_normal=0.9 * float(found.force[:, 0].max()))
    assert optimize_force(seen[0], LIGHT, limits=tight, initial=rule).status is Status.OPTIMAL
    with pytest.raises(InfeasibleStartError, match=r"misses balance by \d"):
        optimizer.solve(LIGHT, initial=lambda grasp, _: np.ones((4, 3)), contacts=touching)


LOADS = [0.3, 5.0, 50.0, 1000.0]
"""Sizes of a load [N]."""


def loaded(rng: np.random.Generator, load: float) -> Iterator[tuple[Grasp, np.ndarray]]:
    """Grasps of 3 to 8 contacts with force closure, each with a wrench of that size."""
    for count in (3, 4, 5, 6, 8) * 4:
        yield closed(rng, count), load * rng.standard_normal(6) * np.repeat([1.0, 0.03], 3)


@pytest.mark.parametrize("load", LOADS)
def test_a_given_start_is_judged_by_its_own_wrench(load):
    """`start` takes what `solve` takes: a force that misses balance by a part of 1e-11 to 5e-9 of
    the wrench."""
    rng = np.random.default_rng(5)
    for grasp, wrench in loaded(rng, load):
        force = optimize_force(grasp, wrench).force.copy()
        force[0, 0] += 10.0 ** rng.uniform(-11.0, -8.3) * np.abs(wrench[:3]).max()
        optimizer = ForceOptimizer(grasp)
        assert optimizer.solve(wrench, initial=force).initial == "given"
        np.testing.assert_allclose(
            optimizer.start(wrench, initial=force), force, rtol=1e-12, atol=1e-12 * load
        )


@pytest.mark.parametrize("load", LOADS)
def test_a_carried_start_that_stalls_is_never_replaced_by_a_worse_force(load):
    """With few steps and a gap below rounding: the objective is not above that of the optimum that
    was given."""
    for grasp, wrench in loaded(np.random.default_rng(0), load):
        known = optimize_force(grasp, wrench, tolerance=1e-9)
        found = ForceOptimizer(grasp, tolerance=1e-16, max_iterations=5).solve(
            wrench, initial=known.force
        )
        assert found.objective <= known.objective * (1.0 + 1e-12)
