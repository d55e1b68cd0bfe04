"""method="conic" near the loss of force closure, at extreme friction and with many contacts: right, or honest."""

from __future__ import annotations

import numpy as np
import pytest
from force.clarabel_reference import Reference, random_grasp, random_wrench
from force.test_conic import LOAD, certified, conic, frictionless_box
from problems import PAPER_WRENCH

from grasp_env.errors import (
    InfeasibleWrenchError,
    NotConvergedError,
    RankDeficientGraspError,
)
from grasp_env.force import Status
from grasp_env.grasp import Grasp


def coplanar(lift: float, count: int = 5) -> Grasp:
    """Contacts on a circle, all but `lift` of its radius in one plane, pushing inwards."""
    angles = 2.0 * np.pi * np.arange(count) / count
    up = lift * (-1.0) ** np.arange(count)
    positions = 0.05 * np.column_stack([np.cos(angles), np.sin(angles), up])
    normals = np.column_stack([-np.cos(angles), -np.sin(angles), np.zeros(count)])
    return Grasp.from_contacts(positions, normals, 0.6)


def cradle(friction: float = 0.3) -> Grasp:
    """Three contacts below the object, pushing up and inwards: holds weight, cannot be lifted."""
    angles = 2.0 * np.pi * np.arange(3) / 3.0 + 0.1
    outward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    normals = -0.4 * outward + [0.0, 0.0, np.sqrt(1.0 - 0.16)]
    return Grasp.from_contacts(0.05 * outward - [0.0, 0.0, 0.02], normals, friction)


WEIGHT = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_a_cradle_holds_weight_and_proves_that_it_cannot_pull(criterion: str) -> None:
    pytest.importorskip("clarabel")
    grasp = cradle()
    found = conic(grasp, WEIGHT, criterion=criterion)
    assert found.status is Status.OPTIMAL
    certified(grasp, WEIGHT, found, criterion)
    assert found.objective == pytest.approx(Reference(grasp).solve(WEIGHT, criterion).objective, rel=1e-6)
    with pytest.raises(InfeasibleWrenchError) as caught:
        conic(grasp, -WEIGHT, criterion=criterion)
    solution = caught.value.solution
    assert solution is not None
    assert solution.status is Status.INFEASIBLE
    assert Reference(grasp).separates(solution.certificate, -WEIGHT) > 1e-6


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("distance", [1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 0.0])
def test_on_the_edge_of_feasibility_right_or_honest(distance: float, side: float) -> None:
    """The pull along x grows until the cradle gives way; the edge by bisection on Clarabel's margin."""
    pytest.importorskip("clarabel")
    grasp, reference = cradle(), Reference(cradle())

    def load(pull: float) -> np.ndarray:
        return np.array([pull, 0.1 * pull, -2.0, 0.0, 0.0, 0.0])

    inside, outside = 0.0, 50.0
    for _ in range(45):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if reference.margin(load(middle)) > 0.0 else (inside, middle)
    pull = inside * (1.0 + side * distance)
    margin = reference.margin(load(pull))
    try:
        found = conic(grasp, load(pull))
    except InfeasibleWrenchError:
        assert margin < 1e-7
        return
    except NotConvergedError:
        assert abs(margin) < 1e-7
        return
    assert margin > -1e-7
    if found.status is Status.OPTIMAL:
        objective, bound = certified(grasp, load(pull), found)
        assert objective - bound <= 1.01e-6 * objective


@pytest.mark.parametrize("lift", [1e-1, 1e-3, 1e-5, 1e-6, 1e-7])
@pytest.mark.parametrize("criterion", ["sum", "max"])
def test_nearly_coplanar_contacts_right_or_honest(lift: float, criterion: str) -> None:
    grasp = coplanar(lift)
    for load in (PAPER_WRENCH, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])):
        try:
            found = conic(grasp, load, criterion=criterion)
        except (InfeasibleWrenchError, NotConvergedError):
            assert not Reference(grasp).margin(load) > 1e-7
            continue
        if found.status is Status.OPTIMAL:
            objective, bound = certified(grasp, load, found, criterion)
            assert objective - bound <= 1.01e-6 * objective


@pytest.mark.parametrize("spread", [1e-2, 1e-4, 1e-6, 1e-7])
def test_nearly_collinear_contacts_right_or_honest(spread: float) -> None:
    """Four contacts close to one line: moments about it take forces of 1 / spread."""
    positions = 0.05 * np.array([[-1.0, spread, 0.0], [1.0, -spread, 0.0], [0.3, 0.0, spread], [-0.4, 0.0, -spread]])
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    try:
        grasp = Grasp.from_contacts(positions, normals, 0.8)
    except RankDeficientGraspError:
        assert spread < 1e-6
        return
    for load in ([0.1, 0.0, 0.2, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.01, 0.0, 0.0]):
        try:
            found = conic(grasp, load)
        except (InfeasibleWrenchError, NotConvergedError):
            continue
        if found.status is Status.OPTIMAL:
            objective, bound = certified(grasp, load, found)
            assert objective - bound <= 1.01e-6 * objective


def test_extreme_friction_right_or_honest() -> None:
    for friction in (1e-4, 1e-2, 10.0, 1e4):
        base = frictionless_box()
        grasp = Grasp.from_contacts(base.positions, base.normals, friction)
        found = conic(grasp, LOAD)
        if found.status is Status.OPTIMAL:
            objective, bound = certified(grasp, LOAD, found)
            assert objective - bound <= 1.01e-6 * objective


@pytest.mark.parametrize("count", [3, 4, 5, 8, 17, 50, 100])
def test_any_number_of_contacts(count: int) -> None:
    rng = np.random.default_rng(count)
    grasp = None
    while grasp is None or grasp.n_contacts != count:
        grasp = random_grasp(rng, "hard", most=max(count, 3)) if count <= 20 else presets_of(rng, count)
    load = random_wrench(rng, grasp, 0.1, 10.0)
    try:
        found = conic(grasp, load)
    except InfeasibleWrenchError:
        pytest.importorskip("clarabel")
        assert Reference(grasp).margin(load) < 1e-7
        return
    assert found.status is Status.OPTIMAL
    certified(grasp, load, found)


def presets_of(rng: np.random.Generator, count: int) -> Grasp:
    positions = rng.standard_normal((count, 3))
    positions /= np.linalg.norm(positions, axis=1)[:, None]
    return Grasp.from_contacts(0.05 * positions, -positions, rng.uniform(0.1, 1.2, count))


# max cases that stalled when this was written: found by the long trial


@pytest.mark.parametrize("seed", [9, 11, 12])
def test_the_least_maximum_is_found_where_many_normals_are_equal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(60):
        grasp = random_grasp(rng, "hard", most=9)
        load = random_wrench(rng, grasp)
        try:
            found = conic(grasp, load, criterion="max")
        except InfeasibleWrenchError:
            continue
        assert found.status is Status.OPTIMAL, found
        # each dominates the other: sum / N <= max <= sum
        least = conic(grasp, load).objective
        assert least / grasp.n_contacts * (1.0 - 2e-6) <= found.objective <= least * (1.0 + 2e-6)
