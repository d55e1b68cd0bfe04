"""Pages show the numbers of the table and need no other file."""

from __future__ import annotations

import re

import numpy as np
import pytest
from browser import browser, find_browser
from evaluation.compare.small_run import small_run

from grasp_env.errors import InvalidInputError
from training.evaluation.compare.scenarios import controllers_plan
from training.evaluation.report import holds_page, side_by_side, starts_page
from training.evaluation.report.page import claims_of, write
from training.evaluation.results.claims import judge
from training.evaluation.results.run import Run
from training.evaluation.results.table import chosen, join, numbers, pd, summary, table
from training.program.cli import main

EXECUTABLE = find_browser()


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """Made-up episodes of every scenario of `grasp evaluate env`, with their page."""
    folder = Run.create(tmp_path_factory.mktemp("runs"), "env")
    rng = np.random.default_rng(0)
    rows = []
    rates = {"paper": 0.97, "estimated": 0.9, "constant_squeeze": 0.6, "pd": 0.3}
    for scenario in controllers_plan(20):
        for seed in range(scenario.episodes):
            ok = bool(rng.random() < rates[scenario.keys["controller"]])
            rows.append(
                {
                    "case": scenario.case,
                    **scenario.keys,
                    "engine": "bullet",
                    "seed": seed,
                    "held": ok,
                    "failure": None if ok else "dropped",
                    "drift": 0.1 if ok else None,
                    "normal_force": 10.0,
                }
            )
    folder.save(table(rows), {"kind": "env", "quick": False, "settings": {"episodes": 20}})
    return folder, write(folder)[0].read_text()


def test_pages_need_no_other_file(held):
    folder = small_run().folder
    for page, quick in ((folder.path("report.html").read_text(), True), (held[1], False)):
        assert len(page) < 1_500_000
        assert 1 <= page.count("<figure") <= 10
        assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
        assert ("do not quote these numbers" in page) == quick


def test_tables_are_recomputed_from_the_rows():
    rows = small_run().folder.load()[0]
    # without the user's starts, which fail
    rows = rows[~rows["start"].isin(["sometimes", "outside"])]
    means = summary(rows)
    keys = starts_page.shown(summary(rows))
    cells = starts_page.all_starts(rows, means).set_index("start")
    (panel,) = starts_page.bars("iterations", "iterations")(rows, means).axes
    assert [tick.get_text() for tick in panel.get_yticklabels()] == [
        starts_page.start_info(key).short for key in keys
    ]
    flow = chosen(rows, "method == 'reduced_flow'")
    for key in ("linear_combination", "lagrange", "network"):
        ball = chosen(flow, f"case == 'ball' and start == '{key}'")
        for column, name in (("iterations", "flow"), ("start_gap", "start gap")):
            expected = np.percentile(numbers(ball, column), [50, 99])
            parts = cells.loc[starts_page.start_info(key).label, name].split(" / ")
            assert [float(part) for part in parts] == pytest.approx(expected, rel=5e-3)
            if column == "iterations" and key in keys:
                place = keys.index(key) - 0.2
                lines = [
                    line
                    for line in panel.lines
                    if len(line.get_xdata()) == 2 and line.get_ydata()[0] == place
                ]
                assert {tuple(line.get_xdata()) for line in lines} == {tuple(expected)}
    hard = starts_page.hardest_problems(rows, means)
    assert hard["iterations"].iloc[0] == flow[flow["start"].isin(keys)]["iterations"].max()
    assert hard["iterations"].is_monotonic_decreasing
    none = {
        "case": "ball",
        "start": "network",
        "method": "newton",
        "status": "no_start",
        "reason": "no feasible start",
    }
    broken = join([rows, table([none] * 3)])
    failures = starts_page.failures(broken, summary(broken)).query(
        "why == 'no feasible start' and start == 'network'"
    )
    assert failures["count"].tolist() == [3]


def test_claims_are_measured_and_can_be_missed(held, capsys):
    folder, text = held
    folder.path("report.html").unlink()
    assert main(["report", str(folder.folder)]) == 0
    assert "target" in capsys.readouterr().out
    assert folder.path("report.html").read_text() == text
    rows, about = small_run().folder.load()
    claims = judge(claims_of(about), summary(rows))
    verdicts = [row.met for row in claims]
    assert verdicts == sorted(verdicts, key=[False, None, True].index)
    assert {*starts_page.CLAIMS} <= {row.claim for row in claims if row.met is not None}
    means = summary(rows)
    worse = means.assign(
        iterations_median=means["iterations_median"].where(means["start"] != "network", 99.0)
    )
    assert [judge(starts_page.CLAIMS[:1], found)[0].met for found in (means, worse)] == [
        True,
        False,
    ]


def test_failures_are_counted_with_their_first_seed(held):
    rows = held[0].load()[0]
    lost = {
        "case": "objects",
        "controller": "pd",
        "held": False,
        "failure": "no_start",
        "seed": 77,
        "detail": "none",
    }
    more = join([rows, table([lost])])
    failures = holds_page.failures(more, summary(more))
    assert failures["count"].sum() == (numbers(more, "held") == 0.0).sum()
    found = failures[failures["failure"] == "no_start"][["count", "first seed", "detail"]]
    assert found.to_numpy().tolist() == [[1, 77, "none"]]


def test_any_table_gets_a_page(tmp_path):
    folder = Run.create(tmp_path, "other")
    folder.save(
        table([{"case": "a", "per_second": 2.0}, {"case": "a", "per_second": 4.0}]),
        {"kind": "something"},
    )
    assert "<td>3</td><td>4</td>" in write(folder)[0].read_text()  # median and maximum
    folder.path("rows.csv.xz").write_bytes(b"no table")
    with pytest.raises(InvalidInputError, match="is not a table of results"):
        write(folder)


def test_two_runs_are_compared_with_intervals(tmp_path, capsys):
    def rows(factor: float, rate: float) -> pd.DataFrame:
        rng = np.random.default_rng(1)
        return table(
            {
                "case": "ball",
                "problem": k,
                "held": bool(rng.random() < rate),
                "microseconds": factor * rng.uniform(3.0, 4.0),
            }
            for k in range(200)
        )

    for name, factor, rate in (("a", 1.0, 0.9), ("b", 1.2, 0.5), ("c", 1.0, 0.9)):
        Run.create(tmp_path, name).save(rows(factor, rate), {"kind": "starts"})
    a, b, c = (Run(tmp_path / name) for name in "abc")
    found = side_by_side.write(a, b, b).set_index("metric")
    for metric, verdict, change in (("microseconds", "higher", 1.2), ("held", "lower", -0.4)):
        assert found.loc[metric, "verdict"] == verdict
        assert found.loc[metric, "change"] == pytest.approx(change, abs=0.1)
    assert ((found["low"] <= found["change"]) & (found["change"] <= found["high"])).all()
    assert {*side_by_side.write(a, c, c)["verdict"]} == {"tie"}
    assert main(["report", "--compare", str(a.folder), str(b.folder)]) == 0
    assert "higher" in capsys.readouterr().out
    Run.create(tmp_path, "d").save(table([{"hand": "x", "seed": 1, "held": True}]), {"kind": "env"})
    for words, message in (
        (["--compare", str(a.folder), str(tmp_path / "d")], "compare runs of one command"),
        ([], "name one run's folder"),
        ([str(tmp_path / "nothing")], "is not a finished run"),
    ):
        assert main(["report", *words]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.skipif(EXECUTABLE is None, reason="no Chromium is installed")
def test_a_page_opens_from_disk():
    path = small_run().folder.path("report.html")
    with browser(EXECUTABLE or "") as tab:
        for size, scheme in (((390, 800), "light"), ((1280, 900), "dark")):
            tab.show(path, *size, prefers_color_scheme=scheme)
            assert tab.value("document.documentElement.scrollWidth") <= size[0]
            broken = tab.value(
                "Promise.all([...document.images].map(i => i.decode().then(() => !i.naturalWidth, () => true)))"
            )
            assert len(broken) >= 6
            assert not any(broken)
        assert {request for request in tab.requests if not request.startswith("data:")} == {
            path.as_uri()
        }
        assert tab.errors == []
