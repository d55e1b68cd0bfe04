"""method="conic" at any tolerance and at the edge of what is feasible: certified, or honest."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference
from force.generators import random_grasp, random_wrench
from force.named import NAMED
from problems import CONIC_LEAST, GRASPS, PAPER_WRENCH, closure_grasps

from grasp_env.errors import InfeasibleWrenchError, NotConvergedError, RankDeficientGraspError
from grasp_env.force import ForceOptimizer, ForceSolution, Status, optimize_force, optimize_forces
from grasp_env.grasp import Grasp

CUBOID = GRASPS["cuboid, 4"]
CRADLE = NAMED["cradle"].grasp
SMOOTH = NAMED["frictionless"].grasp


def conic(grasp: Grasp, wrench: np.ndarray, **options) -> ForceSolution:
    return optimize_force(grasp, wrench, method="conic", **options)


def certified(grasp: Grasp, wrench: np.ndarray, found: ForceSolution, criterion: str = "sum", gap: float = 1e-6):
    """Recomputes what a solution claims, OPTIMAL or not, from the geometry alone; returns (objective, bound)."""
    wrench, reference = np.asarray(wrench, dtype=float), Reference(grasp)
    size = float(np.abs(reference.load(wrench)).max())
    reach = max(size, float(np.abs(found.force).max()))
    objective = float(found.force[:, 0].sum() if criterion == "sum" else found.force[:, 0].max())
    assert found.objective == pytest.approx(objective, rel=1e-12)
    assert reference.residual(found.force, found.torsion, wrench) <= 1e-9 * size + 1e-14 * reach
    assert reference.violation(found.force, found.torsion) <= 1e-14 * reach
    assert found.cone_margin >= 0.0
    bound, theta = reference.dual_bound(found.multipliers, np.empty(0), wrench, criterion)
    assert theta > 1.0 - 1e-9
    assert found.lower_bound <= bound * (1.0 + 1e-9)
    if found.status is Status.OPTIMAL:
        assert objective - bound <= 1.01 * gap * objective
    return objective, bound


def test_the_notes_number() -> None:
    assert conic(CUBOID, PAPER_WRENCH).objective == pytest.approx(CONIC_LEAST, abs=1e-5)


@pytest.mark.parametrize("tolerance", [1.0, 1e-2, 1e-6, 1e-9, 1e-12, 1e-16])
@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_optimal_means_certified_at_any_tolerance(tolerance: float, criterion: str) -> None:
    for grasp in closure_grasps()[:8]:
        found = conic(grasp, PAPER_WRENCH, criterion=criterion, tolerance=tolerance)
        certified(grasp, PAPER_WRENCH, found, criterion, max(tolerance, 1e-14) if tolerance < 1.0 else np.inf)


@pytest.mark.parametrize("iterations", [0, 1, 2, 3])
def test_stopped_early_it_is_a_valid_grasp_that_says_so(iterations: int) -> None:
    found = conic(CUBOID, PAPER_WRENCH, max_iterations=iterations)
    assert (found.status, found.iterations) == (Status.ITERATION_LIMIT, iterations)
    objective, bound = certified(CUBOID, PAPER_WRENCH, found)
    assert bound <= CONIC_LEAST <= objective


@pytest.mark.parametrize("size", [1e-300, 1e-310, 5e-324])
def test_subnormal_wrenches_give_numbers_or_an_honest_status(size: float) -> None:
    found = conic(CUBOID, size * np.eye(6)[0])
    assert found.status is not Status.OPTIMAL or np.isfinite(found.force).all()


def test_conic_ends_whatever_the_tolerance() -> None:
    """Rounding makes the gap negative once in ten thousand wrenches; the loop must not wait for it to shrink."""
    loads = np.random.default_rng(4).standard_normal((20_000, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    for tolerance in (1e-12, 1e-15):
        batch = optimize_forces(CUBOID, loads, method="conic", tolerance=tolerance)
        assert set(np.unique(batch.codes)) <= {0, 1, 2}
        assert (batch.cone_margin >= 0.0).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("distance", [1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 0.0])
def test_on_the_edge_of_feasibility_right_or_honest(distance: float, side: float) -> None:
    """The pull along x grows until the cradle gives way; the edge by bisection on Clarabel's margin."""
    pytest.importorskip("clarabel")
    reference = Reference(CRADLE)

    def load(pull: float) -> np.ndarray:
        return np.array([pull, 0.1 * pull, -2.0, 0.0, 0.0, 0.0])

    inside, outside = 0.0, 50.0
    for _ in range(45):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if reference.margin(load(middle)) > 0.0 else (inside, middle)
    wrench = load(inside * (1.0 + side * distance))
    margin = reference.margin(wrench)
    try:
        found = conic(CRADLE, wrench)
    except InfeasibleWrenchError:
        assert margin < 1e-7
        return
    except NotConvergedError:
        assert abs(margin) < 1e-7
        return
    assert margin > -1e-7
    certified(CRADLE, wrench, found)


def coplanar(lift: float) -> Grasp:
    """Five contacts on a circle, all but `lift` of its radius in one plane, pushing inwards."""
    angles = 2.0 * np.pi * np.arange(5) / 5
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(5)])
    return Grasp.from_contacts(0.05 * (around + np.outer(lift * (-1.0) ** np.arange(5), [0, 0, 1])), -around, 0.6)


def collinear(spread: float) -> Grasp:
    """Four contacts close to one line: moments about it take forces of 1 / spread."""
    positions = 0.05 * np.array([[-1.0, spread, 0.0], [1.0, -spread, 0.0], [0.3, 0.0, spread], [-0.4, 0.0, -spread]])
    return Grasp.from_contacts(positions, [[1.0, 0, 0], [-1.0, 0, 0], [0, 0, -1.0], [0, 0, 1.0]], 0.8)


@pytest.mark.parametrize("criterion", ["sum", "max"])
@pytest.mark.parametrize("make", [coplanar, collinear])
@pytest.mark.parametrize("size", [1e-1, 1e-3, 1e-5, 1e-6, 1e-7])
def test_nearly_degenerate_contacts_right_or_honest(make, size: float, criterion: str) -> None:
    try:
        grasp = make(size)
    except RankDeficientGraspError:
        assert size < 1e-5
        return
    for load in (PAPER_WRENCH, [0, 0, 1.0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0], [0, 0, 0, 0.01, 0, 0]):
        try:
            found = conic(grasp, load, criterion=criterion)
        except (InfeasibleWrenchError, NotConvergedError):
            assert make is collinear or not Reference(grasp).margin(np.array(load)) > 1e-7
            continue
        if found.status is Status.OPTIMAL:
            certified(grasp, load, found, criterion)


@pytest.mark.parametrize("friction", [1e-4, 1e-2, 10.0, 1e4])
def test_extreme_friction_right_or_honest(friction: float) -> None:
    grasp = Grasp.from_contacts(SMOOTH.positions, SMOOTH.normals, friction)
    found = conic(grasp, PAPER_WRENCH)
    if found.status is Status.OPTIMAL:
        certified(grasp, PAPER_WRENCH, found)


@pytest.mark.parametrize("seed", [9, 11, 12])
def test_the_least_maximum_is_found_where_many_normals_are_equal(seed: int) -> None:
    """Cases that once stalled."""
    rng = np.random.default_rng(seed)
    for _ in range(60):
        grasp = random_grasp(rng, "hard", most=9)
        load = random_wrench(rng, grasp)
        try:
            found = conic(grasp, load, criterion="max").raise_for_status()
        except InfeasibleWrenchError:
            continue
        # each dominates the other: sum / N <= max <= sum
        least = conic(grasp, load).objective
        assert least / grasp.n_contacts * (1.0 - 2e-6) <= found.objective <= least * (1.0 + 2e-6)


LOAD = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.0078125]).astype(np.float32).astype(float)


@pytest.mark.parametrize("method", ["conic", "newton"])
@pytest.mark.parametrize("form", ["list", "tuple", "read-only", "strided", "reversed", "float32", "fortran"])
def test_any_form_of_the_wrench_gives_the_same_numbers(method: str, form: str) -> None:
    frozen = LOAD.copy()
    frozen.flags.writeable = False
    given = {
        "list": LOAD.tolist(), "tuple": tuple(LOAD.tolist()), "read-only": frozen, "strided": np.repeat(LOAD, 2)[::2],
        "reversed": LOAD[::-1].copy()[::-1], "float32": LOAD.astype(np.float32),
        "fortran": np.asfortranarray(np.tile(LOAD, (3, 1)))[1],
    }[form]  # fmt: skip
    want, got = (ForceOptimizer(CUBOID, method=method).solve(each) for each in (LOAD, given))
    np.testing.assert_array_equal(got._record, want._record)
