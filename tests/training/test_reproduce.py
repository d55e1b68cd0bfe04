"""What the paper leaves open: the rows are what solvers say one by one, the predictions hold, the folder is whole."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from grasp_env.force import ForceOptimizer
from grasp_env.force.step_size import AdaptiveStep, BarzilaiBorweinStep, FixedStep
from grasp_env.grasp import presets
from grasp_env.grasp.wrench import PAPER_CONSTANT, paper_path, sample_ball
from training import reproduce
from training.cli import main
from training.pyramids import pyramid_forces
from training.report import reproduce as page
from training.results import Run
from training.results.claims import judge
from training.results.table import chosen, summary

GRASP = presets.paper_cuboid()


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> SimpleNamespace:
    """The rows and files of a quick run of the command."""
    out = tmp_path_factory.mktemp("reproduce")
    assert main(["reproduce", "--quick", "--out", str(out)]) == 0
    (folder,) = out.iterdir()
    rows, about = Run.open(folder, "run.json").load()
    return SimpleNamespace(folder=folder, rows=rows, about=about, summary=summary(rows))


def test_a_quick_run_leaves_a_table_that_says_so(found):
    assert (found.about["kind"], found.about["quick"]) == ("reproduce", True)
    assert {"rows.parquet", "rows.csv", "run.json", "summary.csv", "report.html"} == {
        path.name for path in found.folder.iterdir()
    }
    assert set(found.rows["case"]) == {
        "weights", "times", "rates", "gaps", "forms", "costs_product", "costs_iteration", "path_paper_cuboid",
        "path_five_finger_cuboid", "table_one", "table_one_paper",
    }  # fmt: skip


def test_iterations_are_those_of_the_optimizer_with_these_weights(found):
    loads = sample_ball(np.random.default_rng([0, 101]), 20)
    weights = chosen(found.rows, "case == 'weights'")
    assert len(weights) == len(reproduce.WEIGHTS) * 8 * 20
    rules = {"adaptive": AdaptiveStep(), "bb_short": BarzilaiBorweinStep(variant="short")}
    for omega, barrier, rule in ((1.0, 0.001, "adaptive"), (2.0, 0.1, "bb_short")):
        phi = {"force_weight": omega, "barrier_weight": barrier}
        newton = ForceOptimizer(GRASP, method="newton", tolerance=1e-12, **phi)  # type: ignore[arg-type]
        flow = ForceOptimizer(GRASP, method="reduced_flow", step_rule=rules[rule], **phi)  # type: ignore[arg-type]
        mine = chosen(weights, f"rule == '{rule}' and force_weight == {omega} and barrier_weight == {barrier}")
        for k in (0, 11):
            best, row = newton.solve(loads[k]), mine.iloc[k]
            run = flow.solve(loads[k], optimum=best.objective)
            assert (row["iterations"], row["trials"], row["status"]) == (run.iterations, run.trials, "optimal")
            least = ForceOptimizer(GRASP, method="conic").solve(loads[k]).total_normal_force
            assert row["force_excess"] == pytest.approx(best.total_normal_force / least - 1.0, rel=1e-4)
    # more barrier squeezes more; the tuned step is never halved
    one = chosen(found.summary, "case == 'weights' and rule == 'fixed' and force_weight == 1")
    assert np.all(np.diff(one["force_excess_median"]) > 0.0)
    assert one["force_excess_median"].min() > 0.0
    fixed = chosen(weights, "rule == 'fixed'")
    assert fixed["iterations"].equals(fixed["trials"])
    assert fixed["step_size"].notna().all()


def test_tuned_step_is_nearly_the_longest():
    cases = reproduce.Cases(GRASP, sample_ball(np.random.default_rng(0), 8), 2.0, 0.1)
    size = cases.tuned_step()
    for factor, halved in ((1.0, False), (10.0**0.125, True)):
        records = cases.descents(FixedStep(factor * size))
        assert any(record[reproduce.ITERATIONS] != record[reproduce.TRIALS] for record in records) == halved


def test_rates_are_the_predicted_ones(found):
    rates = chosen(found.rows, "case == 'rates'").set_index("rule")
    fixed, exact = rates.loc["fixed"], rates.loc["exact"]
    assert fixed["rate"] == pytest.approx(fixed["rate_predicted"], rel=0.02)
    assert rates.loc["bb_short", "rate"] < exact["rate"] <= exact["rate_predicted"] * 1.01
    assert chosen(found.rows, "case == 'forms'")["form_difference"].max() < 1e-10
    gaps = chosen(found.rows, "case == 'gaps'")
    assert gaps.groupby("rule")["gap"].last().max() <= 1e-12
    assert gaps.groupby("rule")["step"].first().eq(0).all()


def test_operations_are_counted_per_form(found):
    costs = chosen(found.summary, "case == 'costs_product' and contacts == 4")
    assert costs[["form", "operations_max"]].to_numpy().tolist() == [["full", 20736], ["paper", 432], ["reduced", 144]]
    assert np.all(np.diff(costs["nanoseconds_median"]) < 0.0)
    iteration = chosen(found.summary, "case == 'costs_iteration' and contacts == 4 and form == 'reduced'")
    assert iteration["nanoseconds_median"].item() > costs["nanoseconds_median"].iloc[-1]


def test_path_rows_are_differences_of_forces_over_time(found):
    grasp, loads = presets.preset("five_finger_cuboid"), paper_path(np.array([0.2, 0.25, 0.3]))
    optimizer = ForceOptimizer(grasp, method="conic")
    forces = {
        "conic": [optimizer.solve(load).force for load in loads],
        "linear": [pyramid_forces(grasp, load) for load in loads],
    }
    for method, (first, second, third) in forces.items():
        row = chosen(found.rows, f"case == 'path_five_finger_cuboid' and method == '{method}' and interval == 0.05")
        row = row[np.isclose(row["time"], 0.3)]
        np.testing.assert_allclose(row["contact_force"], third[:, 0])
        np.testing.assert_allclose(row["jump"], np.linalg.norm(third - second, axis=1), atol=1e-9)
        kink = np.linalg.norm(third - 2.0 * second + first, axis=1) / 0.05
        np.testing.assert_allclose(row["kink"], kink, atol=1e-7)
    paths = chosen(found.summary, "interval == 0.005").set_index(["case", "method"])
    assert paths.loc[("path_paper_cuboid", "linear"), "force_excess_median"] > 0.0
    assert paths.xs("conic", level="method")["force_excess_max"].eq(0.0).all()


def test_table_one_balances_the_wrench_and_repeats_the_printed_numbers(found):
    wide = chosen(found.rows, "case in ('table_one', 'table_one_paper')").pivot(
        index=["case", "start"], columns="contact", values="contact_force"
    )
    balance = wide[0] - wide[1] - wide[2] - wide[3]
    np.testing.assert_allclose(balance.loc["table_one"], 0.6)
    np.testing.assert_allclose(balance.loc["table_one_paper"], 0.6, atol=0.011)
    assert wide.loc[("table_one_paper", "optimum")].tolist() == [3.25, 0.66, 0.79, 1.21]
    best = ForceOptimizer(GRASP, method="newton", tolerance=1e-12).solve(PAPER_CONSTANT)
    np.testing.assert_allclose(wide.loc[("table_one", "optimum")], best.force[:, 0], rtol=1e-6)
    flow = ForceOptimizer(GRASP, method="reduced_flow").solve(
        PAPER_CONSTANT, initial="single_value", optimum=best.objective
    )
    steps = chosen(found.rows, "contact == 0 and start == 'single_value'").set_index("case")
    assert steps["iterations"].to_dict() == {"table_one": flow.iterations, "table_one_paper": 160}
    assert steps.loc["table_one", "force_sum"] == pytest.approx(wide.loc[("table_one", "single_value")].sum())


def test_the_page_is_made_of_the_rows(found):
    tables = {title: function(found.rows, found.summary) for title, _, function in page.TABLES}
    assert [len(made) for made in tables.values()] == [len(reproduce.WEIGHTS), 8, 9, 8, 6]
    weights, rules, costs, paper, paths = tables.values()
    row = chosen(found.summary, "case == 'weights' and rule == 'adaptive' and force_weight == 0.5").iloc[0]
    told = weights.set_index(["force_weight", "barrier_weight"]).loc[(0.5, row["barrier_weight"]), "adaptive"]
    assert told == f"{row['iterations_median']:g} ({row['iterations_p95']:.3g})"
    assert rules["rule"].tolist() == list(page.RULES.values())
    assert (costs.set_index("form").loc["reduced", "times faster than full"] > 1.0).all()
    assert paper["case"].tolist() == ["ours", "paper"] * 4
    coarse, fine = (paths[f"change in {time} ms [N]"] for time in (50, 5))
    assert (coarse > fine).all()
    for title, _, function in page.FIGURES:
        figure = function(found.rows, found.summary)
        assert isinstance(figure, Figure), title
        assert all(axes.lines or not axes.get_visible() for axes in figure.axes), title
    slow = found.rows.assign(iterations=found.rows["iterations"].where(found.rows.index != 5))  # one never got there
    for rows, converged in ((found.rows, True), (slow, False)):
        judged = {row.claim.name: row.met for row in judge(page.CLAIMS, summary(rows))}
        assert [judged[claim.name] for claim in page.CLAIMS if "faster" not in claim.name] == [converged, True, True]
        assert None not in judged.values()
