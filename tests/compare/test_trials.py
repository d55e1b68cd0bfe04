"""Rows of starts say what the solvers did; starts are what they claim; nothing that fails is dropped."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from grasp_env.errors import InfeasibleStartError
from grasp_env.force import RULES, ForceOptimizer, Objective, OfflineBasis, Repair, Status
from grasp_env.force.rules import CoreStart, StartRule
from grasp_env.grasp import presets, wrench
from training.compare import trial
from training.compare.case import Case
from training.compare.cases import make_cases
from training.compare.given import Problem
from training.compare.methods import METHODS, optimizer
from training.compare.starts import GIVEN_COLOURS, STARTS, DoesNotApply, PreparedStart, StartFactory, StartInfo
from training.compare.trial import FINE, LIMIT, TOLERANCE, trials
from training.results.table import chosen, numbers, table

PHI = Objective()


@pytest.fixture(scope="module")
def starts():
    return StartFactory(PHI).made()


@pytest.fixture(scope="module")
def ball(starts):
    cases = make_cases("ball", 12, 0)
    return cases, table(trials("ball", cases, starts, {}, PHI))


def of(rows, start, method="reduced_flow"):
    return chosen(rows, f"start == '{start}' and method == '{method}'")


def test_every_start_has_a_row_for_every_case_to_which_it_applies(ball, starts):
    cases, rows = ball
    assert {*rows["start"]} == {*starts} == {*STARTS}
    for key in starts:
        first = 1 if key.startswith("previous") else 0  # nothing lies before the first case
        for method in METHODS:
            assert of(rows, key, method)["problem"].tolist() == list(range(first, len(cases)))


def test_rows_agree_with_single_runs(ball, starts):
    cases, rows = ball
    for key in ("linear_combination", "basis_tangent", "previous_tangent", "learned_fixed"):
        for k in (1, 5):
            grasp, load = cases[k].grasp, cases[k].wrench
            optimum = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(load)
            before = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(cases[k].before[1]).force
            force = starts[key].start(grasp, load, before)
            gap = PHI.value(grasp.to_cone(force)) / optimum.objective - 1.0
            for method in METHODS:
                row = of(rows, key, method).set_index("problem").loc[k]
                assert row["start_gap"] == pytest.approx(max(0.0, gap), abs=1e-12)
                for column, level in (("iterations", TOLERANCE), ("iterations_fine", FINE)):
                    run = optimizer(grasp, method, PHI, level)
                    solution = run.solve(load, initial=force, optimum=optimum.objective)
                    assert row[column] == solution.iterations
                    assert row["status"] == solution.status.value == "optimal"
                assert row["iterations_coarse"] <= row["iterations"] <= row["iterations_fine"]
                assert row["trials"] >= row["iterations_fine"]
                assert row["gap"] <= FINE
                assert row["margin"] > 0.0


def test_a_level_that_was_not_reached_counts_as_more_than_the_limit(monkeypatch, starts):
    monkeypatch.setattr(trial, "LIMIT", 3)
    chosen_ = {key: starts[key] for key in ("linear_combination", "learned_fixed")}
    rows = table(trials("ball", make_cases("ball", 40, 0), chosen_, {}, PHI))
    paper = of(rows, "linear_combination")
    assert {*paper["status"]} == {"iteration_limit"}
    assert {*paper["iterations"]} == {*paper["iterations_fine"]} == {4}
    learned = of(rows, "learned_fixed")
    assert {*learned["status"]} == {"optimal", "iteration_limit"}
    assert (learned["iterations"] == 4).tolist() == (learned["status"] == "iteration_limit").tolist()


def test_starts_are_feasible_balanced_and_corrected_ones_no_worse(ball):
    _, rows = ball
    assert (numbers(rows, "start_margin") > 0.0).all()
    assert (numbers(rows, "start_residual") < 1e-9).all()
    for one, other in (
        ("basis_tangent", "linear_combination"), ("basis_newton", "basis_tangent"), ("learned_previous", "linear_combination"),
        ("learned_previous", "previous_tangent"), ("learned_fixed", "linear_combination"), ("nearest_tangent", "linear_combination"),
    ):  # fmt: skip
        both = of(rows, one).merge(of(rows, other), on="problem")
        assert len(both) >= 11
        assert (numbers(both, "start_gap_x") <= numbers(both, "start_gap_y") + 1e-12).all(), (one, other)
    paper = of(rows, "linear_combination").set_index("problem")["start_gap"]
    learned = of(rows, "learned_fixed").set_index("problem")
    np.testing.assert_allclose(1.0 + learned["start_excess"], (1.0 + learned["start_gap"]) / (1.0 + paper), rtol=1e-9)


def test_what_does_not_apply_has_no_row_and_a_start_that_fails_has_one(starts):
    def never(grasp, load, before):
        raise InfeasibleStartError("none")

    def boom(grasp, load):
        raise ValueError("many words " * 30)

    cases = make_cases("random_5", 12, 0)
    more = StartFactory(PHI, {"boom": boom, "flat": lambda grasp, load: np.ones(3)}).made()
    rows = table(trials("random_5", cases, {**more, "lagrange": PreparedStart(never, {})}, {}, PHI))
    for key in ("learned_fixed", "nearest_tangent", "previous_tangent", "network"):
        assert of(rows, key).empty
        with pytest.raises(DoesNotApply):
            more[key].start(cases[0].grasp, cases[0].wrench, None)
    assert len(of(rows, "linear_combination")) == len(cases)
    for key, why in (
        ("lagrange", "has none"),
        ("boom", "ValueError: many words many"),
        ("flat", "InvalidInputError: "),
    ):
        for method in METHODS:
            found = of(rows, key, method)
            assert found["status"].tolist() == ["no_start"] * len(cases)
            assert found["iterations"].isna().all()
            assert found["reason"].str.startswith(why).all(), found["reason"].tolist()
    assert of(rows, "boom")["reason"].str.len().max() <= 120
    assert of(rows, "boom")["reason"].str.endswith((" many …", " words …")).all()


def test_forces_that_are_no_starts_are_told_from_each_other(starts):
    given = {
        "unbalanced": lambda grasp, load: np.tile([1.0, 0.0, 0.0], (grasp.n_contacts, 1)),
        "outside": lambda grasp, load: -(grasp.pseudoinverse @ load).reshape(-1, 3),
        "own": lambda grasp, load: CoreStart("single_value")(grasp, load),
        "discarded": lambda grasp, load: Repair()(grasp, load, np.tile([10.0, 0.0, 0.0], (grasp.n_contacts, 1))),
    }
    chosen_ = {
        key: made
        for key, made in StartFactory(PHI, given).made().items()
        if key in (*given, "single_value", "linear_combination")
    }
    cases = make_cases("ball", 5, 0)
    rows = table(trials("ball", cases, chosen_, {}, PHI))
    alone = table(trials("ball", cases, chosen_, {}, PHI, solved=False))
    for key, why in (("unbalanced", "out of balance"), ("outside", "outside the cones")):
        assert of(rows, key)["reason"].tolist() == [why] * 5
        assert chosen(alone, f"start == '{key}'")["reason"].tolist() == [why] * 5
        assert chosen(alone, f"start == '{key}'")["start_slope"].isna().all()  # a constant force is not smooth but none
    mine, ours = (
        of(rows, key).drop(columns=["start", "start_replaced"]).reset_index(drop=True)
        for key in ("own", "single_value")
    )
    assert mine.equals(ours)  # the same rule
    assert of(rows, "discarded")["start_replaced"].tolist() == [True] * 5
    assert not of(rows, "own")["start_replaced"].any()
    np.testing.assert_array_equal(of(rows, "discarded")["iterations"], of(rows, "linear_combination")["iterations"])


def test_slopes_are_differences_along_a_path():
    grasp = presets.paper_cuboid()
    start = StartFactory(PHI).named("linear_combination")
    loads = np.array([[1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0.05], [0, 0, 0, 0, 0, 0.05]], float)
    cases = [Case(grasp, loads[0]), Case(grasp, loads[1], (grasp, loads[0])), Case(grasp, loads[2], (grasp, loads[0]))]
    slopes = numbers(table(trials("x", cases, {"linear_combination": start}, {}, PHI, solved=False)), "start_slope")
    move = start.start(grasp, loads[1], None) - start.start(grasp, loads[0], None)
    assert slopes[1] == pytest.approx(np.linalg.norm(move) / 1.0)  # 0.05 N m over 0.05 m is 1 N
    assert np.isnan(slopes[[0, 2]]).all()  # the last case does not follow the one before it


class Least:
    """A solver of a user: Newton on Phi."""

    def solve(self, problem: Problem) -> np.ndarray:
        assert problem.weights.shape == (len(problem.positions), 2)
        grasp = presets.paper_cuboid()
        np.testing.assert_array_equal(problem.positions, grasp.positions)
        if problem.wrench[0] > 1.0:
            raise ArithmeticError("too far to the right")
        force = ForceOptimizer(grasp, method="newton").solve(problem.wrench).force
        return np.einsum("nij,nj->ni", problem.frames, force)


class Squeezes(Least):
    """One that balances, far from the optimum of Phi."""

    def solve(self, problem: Problem) -> np.ndarray:
        grasp = presets.paper_cuboid()
        force = OfflineBasis.of(grasp, PHI).combine(problem.wrench)
        return grasp.to_object_frame(force)


class Forgets(Least):
    """One that forgets the wrench."""

    def solve(self, problem: Problem) -> np.ndarray:
        return np.zeros((len(problem.positions), 3))


def test_a_users_solver_is_one_more_method():
    cases = make_cases("ball", 30, 0)
    right = sum(case.wrench[0] > 1.0 for case in cases)
    assert right
    solvers = {"least": Least(), "squeezes": Squeezes(), "forgets": Forgets()}
    rows = table(trials("ball", cases, {}, solvers, PHI))
    by = {key: chosen(rows, f"method == '{key}'") for key in solvers}
    assert by["least"]["status"].value_counts().to_dict() == {"optimal": 30 - right, "failed": right}
    assert {*by["least"]["reason"].dropna()} == {"ArithmeticError: too far to the right"}
    assert by["least"]["gap"].max() <= TOLERANCE
    assert {*by["squeezes"]["status"]} == {"feasible"}
    assert by["squeezes"]["gap"].min() > TOLERANCE
    force = OfflineBasis.of(cases[0].grasp, PHI).combine(cases[0].wrench)
    assert by["squeezes"]["normal_force"].iloc[0] == pytest.approx(force[:, 0].sum())
    assert {*by["forgets"]["status"]} == {"failed"}
    assert by["forgets"]["failed"].all()


def test_whole_calls_start_where_the_starts_say(starts):
    """What is timed is what is compared."""
    grasp, (first, second) = presets.paper_cuboid(), wrench.sample_ball(np.random.default_rng(5), 2)
    paper = PHI.value(grasp.to_cone(starts["linear_combination"].start(grasp, second, None)))
    for key, made in starts.items():
        loop = ForceOptimizer(grasp, method="reduced_flow", **made.options)
        before = loop.solve(first).force
        solution = loop.solve(second, initial=None if made.options else made.start(grasp, second, before))
        assert solution.status is Status.OPTIMAL
        if key.startswith("learned"):
            assert PHI.value(grasp.to_cone(solution.initial_force)) <= paper * (1.0 + 1e-12)
        else:
            expected = made.start(grasp, second, before)
            np.testing.assert_allclose(solution.initial_force, expected, atol=1e-9, err_msg=key)


def test_a_previous_solution_is_exact_where_nothing_changed(starts):
    grasp, load = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    best = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(load)
    for key in ("previous_tangent", "previous_pseudoinverse"):
        np.testing.assert_allclose(starts[key].start(grasp, load, best.force), best.force, atol=1e-6)


def test_one_entry_is_all_that_a_start_needs(monkeypatch):
    monkeypatch.setitem(
        STARTS, "new", StartInfo("three corrections", "three", "#101010", lambda shop: shop.stepped("lagrange", 3))
    )
    monkeypatch.setitem(RULES, "newest", StartRule("the newest of all", partial(CoreStart, "single_value")))
    made = StartFactory(PHI, {"mine": CoreStart("single_value")}).made()
    assert [*made][-3:] == ["new", "newest", "mine"]
    rows = table(trials("ball", make_cases("ball", 2, 0), made, {}, PHI))
    assert {"new", "newest", "mine"} <= {*rows["start"]}


def test_colours_differ_and_are_seen_on_white_and_on_dark():
    def light(colour: str) -> float:
        parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    every = [*(row.colour for row in STARTS.values()), *GIVEN_COLOURS]
    assert len({*every}) == len(every)
    for colour in every:
        assert 1.05 / (light(colour) + 0.05) >= 2.4, colour
        assert (light(colour) + 0.05) / (light("#15171a") + 0.05) >= 3.0, colour


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_the_learned_start_is_never_worse_than_the_paper_s(part):
    starts = {
        key: made for key, made in StartFactory(PHI).made().items() if key in ("linear_combination", "learned_fixed")
    }
    cases = [Case(grasp, load) for grasp in [presets.paper_cuboid()]
             for load in wrench.sample_magnitudes(np.random.default_rng([7, part]), 100_000, 1e-3, 1e3)]  # fmt: skip
    rows = table(trials("many", cases, starts, {}, PHI, solved=False))
    learned = numbers(chosen(rows, "start == 'learned_fixed'"), "start_excess")
    assert len(learned) == 100_000
    assert (learned <= 1e-10).all()
    assert LIMIT == 5000
