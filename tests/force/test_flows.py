"""The paper's reduction: full flow and reduced flow are one flow (Eqs. 9-26), and both are methods."""

from __future__ import annotations

from math import floor

import numpy as np
import pytest
from oracles import full_flow
from oracles.descent import Descent, followed
from oracles.reduced_flow import (
    flow_vector,
    landscape,
    picked_columns,
    picked_projector,
    picked_rows,
    reduced_projector,
)
from problems import GRASPS, LIGHT, PAPER_WRENCH, closure_grasps

from grasp_env.errors import UnsupportedProblemError
from grasp_env.force import (
    AdaptiveStep,
    ForceLimits,
    ForceOptimizer,
    LinearCombination,
    Objective,
    OfflineBasis,
    Status,
    optimize_force,
)
from grasp_env.grasp import Grasp

OBJECTIVE = Objective(1.0, 0.1)
SQUEEZE = 5.0
"""Added internal force, in units of the rest force: a start far from the optimum, for many steps."""
FLOWS = ("reduced_flow", "full_flow")


def _weights(grasp: Grasp) -> np.ndarray:
    return OBJECTIVE.weights(grasp.n_contacts)


def _start(grasp: Grasp) -> np.ndarray:
    force = LinearCombination(OBJECTIVE)(grasp, LIGHT) + SQUEEZE * OfflineBasis.of(grasp, OBJECTIVE).rest
    return grasp.to_cone(force)


MIXED = Grasp.from_contacts(
    GRASPS["cuboid, 5"].positions,
    GRASPS["cuboid, 5"].normals,
    [[0.4, 0.6], [0.5, 0.3], [0.4, 0.4], [0.4, 0.5], [0.4, 0.4]],
    contact_model=["hard", "hard", "hard", "hard", "frictionless"],
)
"""Elliptic cones and a contact without friction."""
ALL = {**GRASPS, "elliptic and frictionless": MIXED}


def _descend(grasp: Grasp, rule: AdaptiveStep, count: int) -> tuple[Descent, list[np.ndarray]]:
    """The plain reduced flow and all its iterates."""
    # moments in units of the grasp: the projector does not depend on them, its rounding does
    land = landscape(grasp.unit_frame @ grasp.cone_matrix, _weights(grasp))
    return followed(_start(grasp), land, rule, count)


@pytest.mark.parametrize("name", GRASPS)
def test_full_and_reduced_iterates_are_equal(name: str) -> None:
    grasp = GRASPS[name]
    descent, iterates = _descend(
        grasp, AdaptiveStep(0.004, grow=1.01), 240
    )  # small: not at the optimum, where steps end, before 240
    assert descent.iterations == 240
    q = full_flow.projector(grasp.cone_matrix)
    q_bar = picked_projector(grasp.cone_matrix)
    from_cone = grasp.cone_matrix @ iterates[0] + LIGHT
    assert np.abs(from_cone).max() < 1e-12
    whole, reduced = full_flow.start(iterates[0]), iterates[0].copy()
    for alpha, expected in zip(descent.steps, iterates[1:], strict=True):
        whole = whole + alpha * q @ full_flow.drive(whole, _weights(grasp))
        reduced = reduced + alpha * q_bar @ flow_vector(reduced, _weights(grasp))
        size = np.abs(reduced).max()
        assert np.abs(full_flow.cone_coordinates(whole) - reduced).max() < 1e-10 * size
        # the picked and the closed-form Q_bar: rounding of Q, contracted by the flow
        assert np.abs(reduced - expected).max() < 1e-10 * size
    # and the full state kept the structure that the reduction takes for granted
    assert (
        np.abs(
            full_flow.constraints(grasp.cone_matrix) @ whole - np.append(np.zeros(6 * grasp.n_contacts), -LIGHT)
        ).max()
        < 1e-11
    )
    assert descent.values[-1] < 0.9 * descent.values[0]


@pytest.mark.parametrize("method", FLOWS)
@pytest.mark.parametrize("name", ALL)
def test_methods_take_the_steps_of_the_plain_flow(name: str, method: str) -> None:
    grasp = ALL[name]
    rule, count = AdaptiveStep(), 12  # growing and rejected steps; few enough that no decision hangs on rounding
    descent, iterates = _descend(grasp, rule, count)
    optimizer = ForceOptimizer(
        grasp, method=method, barrier_weight=0.1, step_rule=rule, max_iterations=count, tolerance=1e-300
    )
    solution = optimizer.solve(LIGHT, initial=grasp.to_force(_start(grasp)), trace=True)
    assert (solution.method, solution.initial, solution.status) == (method, "given", Status.ITERATION_LIMIT)
    assert (solution.iterations, solution.trials) == (count, descent.trials)
    assert descent.trials > count
    np.testing.assert_allclose(solution.objective_trace, descent.values, rtol=1e-10)
    last = grasp.to_cone(solution.force).reshape(-1)
    np.testing.assert_allclose(last, iterates[-1], rtol=0, atol=1e-10 * np.abs(iterates[-1]).max())


def test_coordinates_without_friction_stay_zero() -> None:
    for method in FLOWS:
        force = optimize_force(
            MIXED, LIGHT, method=method, initial=MIXED.to_force(_start(MIXED)), barrier_weight=0.1
        ).force
        np.testing.assert_array_equal(force[4, 1:], 0.0)


def test_what_the_flows_do_not_know() -> None:
    angles = np.arange(9) * 2.0 * np.pi / 9
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(9)], axis=1)
    grasp = Grasp.from_contacts(0.05 * ring, -ring, 0.5)
    with pytest.raises(UnsupportedProblemError, match="the full flow is dense: at most 8 contacts"):
        ForceOptimizer(grasp, method="full_flow")
    for method in FLOWS:
        with pytest.raises(UnsupportedProblemError, match="take newton or conic"):
            ForceOptimizer(GRASPS["tripod"], method=method, limits=ForceLimits(max_normal=10.0))


@pytest.mark.parametrize("grasp", [*GRASPS.values(), *closure_grasps(10)], ids=lambda g: f"{g.n_contacts}")
def test_picked_projector_is_the_closed_form(grasp: Grasp) -> None:
    rows = grasp.unit_frame @ grasp.cone_matrix
    picked, closed = picked_projector(rows), reduced_projector(rows)
    assert picked.shape == (3 * grasp.n_contacts, 9 * grasp.n_contacts)
    # entries are below one; A A^T of random grasps has condition numbers up to 1e4, so a few 1e-12 are rounding
    np.testing.assert_allclose(picked, closed, rtol=0, atol=1e-12 if grasp in GRASPS.values() else 1e-11)
    # it moves along balance only, and is P-orthogonal: a projector once its input is lifted to P
    np.testing.assert_allclose(grasp.cone_matrix @ closed, 0.0, atol=1e-13 * np.abs(grasp.cone_matrix).max())


def test_printed_indices_for_four_fingers() -> None:
    """Eqs. 19 to 21 word for word; floor(a, b) there is the largest integer not greater than a / b."""
    m = [39 * floor((i - 1) / 3) + 2 ** (2 ** (i - 3 * floor((i - 1) / 3) - 1)) - 1 for i in range(1, 13)]
    n = [39 * floor((j - 1) / 3) + 12 * (j - 3 * floor((j - 1) / 3) - 1) + 1 for j in range(1, 13)]
    assert (picked_rows(4) + 1).tolist() == m
    assert (picked_columns(4) + 1).tolist() == [start + k for start in n for k in range(3)]
    q = full_flow.projector(GRASPS["cuboid, 4"].cone_matrix)
    assert q.shape == (144, 144)
    printed = np.array([[q[row - 1, start - 1 + k] for start in n for k in range(3)] for row in m])
    np.testing.assert_array_equal(printed, picked_projector(GRASPS["cuboid, 4"].cone_matrix))


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_indices_name_the_entries_they_mean(count: int) -> None:
    """Rows: entries (1, 1), (3, 1), (3, 2) of each block of vec(P); columns: all nine, column by column."""
    size = 3 * count
    labels = np.arange(size * size).reshape(size, size, order="F")
    blocks = [labels[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(count)]
    assert picked_rows(count).tolist() == [int(b[i, j]) for b in blocks for i, j in ((0, 0), (2, 0), (2, 1))]
    assert picked_columns(count).tolist() == [int(v) for b in blocks for v in b.reshape(-1, order="F")]


@pytest.mark.parametrize("name", GRASPS)
def test_dense_projector_projects_on_the_constraints(name: str) -> None:
    grasp = GRASPS[name]
    a, q = full_flow.constraints(grasp.cone_matrix), full_flow.projector(grasp.cone_matrix)
    count = grasp.n_contacts
    assert a.shape == (6 * count + 6, 9 * count**2)
    assert np.linalg.matrix_rank(a) == 6 * count + 6
    np.testing.assert_allclose(q @ q, q, atol=1e-12)
    np.testing.assert_allclose(q, q.T, atol=1e-12)
    np.testing.assert_allclose(a @ q, 0.0, atol=1e-12)
    # A vec(P) = (0, G f): balance reads the right entries
    force = np.random.default_rng(0).standard_normal((count, 3))
    wrench = a @ full_flow.start(grasp.to_cone(force))
    np.testing.assert_allclose(wrench, np.append(np.zeros(6 * count), grasp.wrench(force)), atol=1e-13)


def test_drive_and_value_of_the_full_flow() -> None:
    grasp = GRASPS["cuboid, 4"]
    x = _start(grasp)
    state = full_flow.start(x)
    np.testing.assert_allclose(full_flow.cone_coordinates(state), x, rtol=1e-15)
    assert full_flow.value(state, _weights(grasp)) == pytest.approx(OBJECTIVE.value(x), rel=1e-13)
    drive = full_flow.drive(state, _weights(grasp))
    np.testing.assert_allclose(drive[picked_columns(4)], flow_vector(x, _weights(grasp)), atol=1e-13)
    move = np.random.default_rng(1).standard_normal(12) * 1e-4
    ahead, behind = full_flow.start(x + move), full_flow.start(x - move)
    second = (
        full_flow.value(ahead, _weights(grasp))
        + full_flow.value(behind, _weights(grasp))
        - 2.0 * full_flow.value(state, _weights(grasp))
    )
    assert full_flow.curvature(state, full_flow.start(move), _weights(grasp)) == pytest.approx(second, rel=1e-3)
    assert landscape(grasp.cone_matrix, _weights(grasp)).curvature(x, move) == pytest.approx(second, rel=1e-3)
    outside = full_flow.start(x * np.tile([-1.0, 1.0, 1.0], 4))
    assert full_flow.value(outside, _weights(grasp)) == np.inf


def test_flow_is_the_negative_gradient_in_the_metric_of_p() -> None:
    """Q_bar VWP = -(projected gradient): the directional derivative of Phi along it is minus its squared length."""
    for grasp in closure_grasps(10):
        x = _start(grasp)
        direction = reduced_projector(grasp.cone_matrix) @ flow_vector(x, _weights(grasp))
        length = float(direction**2 @ np.tile([3.0, 2.0, 2.0], grasp.n_contacts))
        slope = float(OBJECTIVE.gradient(x) @ direction)
        assert slope == pytest.approx(-length, rel=1e-9, abs=1e-13)


def test_paper_wrench_first_step_by_hand() -> None:
    """One step of Eq. 26 with explicit inverses and a pseudoinverse in place of Q: nothing of the package but G."""
    grasp = GRASPS["cuboid, 4"]
    force = LinearCombination(OBJECTIVE)(grasp, PAPER_WRENCH)
    x, alpha = grasp.to_cone(force), 1e-3
    p = np.zeros((12, 12))
    for k, (u, o, t) in enumerate(x.reshape(-1, 3)):
        p[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = [[u, 0, o], [0, u, t], [o, t, u]]
    inverse = np.linalg.inv(p)
    drive = (0.1 * inverse @ inverse - np.eye(12)).reshape(-1, order="F")
    a = full_flow.constraints(grasp.cone_matrix)
    step = drive - np.linalg.pinv(a) @ (a @ drive)
    after = (p.reshape(-1, order="F") + alpha * step).reshape(12, 12, order="F")
    mine = x + alpha * reduced_projector(grasp.cone_matrix) @ flow_vector(x, _weights(grasp))
    np.testing.assert_allclose(mine[0::3], np.diag(after)[0::3], rtol=1e-12)
    np.testing.assert_allclose(mine[1::3], after[np.arange(2, 12, 3), np.arange(0, 12, 3)], atol=1e-12)
    np.testing.assert_allclose(mine[2::3], after[np.arange(2, 12, 3), np.arange(1, 12, 3)], atol=1e-12)
