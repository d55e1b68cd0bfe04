"""Newton within the limits of fingers with joints of their own: its solver against the general program, paths, stops, proofs, batches."""

from __future__ import annotations

import numpy as np
import pytest
from force.generators import closed, finger_limits, own_joints, random_limits, random_wrench, some_grasp
from force.named import NAMED, attempt

from grasp_env.errors import InfeasibleWrenchError
from grasp_env.force import ForceLimits, ForceOptimizer, Status, optimize_force, optimize_forces
from grasp_env.grasp import presets
from grasp_env.quality import feasibility

CUBOID = presets.paper_cuboid()
LOAD = np.array([1.0, 0.5, -0.6, -0.1, 0.2, 0.0])


def loads(rng: np.random.Generator, number: int) -> np.ndarray:
    return rng.standard_normal((number, 6)) * [1.0, 1.0, 1.0, 0.03, 0.03, 0.03]


@pytest.mark.parametrize("seed", range(4))
def test_the_general_program_agrees(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    grasp, limits = closed(rng, 4), finger_limits(rng, 4, 2.5)
    optimizer = ForceOptimizer(grasp, limits=limits, tolerance=1e-10)
    optimal = 0
    for load in loads(rng, 10):
        found = attempt(lambda load=load: optimizer.solve(load))
        if found.status is Status.INFEASIBLE:
            assert not feasibility(grasp, load, limits).feasible
            continue
        optimal += 1
        want = optimizer.solve(load, trace=True)  # what studies ask goes to the general program
        assert (np.diff(want.objective_trace) <= 0.0).all()
        assert found.status is want.status is Status.OPTIMAL
        assert found.objective == pytest.approx(want.objective, rel=2e-10)
        assert optimizer.solve(load, optimum=want.objective).optimality_gap <= 1e-9
        # prices are lambda / slack^2, known to the root of the gap
        for one, other in ((found.multipliers, want.multipliers), (found.limit_multipliers, want.limit_multipliers)):
            np.testing.assert_allclose(one, other, atol=1e-3 * np.abs(other).max())
    assert optimal > 2


def test_a_path_follows_the_previous_optimum() -> None:
    limits = ForceLimits(jacobian=own_joints(np.random.default_rng(5), 4), torque_limit=0.25)
    cold, warm = (ForceOptimizer(CUBOID, limits=limits, initial=start) for start in (None, "previous"))
    steps = []
    for part in np.linspace(0.0, 1.0, 50):
        want, found = (each.solve((0.5 - part) * LOAD) for each in (cold, warm))
        assert found.status is Status.OPTIMAL
        # both certified to 1e-4
        assert found.objective == pytest.approx(want.objective, rel=1e-4)
        steps.append(found.iterations)
    assert warm.previous is not None
    assert warm.previous.initial == "previous"
    assert np.median(steps[1:]) <= 2


@pytest.mark.parametrize("method", ["newton", "conic"])
def test_batches_hold_optima_proofs_and_excesses(method: str) -> None:
    rng = np.random.default_rng(10)
    options = {"limits": ForceLimits(jacobian=own_joints(rng, 4), torque_limit=0.15), "method": method}
    many = loads(rng, 30)
    single = ForceOptimizer(CUBOID, **options, elastic=True)
    relaxed, plain = (optimize_forces(CUBOID, many, **options, elastic=elastic) for elastic in (True, False))
    assert set(relaxed.counts()) == {Status.OPTIMAL, Status.LIMITS_EXCEEDED}
    assert set(plain.counts()) == {Status.OPTIMAL, Status.INFEASIBLE}
    for k, load in enumerate(many):
        want = single.solve(load)
        np.testing.assert_array_equal(relaxed[k].force, want.force)
        assert relaxed[k].limit_excess == want.limit_excess
        proven = plain[k].status is Status.INFEASIBLE
        assert proven == (want.status is Status.LIMITS_EXCEEDED) == (plain[k].certificate is not None)
        if not proven:
            np.testing.assert_array_equal(plain[k].force, want.force)


@pytest.mark.parametrize("elastic", [False, True])
def test_what_the_cones_cannot_balance_stays_an_error(elastic: bool) -> None:
    p = NAMED["pulled"]
    with pytest.raises(InfeasibleWrenchError):
        optimize_force(p.grasp, p.wrench, limits=ForceLimits(max_normal=5.0), elastic=elastic)


@pytest.mark.parametrize("size", [1e-5, 1e-3, 1e3])
def test_limits_of_the_wrench_own_size(size: float) -> None:
    """lambda in units of the wrench: the same problem at every scale, so the same answer; also far from these units."""
    p = NAMED["hard, torques"]
    jac = np.asarray(p.limits.jacobian)
    plain, limits = (ForceLimits(max_normal=5.0 * k, jacobian=jac, torque_limit=k) for k in (1.0, size))
    one = optimize_force(p.grasp, p.wrench, limits=plain)
    same = optimize_force(p.grasp, size * p.wrench, barrier_weight=0.01 * size**2, limits=limits).raise_for_status()
    np.testing.assert_allclose(same.force, size * one.force, rtol=0, atol=1e-6 * size)
    for lam in (1e-4, 1.0):
        found = optimize_force(p.grasp, size * p.wrench, limits=limits, barrier_weight=lam).raise_for_status()
        assert limits.violations(p.grasp, found.force, tolerance=0.0) == []


@pytest.mark.parametrize("ratio", [1e-9, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_limits_far_from_the_wrench_in_size(ratio: float, criterion: str) -> None:
    """A load that is nothing to the least normal forces, and a limit that is nothing to the load."""
    limits = ForceLimits(min_normal=1.0, max_normal=100.0 * max(1.0, ratio))
    found = optimize_force(CUBOID, ratio * LOAD, method="conic", criterion=criterion, limits=limits).raise_for_status()
    assert limits.violations(CUBOID, found.force, tolerance=0.0) == []
    assert CUBOID.residual(found.force, ratio * LOAD) <= 1e-9 * ratio + 1e-14 * np.abs(found.force).max()


@pytest.mark.parametrize("kind", ["soft", "mixed", "limits"])
def test_newton_under_heavy_wrenches_ends_soon(kind: str) -> None:
    """Wrenches of 100 to 10000 N with lambda of 1e-4 to 1: most take twenty steps; no bound lies above an objective."""
    rng = np.random.default_rng(42)
    for _ in range(40):
        grasp = some_grasp(rng, "hard" if kind == "limits" else kind, most=12)
        load, lam = random_wrench(rng, grasp, 100.0, 1e4), 10.0 ** rng.uniform(-4.0, 0.0)
        limits = random_limits(rng, grasp, float(np.abs(load[:3]).max())) if kind == "limits" else None
        options = {"limits": limits, "barrier_weight": lam}
        try:
            rough, fine = (optimize_force(grasp, load, tolerance=each, **options) for each in (1e-4, 1e-8))
        except InfeasibleWrenchError:
            continue
        for found in (rough, fine):
            assert found.raise_for_status().iterations < 500
            assert found.lower_bound <= min(rough.objective, fine.objective) * (1.0 + 1e-10)
            assert found.cone_margin > 0.0
