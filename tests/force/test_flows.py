"""The paper's reduction: full flow, reduced flow and compiled flow are one flow (Eqs. 9-26)."""

from __future__ import annotations

from math import floor

import numpy as np
import pytest
from oracles.full_flow import full_flow as plain_full_flow
from problems import GRASPS, PAPER_WRENCH, closure_grasps, weights

from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import AdaptiveStep, LinearCombination, Objective, OfflineBasis, full_flow, record
from grasp_env.force.descent import Descent, descend
from grasp_env.force.flow import FORMS, Flow, fastest_form, operations, run_flow
from grasp_env.force.reduced_flow import (
    flow_vector,
    landscape,
    picked_columns,
    picked_projector,
    picked_rows,
    reduced_projector,
)
from grasp_env.grasp import Grasp

OBJECTIVE = Objective(1.0, 0.1)
LIGHT = np.array([0.3, -0.2, 0.5, 0.01, -0.005, 0.008])
SQUEEZE = 5.0
"""Added internal force, in units of the rest force: a start far from the optimum, for many steps."""


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
    iterates: list[np.ndarray] = []

    def keep(state: np.ndarray, _value: float, _iterations: int) -> bool:
        iterates.append(state)
        return False

    descent = descend(_start(grasp), landscape(grasp, OBJECTIVE), keep, rule, count)
    return descent, iterates


@pytest.mark.parametrize("name", GRASPS)
def test_full_and_reduced_iterates_are_equal(name: str) -> None:
    grasp = GRASPS[name]
    descent, iterates = _descend(
        grasp, AdaptiveStep(0.004, grow=1.01), 240
    )  # small: not at the optimum, where steps end, before 240
    assert descent.iterations == 240
    q = full_flow.projector(grasp)
    q_bar = picked_projector(grasp)
    from_cone = grasp.cone_matrix @ iterates[0] + LIGHT
    assert np.abs(from_cone).max() < 1e-12
    whole, reduced = full_flow.start(iterates[0]), iterates[0].copy()
    for alpha, expected in zip(descent.steps, iterates[1:], strict=True):
        whole = whole + alpha * q @ full_flow.drive(whole, OBJECTIVE)
        reduced = reduced + alpha * q_bar @ flow_vector(reduced, OBJECTIVE)
        size = np.abs(reduced).max()
        assert np.abs(full_flow.cone_coordinates(whole) - reduced).max() < 1e-10 * size
        # the picked and the closed-form Q_bar: rounding of Q, contracted by the flow
        assert np.abs(reduced - expected).max() < 1e-10 * size
    # and the full state kept the structure that the reduction takes for granted
    assert (
        np.abs(full_flow.constraints(grasp) @ whole - np.append(np.zeros(6 * grasp.n_contacts), -LIGHT)).max() < 1e-11
    )
    assert descent.values[-1] < 0.9 * descent.values[0]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ALL)
def test_every_compiled_form_gives_the_iterates_of_the_plain_flow(name: str, form: str) -> None:
    grasp = ALL[name]
    rule, count = AdaptiveStep(), 20  # growing and rejected steps; few enough that no decision hangs on rounding
    descent, iterates = _descend(grasp, rule, count)
    flow, trials = Flow(grasp, form), 0
    for k, expected in enumerate(iterates):
        x, trace = _start(grasp), np.full(count + 1, np.nan)
        code, iterations, trials, value, _ = flow.run(
            weights(x, 1.0, 0.1), x, LIGHT, rule, tolerance=1e-300, max_iterations=k, trace=trace
        )
        assert (code, iterations) == (record.LIMIT, k)
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
        np.testing.assert_allclose(trace[: k + 1], descent.values[: k + 1], rtol=1e-10)
        assert np.isnan(trace[k + 1 :]).all()
        assert value == trace[k]
    assert trials == descent.trials > count


@pytest.mark.parametrize("form", FORMS)
def test_every_form_stays_balanced_and_certifies_the_same_optimum(form: str) -> None:
    for name, grasp in ALL.items():
        x = _start(grasp)
        trace = np.full(5000, np.nan)
        code, iterations, _, value, bound = run_flow(
            grasp, weights(x, 1.0, 0.1), x, LIGHT, AdaptiveStep(), form=form, tolerance=1e-9, trace=trace
        )
        assert code == record.CONVERGED, name
        assert (np.diff(trace[: iterations + 1]) < 0.0).all()
        assert bound <= value <= bound * (1.0 + 1e-9)
        assert value == pytest.approx(OBJECTIVE.value(x), rel=1e-13)
        size = np.abs(grasp.cone_matrix).max() * np.abs(x).max()
        np.testing.assert_allclose(grasp.cone_matrix @ x + LIGHT, 0.0, atol=1e-11 * size)
        again = run_flow(
            grasp, weights(x, 1.0, 0.1), _start(grasp), LIGHT, AdaptiveStep(), optimum=value, tolerance=1e-9
        )
        assert again[0] == record.CONVERGED
        assert again[3] == pytest.approx(value, rel=1e-8)


def test_many_contacts_in_every_form_that_takes_them() -> None:
    grasp = closure_grasps(5)[4]  # seven contacts, two blocks of four lanes
    angles = np.arange(13) * 2.0 * np.pi / 13
    ring = np.stack([np.cos(angles), np.sin(angles), 0.2 * np.sin(3.0 * angles)], axis=1)
    normals = -ring / np.linalg.norm(ring, axis=1)[:, None]
    for many in (grasp, Grasp.from_contacts(0.05 * ring, normals, 0.6)):
        results = []
        for form in FORMS:
            if form == "full" and many.n_contacts > full_flow.MAX_CONTACTS:
                continue
            x = _start(many)
            run_flow(
                many, weights(x, 1.0, 0.1), x, LIGHT, AdaptiveStep(), form=form, max_iterations=12, tolerance=1e-300
            )
            results.append(x)
        for x in results[1:]:
            np.testing.assert_allclose(x, results[0], rtol=0, atol=1e-10 * np.abs(x).max())


def test_coordinates_without_friction_stay_zero() -> None:
    for form in FORMS:
        x = _start(MIXED)
        run_flow(MIXED, weights(x, 1.0, 0.1), x, LIGHT, AdaptiveStep(), form=form)
        np.testing.assert_allclose(x[13:], 0.0, atol=1e-14)


def test_the_bound_is_certified_wherever_the_flow_stops() -> None:
    grasp = GRASPS["cuboid, 4"]
    best = OBJECTIVE.value(_optimum(grasp))
    for limit in (0, 1, 5, 17, 60):
        x = _start(grasp)
        *_, value, bound = run_flow(grasp, weights(x, 1.0, 0.1), x, LIGHT, AdaptiveStep(), max_iterations=limit)
        assert bound <= best * (1.0 + 1e-12) <= value * (1.0 + 2e-12)
        if limit >= 17:
            assert bound > 0.5 * best


def _optimum(grasp: Grasp) -> np.ndarray:
    x = _start(grasp)
    run_flow(grasp, weights(x, 1.0, 0.1), x, LIGHT, AdaptiveStep(), tolerance=1e-13)
    return x


def test_plain_full_flow_and_compiled_full_flow_end_alike() -> None:
    grasp = GRASPS["tripod"]
    plain, compiled = _start(grasp), _start(grasp)
    trace = np.full(60, np.nan)
    slow = plain_full_flow(grasp, OBJECTIVE, plain, LIGHT, AdaptiveStep(), 1e-5, float("nan"), 500, trace)
    fast = run_flow(grasp, weights(plain, 1.0, 0.1), compiled, LIGHT, AdaptiveStep(), form="full", tolerance=1e-5)
    assert slow[0] == fast[0] == record.CONVERGED
    assert abs(slow[1] - fast[1]) <= 1  # the plain one looks at the bound more often
    assert slow[3] == pytest.approx(fast[3], rel=1e-5)
    assert trace[0] == pytest.approx(OBJECTIVE.value(_start(grasp)))


def test_forms_have_names_and_counts() -> None:
    assert [operations(form, 4) for form in FORMS] == [20736, 432, 144, 144, 156]
    assert [fastest_form(n) for n in (3, 4, 5, 100)] == ["projector", "projector", "row_space", "row_space"]
    for wrong in (lambda: Flow(GRASPS["tripod"], "dense"), lambda: operations("dense", 4)):
        with pytest.raises(UnknownNameError, match="'dense': choose one of 'full', 'paper'"):
            wrong()


@pytest.mark.parametrize("grasp", [*GRASPS.values(), *closure_grasps(10)], ids=lambda g: f"{g.n_contacts}")
def test_picked_projector_is_the_closed_form(grasp: Grasp) -> None:
    picked, closed = picked_projector(grasp), reduced_projector(grasp)
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
    q = full_flow.projector(GRASPS["cuboid, 4"])
    assert q.shape == (144, 144)
    printed = np.array([[q[row - 1, start - 1 + k] for start in n for k in range(3)] for row in m])
    np.testing.assert_array_equal(printed, picked_projector(GRASPS["cuboid, 4"]))


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
    a, q = full_flow.constraints(grasp), full_flow.projector(grasp)
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
    assert full_flow.value(state, OBJECTIVE) == pytest.approx(OBJECTIVE.value(x), rel=1e-13)
    drive = full_flow.drive(state, OBJECTIVE)
    np.testing.assert_allclose(drive[picked_columns(4)], flow_vector(x, OBJECTIVE), atol=1e-13)
    move = np.random.default_rng(1).standard_normal(12) * 1e-4
    ahead, behind = full_flow.start(x + move), full_flow.start(x - move)
    second = (
        full_flow.value(ahead, OBJECTIVE) + full_flow.value(behind, OBJECTIVE) - 2.0 * full_flow.value(state, OBJECTIVE)
    )
    assert full_flow.curvature(state, full_flow.start(move), OBJECTIVE) == pytest.approx(second, rel=1e-3)
    assert landscape(grasp, OBJECTIVE).curvature(x, move) == pytest.approx(second, rel=1e-3)
    outside = full_flow.start(x * np.tile([-1.0, 1.0, 1.0], 4))
    assert full_flow.value(outside, OBJECTIVE) == np.inf


def test_flow_is_the_negative_gradient_in_the_metric_of_p() -> None:
    """Q_bar VWP = -(projected gradient): the directional derivative of Phi along it is minus its squared length."""
    for grasp in closure_grasps(10):
        x = _start(grasp)
        direction = reduced_projector(grasp) @ flow_vector(x, OBJECTIVE)
        length = float(direction**2 @ np.tile([3.0, 2.0, 2.0], grasp.n_contacts))
        slope = float(OBJECTIVE.gradient(x) @ direction)
        assert slope == pytest.approx(-length, rel=1e-9, abs=1e-13)


def test_full_flow_says_how_many_contacts_it_takes() -> None:
    angles = np.arange(9) * 2.0 * np.pi / 9
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(9)], axis=1)
    grasp = Grasp.from_contacts(0.05 * ring, -ring, 0.5)
    with pytest.raises(InvalidInputError, match="9 contacts given, at most 8"):
        full_flow.projector(grasp)


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
    a = full_flow.constraints(grasp)
    step = drive - np.linalg.pinv(a) @ (a @ drive)
    after = (p.reshape(-1, order="F") + alpha * step).reshape(12, 12, order="F")
    mine = x + alpha * reduced_projector(grasp) @ flow_vector(x, OBJECTIVE)
    np.testing.assert_allclose(mine[0::3], np.diag(after)[0::3], rtol=1e-12)
    np.testing.assert_allclose(mine[1::3], after[np.arange(2, 12, 3), np.arange(0, 12, 3)], atol=1e-12)
    np.testing.assert_allclose(mine[2::3], after[np.arange(2, 12, 3), np.arange(1, 12, 3)], atol=1e-12)
