"""`newton` with soft contacts: the core's against the general program, starts, what it leaves to that, and what a solution says."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from problems import GRASPS

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import ForceOptimizer, Objective, Status, optimize_force
from grasp_env.force.program import ForceProgram
from grasp_env.force.record import CODE, CONVERGED, FORCE, OBJECTIVE
from grasp_env.grasp import Grasp

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
MODELS = {
    "soft": lambda count: ["soft"] * count,
    "mixed": lambda count: ["hard", "soft", "frictionless", "soft", "soft", "hard"][:count],
}


def softened(name: str, models: str = "soft", torsional: float = 0.005, ratio: float = 1.0) -> Grasp:
    """ratio: of the two coefficients of friction; 1: round cones."""
    base = GRASPS[name]
    friction = np.column_stack([base.friction, ratio * base.friction])
    return Grasp.from_contacts(
        base.positions,
        base.normals,
        friction,
        contact_model=MODELS[models](base.n_contacts),
        torsional_friction=torsional,
    )


def pinch() -> Grasp:
    """Two fingers: torsion alone gives closure."""
    return Grasp.from_contacts(
        [[-0.03, 0.0, 0.0], [0.03, 0.0, 0.0]], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], 0.6, contact_model="soft",
        torsional_friction=0.005,
    )  # fmt: skip


CASES = [
    ("cuboid, 4", "soft", 0.005, 1.0), ("cuboid, 4", "soft", 1e-4, 1.4), ("tripod, uneven", "soft", 0.02, 1.0),
    ("cuboid, 5, uneven", "mixed", 0.005, 0.7), ("cuboid, 5, uneven", "soft", 0.1, 1.0),
]  # fmt: skip


def general_optimum(grasp: Grasp, objective: Objective, load: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """(Phi, forces, torsions) by the general program alone, from its deepest force."""
    program, count = ForceProgram(grasp), grasp.n_contacts
    deep = program.deepest(load)
    record, _ = program.least_phi(load, objective.weights(count), deep.z, 1e-10, np.nan, 10_000, np.empty(0))
    assert record[CODE] == CONVERGED
    forces = record[FORCE : FORCE + 3 * count].reshape(count, 3)
    return record[OBJECTIVE], forces, record[FORCE + 6 * count : FORCE + 7 * count]


@pytest.mark.parametrize(("name", "models", "torsional", "ratio"), CASES)
def test_the_optimum_is_the_general_programs(name: str, models: str, torsional: float, ratio: float) -> None:
    grasp = softened(name, models, torsional, ratio)
    count = grasp.n_contacts
    optimizer = ForceOptimizer(
        grasp, method="newton", tolerance=1e-10, barrier_weight=np.linspace(0.01, 0.05, count).tolist(),
        force_weight=np.linspace(0.7, 1.6, count).tolist(),
    )  # fmt: skip
    rng = np.random.default_rng(5)
    for _ in range(10):
        load = rng.standard_normal(6) * [1.0, 1.0, 1.0, 0.03, 0.03, 0.03] * 10.0 ** rng.uniform(-1.0, 1.0)
        least, forces, torsions = general_optimum(grasp, optimizer.objective, load)
        found = optimizer.solve(load)
        assert (found.status, found.initial) == (Status.OPTIMAL, "internal_force")
        assert found.objective == pytest.approx(least, rel=1e-8)
        assert found.lower_bound <= least * (1.0 + 1e-12)
        # Phi is flat at its least: a gap of 1e-10 leaves 1e-5 of force and price
        size = np.abs(forces).max()
        np.testing.assert_allclose(found.force, forces, atol=1e-4 * size)
        np.testing.assert_allclose(found.torsion, torsions, atol=1e-4 * size * torsional)
        made = grasp.matrix @ found.force.reshape(-1) + grasp.torsion_matrix @ found.torsion
        assert np.abs(grasp.unit_frame @ (made + load)).max() < 1e-11 * max(size, 1.0)
        assert (np.abs(found.torsion) <= grasp.models.torsional_friction * found.force[:, 0]).all()
        assert (found.torsion[grasp.models.torsional_friction == 0.0] == 0.0).all()
        assert grasp.cone_margin(found.force) == pytest.approx(found.cone_margin, rel=1e-9)


def test_every_start_ends_at_the_same_optimum() -> None:
    grasp = softened("cuboid, 4")
    first = optimize_force(grasp, LOAD, method="newton", tolerance=1e-10)
    near = optimize_force(grasp, 1.1 * LOAD, method="newton", tolerance=1e-10)
    starts = [
        "linear_combination",
        "linear_combination_printed",
        "single_value",
        "lagrange",
        "phase_one",
        first,
        near,
        np.asarray(first.initial_force),
    ]
    for start in starts:
        found = optimize_force(grasp, LOAD, method="newton", tolerance=1e-10, initial=start)
        assert found.status is Status.OPTIMAL
        assert found.objective == pytest.approx(first.objective, rel=1e-9)
    remembering = ForceOptimizer(grasp, method="newton", tolerance=1e-10, initial="previous")
    assert [remembering.solve(load).initial for load in (LOAD, 1.1 * LOAD, LOAD)] == [
        "internal_force", "previous", "previous",
    ]  # fmt: skip
    assert remembering.previous is not None
    assert remembering.previous.objective == pytest.approx(first.objective, rel=1e-9)
    with pytest.raises(InfeasibleStartError, match="misses balance"):
        optimize_force(grasp, LOAD, method="newton", initial=1.1 * first.force)


def test_a_known_optimum_and_a_trace() -> None:
    grasp = softened("cuboid, 4")
    least = optimize_force(grasp, LOAD, method="newton", tolerance=1e-10).objective
    found = optimize_force(grasp, LOAD, method="newton", optimum=least, trace=True)
    assert found.status is Status.OPTIMAL
    assert len(found.objective_trace) == found.iterations + 1
    assert (np.diff(found.objective_trace) < 0.0).all()
    assert found.objective_trace[-1] == pytest.approx(found.objective, rel=1e-12)
    assert found.lower_bound == least


def test_closure_by_torsion_alone() -> None:
    found = optimize_force(pinch(), [0.0, 0.0, 1.0, 0.001, 0.0, 0.0], method="newton")
    assert (found.status, found.initial) == (Status.OPTIMAL, "phase_one")


def test_a_solution_survives_a_pickle() -> None:
    found = optimize_force(softened("cuboid, 4"), LOAD, method="newton")
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.torsion, found.torsion)


def test_stopped_early_it_says_so() -> None:
    found = ForceOptimizer(softened("cuboid, 4"), method="newton", max_iterations=1).solve(20.0 * LOAD)
    assert (found.status, found.iterations) == (Status.ITERATION_LIMIT, 1)
    assert found.lower_bound <= optimize_force(softened("cuboid, 4"), 20.0 * LOAD, method="newton").objective


def test_without_torsional_friction_to_speak_of_it_is_the_hard_optimum() -> None:
    """The terms of torsion alone remain, 2 lambda / u a contact: a thousandth of this Phi at most."""
    hard, soft = GRASPS["cuboid, 4"], softened("cuboid, 4", torsional=1e-7)
    low = optimize_force(hard, LOAD, method="newton", barrier_weight=1e-6, tolerance=1e-9)
    found = optimize_force(soft, LOAD, method="newton", barrier_weight=1e-6, tolerance=1e-9)
    assert found.objective == pytest.approx(low.objective, rel=1e-3)
