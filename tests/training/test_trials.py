"""Trials say what the solvers did; starts are what they claim; nothing that fails is dropped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from grasp_env.errors import InfeasibleStartError, InvalidInputError
from grasp_env.force import ForceOptimizer, Objective, OfflineBasis, Status
from grasp_env.grasp import presets, wrench
from policies import LearnedInitialForce
from training.cases.sets import fixed_cases
from training.cases.start_table import LEARNED, SHIPPED, STARTS, How, Row, Stepped, check
from training.cases.starts import BUILDERS, DoesNotApply, load_models, make_starts, near_fixed
from training.runs.statistics import spread
from training.trials.arrays import BUDGETS, LEVELS, LIMIT, METHODS, STATUS, starts_in, worse
from training.trials.compare import cases_of, compare
from training.trials.continuity import POINTS, continuity
from training.trials.guarantee import guarantee, never_worse, values
from training.trials.metrics import censored, start_metrics
from training.trials.timing import optimizers, time_calls

PHI = Objective()


@pytest.fixture(scope="module")
def models():
    return load_models()


@pytest.fixture(scope="module")
def starts(models):
    return make_starts(PHI, models)


@pytest.fixture(scope="module")
def ball(models, starts):
    cases = cases_of("ball", 12, 0)
    return cases, compare("ball", cases, starts, models, PHI)


def test_all_starts_are_there(ball, starts):
    assert set(starts_in(ball[1])) == set(starts) == set(STARTS)
    assert set(BUILDERS) == set(How.__args__)


def test_a_row_is_all_that_a_start_needs(monkeypatch, models):
    """It is tried, timed and drawn; a row that is not whole is refused when the table is read."""
    row = Row("three corrections", "three", ("#101010", "#e0e0e0"), Stepped("lagrange", 3))
    check({**STARTS, "new": row})
    monkeypatch.setitem(STARTS, "new", row)
    starts = make_starts(PHI, models)
    cases = cases_of("ball", 2, 0)
    trials = compare("ball", cases, {"new": starts["new"]}, models, PHI)
    assert start_metrics(trials, "reduced_flow")["new"]["cases"] == 2
    loop = optimizers(presets.paper_cuboid(), "newton", {"new": starts["new"]}, PHI)["new"]
    expected = starts["new"](presets.paper_cuboid(), cases[0].wrench, None)
    np.testing.assert_allclose(loop.solve(cases[0].wrench).initial_force, expected, atol=1e-9)
    grey = STARTS["lagrange"].colours
    for wrong, message in (
        (replace(row, label=""), "needs a label"),
        (replace(row, short=""), "needs a label"),
        (replace(row, colours=("#101010", grey[1])), "colours #rrggbb that no other has"),
        (replace(row, colours=("#101010", "")), "two colours"),
        (replace(row, how=Stepped("nobody", 3)), "made of nobody"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            check({**STARTS, "new": wrong})


@pytest.mark.parametrize("key", STARTS)
def test_a_starts_colours_are_seen_on_both_pages(key):
    def light(colour: str) -> float:
        parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    on_white, on_dark = STARTS[key].colours
    assert 1.05 / (light(on_white) + 0.05) >= 2.9  # WCAG asks 3 of graphics
    assert (light(on_dark) + 0.05) / (light("#15171a") + 0.05) >= 3.0


def test_trials_agree_with_single_runs(ball, starts):
    cases, trials = ball
    for key in ("linear_combination", "basis_tangent", "previous_tangent", "learned_fixed"):
        for k in (1, 5):
            before = trials["case/before"][k]
            force = starts[key](cases[k].grasp, cases[k].wrench, before)
            best = trials["optimum/objective"][k]
            value = PHI.value(cases[k].grasp.to_cone(force))
            assert trials[f"{key}/gap"][k] == pytest.approx(max(0.0, value / best - 1.0), abs=1e-12)
            for method in METHODS:
                solution = ForceOptimizer(cases[k].grasp, method=method).solve(
                    cases[k].wrench, initial=force, optimum=best
                )
                assert trials[f"{method}/{key}/iterations"][k] == solution.iterations
                assert trials[f"{method}/{key}/status"][k] == STATUS.index(solution.status.value)


def test_levels_and_budgets_agree(ball, starts):
    for method in METHODS:
        for key in starts:
            first = ball[1][f"{method}/{key}/iterations_to"]
            after = ball[1][f"{method}/{key}/gap_after"]
            exists = ball[1][f"{method}/{key}/status"] < 3
            assert (np.diff(first[exists], axis=1) >= 0).all()
            assert (np.diff(after[exists], axis=1) <= 0.0).all()
            for level, steps in zip(LEVELS[method], first[exists].T, strict=True):
                for budget, gap in zip(BUDGETS, after[exists].T, strict=True):
                    assert ((steps <= budget) == (gap <= level)).all()
            trace = ball[1][f"reduced_flow/{key}/trace"]
            assert (np.diff(trace[exists], axis=1) <= 1e-7).all()


def test_optima_are_optima(ball):
    cases, trials = ball
    for k, case in enumerate(cases):
        exact = ForceOptimizer(case.grasp, method="newton", tolerance=1e-10).solve(case.wrench)
        np.testing.assert_allclose(trials["optimum/force"][k], exact.force, atol=1e-6)
        assert exact.objective == pytest.approx(trials["optimum/objective"][k], rel=2e-10)


def test_starts_are_feasible_and_balanced(ball, starts):
    for key in starts:
        exists = np.isfinite(ball[1][f"{key}/gap"])
        assert exists.any()
        assert (ball[1][f"{key}/margin"][exists] > 0.0).all()
        assert (ball[1][f"{key}/residual"][exists] < 1e-9).all()


def test_corrected_starts_are_no_worse_than_what_they_correct(ball):
    trials = ball[1]
    for one, other in (
        ("basis_tangent", "linear_combination"),
        ("basis_newton", "basis_tangent"),
        ("learned_previous", "linear_combination"),
        ("learned_previous", "previous_tangent"),
        ("learned_fixed", "linear_combination"),
        ("nearest_tangent", "linear_combination"),
    ):
        both = np.isfinite(trials[f"{one}/gap"]) & np.isfinite(trials[f"{other}/gap"])
        assert both.any()
        assert (trials[f"{one}/gap"][both] <= trials[f"{other}/gap"][both] + 1e-12).all()


def test_the_first_case_has_no_previous_solution(ball):
    assert ball[1]["reduced_flow/previous_tangent/status"].tolist() == [4] + [0] * 11
    assert np.isnan(ball[1]["case/before"][0]).all()
    row = start_metrics(ball[1], "reduced_flow")["previous_tangent"]
    assert (row["cases"], row["not_applicable"], row["no_start"]) == (11, 1, 0)


def test_what_does_not_apply_is_counted(models, starts):
    cases = cases_of("random_5", 5, 0)
    trials = compare("random_5", cases, starts, models, PHI)
    rows = start_metrics(trials, "reduced_flow")
    for key in ("learned_fixed", "nearest_tangent", "previous_tangent"):
        assert (rows[key]["cases"], rows[key]["not_applicable"]) == (0, len(cases))
    assert rows["linear_combination"]["cases"] == len(cases)
    with pytest.raises(DoesNotApply):
        starts["nearest_tangent"](cases[0].grasp, cases[0].wrench, None)


def test_a_missing_start_is_counted(models, starts):
    def never(grasp, load, before):
        raise InfeasibleStartError("none")

    trials = compare("ball", cases_of("ball", 3, 0), {**starts, "lagrange": never}, models, PHI)
    row = start_metrics(trials, "newton")["lagrange"]
    assert (row["cases"], row["no_start"], row["iterations"]["n"]) == (3, 3, 0)


def test_previous_is_exact_where_nothing_changed(models, starts):
    grasp, load = presets.paper_cuboid(), np.array(wrench.PAPER_CONSTANT)
    best = ForceOptimizer(grasp, method="newton", tolerance=1e-10).solve(load)
    for key in ("previous_tangent", "previous_pseudoinverse"):
        np.testing.assert_allclose(starts[key](grasp, load, best.force), best.force, atol=1e-6)


def test_near_fixed():
    assert near_fixed(presets.paper_cuboid(0.7))
    assert not near_fixed(presets.five_finger_cuboid())


def test_whole_calls_start_where_the_starts_say(starts):
    """What is timed is what is compared; a compiled model may leave out layers that its certificate does not ask for."""
    grasp, (first, second) = presets.paper_cuboid(), wrench.sample_ball(np.random.default_rng(5), 2)
    paper = PHI.value(grasp.to_cone(starts["linear_combination"](grasp, second, None)))
    for key, loop in optimizers(grasp, "reduced_flow", starts, PHI).items():
        before = loop.solve(first).force
        solution = loop.solve(second)
        assert solution.status is Status.OPTIMAL
        if key in LEARNED:
            assert PHI.value(grasp.to_cone(solution.initial_force)) <= paper * (1.0 + 1e-12)
        else:
            np.testing.assert_allclose(
                solution.initial_force, starts[key](grasp, second, before), atol=1e-9, err_msg=key
            )


def test_what_is_called_compiled_is(starts):
    for method in METHODS:
        for key, loop in optimizers(presets.paper_cuboid(), method, starts, PHI).items():
            assert (loop._loop is not None) == STARTS[key].compiled, (method, key)


def test_timing(models):
    times = time_calls(wrench.sample_ball(np.random.default_rng(0), 6), models, PHI, 2)
    assert times["reduced_flow/linear_combination/total_us"].shape == (2, 6)
    assert times["learned_fixed/start_us"].shape == (2, 6)
    assert all((array[np.isfinite(array)] > 0.0).all() for array in times.values())


def test_continuity(starts):
    chosen = {key: starts[key] for key in ("linear_combination", "nearest_tangent", "previous_tangent")}
    paths = continuity(chosen, PHI, 1, 0)
    assert (np.sign(paths["path/wrench"][0, 0]) == -np.sign(paths["path/wrench"][0, -1])).all()
    assert paths["optimum/slope"].shape == (1, POINTS - 1)
    kink = {key: paths[f"{key}/kink"].max() for key in ("optimum", *chosen)}
    assert kink["linear_combination"] > 10.0 * kink["optimum"]  # where a component changes its sign
    assert paths["nearest_tangent/jump"][0] > 100.0 * paths["linear_combination/jump"][0]  # another stored solution


def test_never_worse_in_small(models):
    counted = guarantee(models, 300, 0)
    for name, array in counted.items():
        if name.endswith("excess"):
            assert not worse(array).any(), name
        else:
            assert array.min() < 0.1
            assert array.max() > 10.0


def test_never_worse_can_fail():
    def squeezing(grasp, load):
        return 2.0 * OfflineBasis.of(grasp, PHI).rest + OfflineBasis.of(grasp, PHI).combine(load)

    excess, _ = never_worse(squeezing, presets.tripod(), 50, 0)
    assert worse(excess).all()
    assert worse(np.array([np.inf, np.nan])).all()


def test_phi_of_many_forces():
    grasp = presets.tripod()
    forces = np.stack([OfflineBasis.of(grasp, PHI).combine(w) for w in wrench.sample_ball(np.random.default_rng(0), 5)])
    expected = [PHI.value(grasp.to_cone(force)) for force in forces]
    np.testing.assert_allclose(values(grasp, forces, PHI), expected, rtol=1e-12)
    assert np.isinf(values(grasp, -forces, PHI)).all()


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
@pytest.mark.parametrize("key", SHIPPED)
def test_never_worse_on_a_million_wrenches(models, key, part):
    excess, _ = never_worse(models[key], presets.paper_cuboid(), 100_000, [7, part])
    assert not worse(excess).any()


def test_spread_and_censoring():
    row = spread(censored(np.array([0, 2, 4, -1])))
    assert (row["n"], row["median"], row["max"]) == (4, 3.0, LIMIT + 1)
    assert spread(np.empty(0))["median"] is None
    rng = np.random.default_rng(0)
    inside = [
        row["median_low"] <= 0.0 <= row["median_high"] for row in (spread(rng.standard_normal(60)) for _ in range(400))
    ]
    assert 0.92 <= np.mean(inside) <= 0.99


def test_a_model_of_its_own_grasp_is_never_asked_elsewhere(starts):
    assert isinstance(load_models()["learned_fixed"], LearnedInitialForce)
    case = fixed_cases("constant", 1, 0)[0]
    assert starts["learned_fixed"](case.grasp, case.wrench, None).shape == (4, 3)
    with pytest.raises(DoesNotApply):
        starts["learned_fixed"](presets.tripod(), case.wrench, None)
