"""The study of what the paper leaves open: rows, predictions, linear programs."""

from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from matplotlib.figure import Figure
from problems import CONIC_LEAST, GRASPS, PAPER_WRENCH

from grasp_env.errors import NotConvergedError
from grasp_env.force import ForceOptimizer, optimize_force
from grasp_env.force.step_size import AdaptiveStep, BarzilaiBorweinStep, FixedStep
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import PAPER_CONSTANT, paper_path, sample_ball
from training.evaluation.report import reproduce_page as page
from training.evaluation.reproduce import experiments
from training.evaluation.reproduce.pyramids import pyramid_forces
from training.evaluation.results import Run
from training.evaluation.results.claims import judge
from training.evaluation.results.table import chosen, summary
from training.program.cli import main

GRASP = presets.paper_cuboid()


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The rows of a quick run of the command with fewer weights."""
    out = tmp_path_factory.mktemp("reproduce")
    with patch.object(experiments, "WEIGHTS", ((1.0, 0.001), (1.0, 0.03), (1.0, 1.0), (2.0, 0.1))):
        assert main(["reproduce", "--quick", "--out", str(out)]) == 0
    (folder,) = out.iterdir()
    rows, about = Run.open(folder).load()
    assert (about["kind"], about["quick"]) == ("reproduce", True)
    assert folder.joinpath("report.html").is_file()
    return SimpleNamespace(rows=rows, summary=summary(rows))


def test_iterations_are_those_of_the_optimizer(found):
    loads = sample_ball(np.random.default_rng([0, 101]), 20)
    weights = chosen(found.rows, "case == 'weights'")
    assert len(weights) == 4 * 8 * 20
    rules = {"adaptive": AdaptiveStep(), "bb_short": BarzilaiBorweinStep(variant="short")}
    for omega, barrier, rule in ((1.0, 0.001, "adaptive"), (2.0, 0.1, "bb_short")):
        phi = {"force_weight": omega, "barrier_weight": barrier}
        newton = ForceOptimizer(GRASP, method="newton", tolerance=1e-12, **phi)
        flow = ForceOptimizer(GRASP, method="reduced_flow", step_rule=rules[rule], **phi)
        mine = chosen(
            weights, f"rule == '{rule}' and force_weight == {omega} and barrier_weight == {barrier}"
        )
        for k in (0, 11):
            best = newton.solve(loads[k])
            row = mine.iloc[k]
            run = flow.solve(loads[k], optimum=best.objective)
            assert row["status"] == "optimal"
            assert (row["iterations"], row["trials"]) == (run.iterations, run.trials)
            least = ForceOptimizer(GRASP, method="conic").solve(loads[k]).total_normal_force
            assert row["force_excess"] == pytest.approx(
                best.total_normal_force / least - 1.0, rel=1e-4
            )
    one = chosen(found.summary, "case == 'weights' and rule == 'fixed' and force_weight == 1")
    # more barrier squeezes more
    assert np.all(np.diff(one["force_excess_median"], prepend=0.0) > 0.0)
    fixed = chosen(weights, "rule == 'fixed'")
    assert fixed["iterations"].equals(fixed["trials"])  # the tuned step is never halved
    cases = experiments.Cases(GRASP, sample_ball(np.random.default_rng(0), 8), 2.0, 0.1)
    size = cases.tuned_step()
    for factor, halved in ((1.0, False), (10.0**0.125, True)):
        records = cases.descents(FixedStep(factor * size))
        assert (
            any(record[experiments.ITERATIONS] != record[experiments.TRIALS] for record in records)
            == halved
        )


def test_rates_are_the_predicted_ones(found):
    rates = chosen(found.rows, "case == 'rates'").set_index("rule")
    fixed = rates.loc["fixed"]
    exact = rates.loc["exact"]
    assert fixed["rate"] == pytest.approx(fixed["rate_predicted"], rel=0.02)
    assert rates.loc["bb_short", "rate"] < exact["rate"] <= exact["rate_predicted"] * 1.01
    assert chosen(found.rows, "case == 'gaps'").groupby("rule")["gap"].last().max() <= 1e-12
    costs = chosen(found.summary, "case == 'costs_product' and contacts == 4")
    assert costs[["form", "operations_max"]].to_numpy().tolist() == [
        ["full", 20736],
        ["paper", 432],
        ["reduced", 144],
    ]


def test_repetitions_are_timed_without_overhead(monkeypatch):
    now = [0]
    monkeypatch.setattr(experiments.time, "perf_counter_ns", lambda: now[0])
    assert (
        experiments._time_repetition(lambda count: now.__setitem__(0, now[0] + 100 + 7 * count), 10)
        == 7.0
    )


def test_path_rows_are_differences(found):
    grasp = presets.preset("five_finger_cuboid")
    loads = paper_path(np.array([0.2, 0.25, 0.3]))
    conic = ForceOptimizer(grasp, method="conic")
    solvers = {
        "conic": lambda load: conic.solve(load).force,
        "linear": lambda load: pyramid_forces(grasp, load),
    }
    for method, solve in solvers.items():
        first, second, third = map(solve, loads)
        row = chosen(
            found.rows,
            f"case == 'path_five_finger_cuboid' and method == '{method}' and interval == 0.05",
        )
        row = row[np.isclose(row["time"], 0.3)]
        np.testing.assert_allclose(row["contact_force"], third[:, 0])
        np.testing.assert_allclose(row["jump"], np.linalg.norm(third - second, axis=1), atol=1e-9)
        kink = np.linalg.norm(third - 2.0 * second + first, axis=1) / 0.05
        np.testing.assert_allclose(row["kink"], kink, atol=1e-7)
    paths = chosen(found.summary, "interval == 0.005").set_index(["case", "method"])
    assert paths.loc[("path_paper_cuboid", "linear"), "force_excess_median"] > 0.0
    assert paths.xs("conic", level="method")["force_excess_max"].eq(0.0).all()


def test_table_one_balances_the_wrench(found):
    rows = chosen(found.rows, "case in ('table_one', 'table_one_paper')")
    wide = rows.pivot(index=["case", "start"], columns="contact", values="contact_force")
    balance = wide[0] - wide[1] - wide[2] - wide[3]
    np.testing.assert_allclose(balance.loc["table_one"], 0.6)
    np.testing.assert_allclose(balance.loc["table_one_paper"], 0.6, atol=0.011)
    best = ForceOptimizer(GRASP, method="newton", tolerance=1e-12).solve(PAPER_CONSTANT)
    np.testing.assert_allclose(wide.loc[("table_one", "optimum")], best.force[:, 0], rtol=1e-6)
    flow = ForceOptimizer(GRASP, method="reduced_flow")
    run = flow.solve(PAPER_CONSTANT, initial="single_value", optimum=best.objective)
    steps = chosen(rows, "contact == 0 and start == 'single_value'").set_index("case")["iterations"]
    assert steps.to_dict() == {"table_one": run.iterations, "table_one_paper": 160}


def test_the_page_is_made_of_the_rows(found):
    tables = [function(found.rows, found.summary) for _, _, function in page.TABLES]
    assert [len(made) for made in tables] == [4, 8, 9, 8, 6]
    for title, _, function in page.FIGURES:
        figure = function(found.rows, found.summary)
        assert isinstance(figure, Figure), title
        assert all(axes.lines or not axes.get_visible() for axes in figure.axes), title
    # one never converged
    slow = found.rows.assign(iterations=found.rows["iterations"].where(found.rows.index != 5))
    for rows, converged in ((found.rows, True), (slow, False)):
        judged = {row.claim.name: row.met for row in judge(page.CLAIMS, summary(rows))}
        assert [judged[claim.name] for claim in page.CLAIMS if "faster" not in claim.name] == [
            converged,
            True,
            True,
        ]


def by_enumeration(grasp: Grasp, wrench: np.ndarray, facets: int) -> float:
    """Least sum of normals over all bases of six edges: an optimum of a linear program is at one of
    them."""
    angles = 2.0 * np.pi * np.arange(facets) / facets
    edges = [
        np.stack([np.ones(facets), mu * np.cos(angles), mu * np.sin(angles)])
        for mu in grasp.friction
    ]
    columns = np.concatenate(
        [grasp.matrix[:, 3 * k : 3 * k + 3] @ edge for k, edge in enumerate(edges)], axis=1
    )
    columns[3:] /= 0.05
    right = -wrench / [1, 1, 1, 0.05, 0.05, 0.05]
    matrices = columns[:, np.array(list(combinations(range(columns.shape[1]), 6)))].transpose(
        1, 0, 2
    )
    regular = matrices[np.abs(np.linalg.det(matrices)) > 1e-9]
    weights = np.linalg.solve(regular, np.broadcast_to(right[:, None], (len(regular), 6, 1)))[
        ..., 0
    ]
    return float(weights[(weights >= -1e-9).all(axis=1)].sum(axis=1).min(initial=np.inf))


@pytest.mark.parametrize(
    ("name", "facets"), [("tripod", 8), ("tripod, uneven", 5), ("cuboid, 4", 4)]
)
def test_no_vertex_of_the_linear_program_is_better(name, facets):
    grasp = GRASPS[name]
    for wrench in sample_ball(np.random.default_rng(0), 3):
        force = pyramid_forces(grasp, wrench, facets)
        assert force[:, 0].sum() == pytest.approx(by_enumeration(grasp, wrench, facets), rel=1e-8)
        assert grasp.residual(force, wrench) < 1e-9
        assert grasp.cone_margin(force) > -1e-9


def test_forces_of_pyramids_jump():
    costs = [pyramid_forces(GRASP, PAPER_WRENCH, n)[:, 0].sum() for n in (4, 8, 16, 32, 256)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == pytest.approx(CONIC_LEAST, rel=1e-4)
    # four fingers around an object carry its weight by friction: either pair costs the same
    positions = np.repeat(0.04 * np.eye(3)[:2], 2, axis=0)
    weight = np.array([0, 0, -1.0, 0, 0, 0])
    positions[1::2] *= -1.0
    signs = np.array([1.0, 1.0, -1.0, -1.0])
    one, other = (
        Grasp.from_contacts(positions, -positions / 0.04, 0.5 + s * 1e-6 * signs)
        for s in (1.0, -1.0)
    )
    assert np.abs(pyramid_forces(one, weight) - pyramid_forces(other, weight)).max() > 0.9
    smooth = [
        optimize_force(grasp, weight, method="newton", tolerance=1e-10).force
        for grasp in (one, other)
    ]
    assert np.abs(smooth[0] - smooth[1]).max() < 1e-3
    floor = Grasp.from_contacts(0.03 * np.eye(3), [[0.0, 0.0, 1.0]] * 3, 0.4)
    with pytest.raises(NotConvergedError, match="found no force"):
        pyramid_forces(floor, np.array([0, 0, 2.0, 0, 0, 0]))
