"""Rows of starts agree with single runs of the solvers."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import ForceOptimizer, Objective, Repair, Status
from grasp_env.force.repair import carry_over
from grasp_env.force.rules import CoreRule
from grasp_env.grasp import presets, wrench
from training.evaluation.compare import trial
from training.evaluation.compare.case import Case
from training.evaluation.compare.cases import make_cases
from training.evaluation.compare.methods import METHODS, optimizer
from training.evaluation.compare.starts import STARTS, ComparedStart, DoesNotApply, StartContext
from training.evaluation.compare.trial import FINE, TOLERANCE, trials
from training.evaluation.results.table import chosen, numbers, table

PHI = Objective()


@pytest.fixture(scope="module")
def factory():
    return StartContext(PHI)


@pytest.fixture(scope="module")
def starts(factory):
    return factory.all_starts()


@pytest.fixture(scope="module")
def ball(starts):
    cases = make_cases("ball", 12, 0)
    return cases, table(trials("ball", cases, starts, PHI))


def of(rows, start, method="reduced_flow"):
    return chosen(rows, f"start == '{start}' and method == '{method}'")


def test_rows_agree_with_single_runs(ball, starts):
    cases, rows = ball
    assert {*rows["start"]} == {*starts} == {*STARTS}
    for key in starts:
        first = 1 if key.startswith("previous") else 0  # nothing lies before the first case
        for method in METHODS:
            assert of(rows, key, method)["problem"].tolist() == list(range(first, len(cases)))
    for key, k in product(
        ("linear_combination", "basis_tangent", "previous_tangent", "learned_fixed"), (1, 5)
    ):
        grasp, load = cases[k].grasp, cases[k].wrench
        exact = ForceOptimizer(grasp, method="newton", tolerance=1e-10)
        optimum = exact.solve(load)
        before = exact.solve(cases[k].before[1]).force
        force = starts[key].start(grasp, load, before)
        gap = PHI.value(grasp.to_cone(force)) / optimum.objective - 1.0
        for method in METHODS:
            row = of(rows, key, method).set_index("problem").loc[k]
            assert row["start_gap"] == pytest.approx(max(0.0, gap), abs=1e-12)
            for column, level in (("iterations", TOLERANCE), ("iterations_fine", FINE)):
                solution = optimizer(grasp, method, PHI, level).solve(
                    load, initial=force, optimum=optimum.objective
                )
                assert row[column] == solution.iterations
                assert row["status"] == solution.status.value == "optimal"
            assert (
                row["iterations_coarse"]
                <= row["iterations"]
                <= row["iterations_fine"]
                <= row["trials"]
            )
            assert row["gap"] <= FINE
            assert row["margin"] > 0.0


def test_levels_that_were_not_reached(monkeypatch, starts):
    monkeypatch.setattr(trial, "ITERATION_LIMIT", 3)
    some = {key: starts[key] for key in ("linear_combination", "learned_fixed")}
    rows = table(trials("ball", make_cases("ball", 40, 0), some, PHI))
    paper = of(rows, "linear_combination")
    learned = of(rows, "learned_fixed")
    assert {*paper["status"]} == {"iteration_limit"}
    assert {*paper["iterations"]} == {*paper["iterations_fine"]} == {4}
    assert {*learned["status"]} == {"optimal", "iteration_limit"}
    assert (learned["iterations"] == 4).tolist() == (
        learned["status"] == "iteration_limit"
    ).tolist()


def test_starts_are_feasible_and_balanced(ball, starts):
    _, rows = ball
    assert (numbers(rows, "start_margin") > 0.0).all()
    assert (numbers(rows, "start_residual") < 1e-9).all()
    for one, other in (
        ("basis_tangent", "linear_combination"),
        ("basis_newton", "basis_tangent"),
        ("learned_previous", "linear_combination"),
        ("learned_previous", "previous_tangent"),
        ("learned_fixed", "linear_combination"),
        ("nearest_tangent", "linear_combination"),
    ):
        both = of(rows, one).merge(of(rows, other), on="problem")
        assert len(both) >= 11
        assert (numbers(both, "start_gap_x") <= numbers(both, "start_gap_y") + 1e-12).all(), (
            one,
            other,
        )
    paper = of(rows, "linear_combination").set_index("problem")["start_gap"]
    learned = of(rows, "learned_fixed").set_index("problem")
    np.testing.assert_allclose(
        1.0 + learned["start_excess"], (1.0 + learned["start_gap"]) / (1.0 + paper), rtol=1e-9
    )
    grasp = presets.paper_cuboid()
    load = np.array(wrench.PAPER_CONSTANT)
    best = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(load)
    for key in ("previous_tangent", "previous_pseudoinverse"):  # exact if nothing changed
        np.testing.assert_allclose(
            starts[key].start(grasp, load, best.force), best.force, atol=1e-6
        )


def test_starts_that_fail_or_do_not_apply():
    def never(grasp, load, before):
        raise InfeasibleStartError("none")

    def boom(grasp, load):
        raise ValueError("many words " * 30)

    cases = make_cases("random_5", 12, 0)
    more = StartContext(PHI, {"boom": boom, "flat": lambda grasp, load: np.ones(3)}).all_starts()
    rows = table(trials("random_5", cases, {**more, "lagrange": ComparedStart(never, {})}, PHI))
    for key in ("learned_fixed", "nearest_tangent", "previous_tangent", "network"):
        assert of(rows, key).empty
        with pytest.raises(DoesNotApply):
            more[key].start(cases[0].grasp, cases[0].wrench, None)
    reasons = {
        "lagrange": "no feasible start",
        "boom": "ValueError: many words",
        "flat": "InvalidInputError: ",
    }
    for key, method in product(reasons, METHODS):
        found = of(rows, key, method)
        assert found["status"].tolist() == ["no_start"] * len(cases)
        assert found["iterations"].isna().all()
        assert found["reason"].str.startswith(reasons[key]).all(), found["reason"].tolist()
    assert of(rows, "boom")["reason"].str.len().max() <= 120


def test_invalid_forces_are_told_from_each_other():
    given = {
        "unbalanced": lambda grasp, load: np.tile([1.0, 0.0, 0.0], (grasp.n_contacts, 1)),
        "outside": lambda grasp, load: -(grasp.pseudoinverse @ load).reshape(-1, 3),
        "own": lambda grasp, load: CoreRule("single_value")(grasp, load),
        "discarded": lambda grasp, load: Repair()(
            grasp, load, np.tile([10.0, 0.0, 0.0], (grasp.n_contacts, 1))
        ),
    }
    made = StartContext(PHI, given).all_starts()
    some = {key: made[key] for key in ("single_value", "linear_combination", *given)}
    cases = make_cases("ball", 5, 0)
    rows = table(trials("ball", cases, some, PHI))
    alone = table(trials("ball", cases, some, PHI, solved=False))
    for key, why in (("unbalanced", "out of balance"), ("outside", "outside the cones")):
        found = chosen(alone, f"start == '{key}'")
        assert of(rows, key)["reason"].tolist() == found["reason"].tolist() == [why] * 5
        assert found["start_slope"].isna().all()  # an invalid force has no slope
    columns = [name for name in rows.columns if name not in ("start", "start_replaced")]
    mine, ours = (of(rows, key)[columns].reset_index(drop=True) for key in ("own", "single_value"))
    assert mine.equals(ours)  # the same rule
    assert of(rows, "discarded")["start_replaced"].tolist() == [True] * 5
    assert not of(rows, "own")["start_replaced"].any()
    np.testing.assert_array_equal(
        of(rows, "discarded")["iterations"], of(rows, "linear_combination")["iterations"]
    )


def test_the_nearest_stored_solution(factory):
    (forces, tree), optimizers = factory.stored, trial.Optimizers(PHI)
    load = tree.data[7] * [1.0, 1.0, 1.0, 0.05, 0.05, 0.05]
    fixed = presets.paper_cuboid()
    found = factory.nearest("pseudoinverse").start(fixed, load, None)
    np.testing.assert_array_equal(found, carry_over(fixed, load, forces[7], PHI, "pseudoinverse"))
    for grasp in (fixed, presets.five_finger_cuboid()):
        best = ForceOptimizer(grasp, tolerance=1e-10).solve(load)
        assert optimizers.optimum(grasp, load)[1] == pytest.approx(best.objective, rel=1e-9)


def test_slopes_are_differences_along_a_path():
    grasp = presets.paper_cuboid()
    start = StartContext(PHI).by_name("linear_combination")
    loads = np.array([[1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0.05], [0, 0, 0, 0, 0, 0.05]], float)
    cases = [
        Case(grasp, loads[0]),
        Case(grasp, loads[1], (grasp, loads[0])),
        Case(grasp, loads[2], (grasp, loads[0])),
    ]
    slopes = numbers(
        table(trials("x", cases, {"linear_combination": start}, PHI, solved=False)), "start_slope"
    )
    move = start.start(grasp, loads[1], None) - start.start(grasp, loads[0], None)
    assert slopes[1] == pytest.approx(np.linalg.norm(move) / 1.0)  # 0.05 N m over 0.05 m is 1 N
    assert np.isnan(slopes[[0, 2]]).all()  # the last case does not follow the one before it


def test_timed_calls_begin_at_the_compared_starts(starts):
    grasp = presets.paper_cuboid()
    first, second = wrench.sample_ball(np.random.default_rng(5), 2)
    paper = PHI.value(grasp.to_cone(starts["linear_combination"].start(grasp, second, None)))
    for key, made in starts.items():
        loop = ForceOptimizer(grasp, method="reduced_flow", **made.options)
        before = loop.solve(first).force
        solution = loop.solve(
            second, initial=None if made.options else made.start(grasp, second, before)
        )
        assert solution.status is Status.OPTIMAL
        if key.startswith("learned"):
            assert PHI.value(grasp.to_cone(solution.initial_force)) <= paper * (1.0 + 1e-12)
        else:
            expected = made.start(grasp, second, before)
            np.testing.assert_allclose(solution.initial_force, expected, atol=1e-9, err_msg=key)
