"""Pages say what the table says, are small, need nothing else, and read well in a browser, wide and narrow."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import Browser, browser, find_browser
from compare.test_comparison import SMALL

from grasp_env.errors import InvalidInputError
from training.cli import main
from training.compare.comparison import run as compare_starts
from training.compare.scenarios import CONTROLLERS, LABELS, controllers_plan
from training.report import holds, side_by_side, starts
from training.report import page as page_module
from training.report.page import WIDTH, write
from training.results.run import Run
from training.results.table import chosen, join, numbers, pd, read, summary, table

EXECUTABLE = find_browser()
needs_browser = pytest.mark.skipif(EXECUTABLE is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small run of the comparison of starts, with its page."""
    folder = Run.create(tmp_path_factory.mktemp("runs"), "small")
    rows, about = compare_starts(SMALL, on="inline")
    folder.save(rows, {**about, "quick": True})
    return folder, write(folder).path.read_text()


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """Made-up episodes of every scenario of `grasp evaluate env`, with their page."""
    folder, rng, rows = Run.create(tmp_path_factory.mktemp("runs"), "env"), np.random.default_rng(0), []
    rates = {"paper": 0.97, "estimated": 0.9, "constant_squeeze": 0.6, "pd": 0.3}
    for scenario in controllers_plan(40):
        for seed in range(scenario.episodes):
            ok = bool(rng.random() < rates[scenario.keys["controller"]])
            rows.append({
                "case": scenario.case, **scenario.keys, "engine": "bullet", "seed": seed, "held": ok,
                "failure": None if ok else "dropped", "drift": 0.1 if ok else None,
                "normal_force": 10.0 / scenario.keys.get("friction_margin", 1.0) + scenario.keys.get("squeeze", 0.0),
            })  # fmt: skip
    folder.save(table(rows), {"kind": "env", "quick": False, "settings": {"episodes": 40}})
    return folder, write(folder).path.read_text()


class Text(HTMLParser):
    """The words that a reader sees, and the tables as lists of cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.tables: list[list[list[str]]] = []
        self._hidden, self._cell = False, False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._hidden = tag in ("style", "title")
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self._cell = True

    def handle_endtag(self, tag):
        self._hidden = False
        if tag in ("td", "th"):
            self._cell = False

    def handle_data(self, data):
        if not self._hidden:
            self.words += data.split()
        if self._cell:
            self.tables[-1][-1][-1] += data


@pytest.mark.parametrize("which", ["made", "held"])
def test_the_page_is_small_and_needs_nothing_else(which, request):
    folder, text = request.getfixturevalue(which)
    seen = Text(text)
    assert len(text) < 1_500_000
    assert len(seen.words) <= 4000
    assert len(seen.tables) <= 10
    assert 2 <= text.count("<figure") <= 10
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", text)
    assert all(len(row) == len(rows[0]) for rows in seen.tables for row in rows)
    assert folder.path("summary.csv").stat().st_size > 100
    words = " ".join(seen.words)
    assert 'rows = pandas.read_parquet("rows.parquet")' in words
    assert "The words are defined at the end of this page" in words
    assert ("do not quote these numbers" in words) == (which == "made")


def test_three_lines_load_the_table(made, monkeypatch):
    folder, text = made
    monkeypatch.chdir(folder.folder)
    code = html.unescape(re.search(r"<pre><code>(.*?)</code>", text, re.DOTALL)[1])
    assert len(code.splitlines()) == 3
    names: dict = {}
    exec(code, names)
    assert names["rows"].equals(folder.load()[0])


def test_cells_are_what_numpy_makes_of_the_rows(made):
    folder, text = made
    rows, seen = folder.load()[0], Text(text)
    (found,) = [table for table in seen.tables if table[0][:3] == ["start", "no start", "replaced"]]
    shown = {row[0]: dict(zip(found[0], row, strict=True)) for row in found[1:]}
    for key in ("linear_combination", "lagrange", "network"):
        ball = rows[(rows["case"] == "ball") & (rows["start"] == key) & (rows["method"] == "reduced_flow")]
        steps = ball["iterations"].to_numpy(float)
        cell = shown[starts.start_info(key).label]["flow"]
        assert [float(part) for part in cell.split(" / ")] == pytest.approx(
            [np.median(steps), np.percentile(steps, 99)], rel=5e-3
        )
        gaps = ball["start_gap"].to_numpy(float)
        told = [float(part) for part in shown[starts.start_info(key).label]["start gap"].split(" / ")]
        assert told == pytest.approx([np.median(gaps), np.percentile(gaps, 99)], rel=5e-3)


def test_claims_are_told_missed_ones_first_and_can_be_met_and_missed(made):
    folder, text = made
    claims = write(folder).claims
    (told,) = [table for table in Text(text).tables if table[0][0] == "claim"]
    assert [row[0] for row in told[1:]] == [row.claim.name for row in claims]
    assert [row.met for row in claims] == sorted((row.met for row in claims), key=[False, None, True].index)
    means = summary(folder.load()[0])
    worse = means.assign(iterations_median=means["iterations_median"].where(means["start"] != "network", 99.0))
    name = "network alone: median of the flow's iterations, friction varied"
    for found, met in ((means, True), (worse, False)):
        (row,) = [row for row in page_module.judge(starts.CLAIMS, found) if row.claim.name == name]
        assert row.met is met
    every = {claim.name for claim in starts.CLAIMS}
    measured = {row.claim.name for row in claims if row.met is not None}
    assert measured == every


def test_the_hardest_come_first_and_failures_are_counted(made):
    folder, _ = made
    rows, means = folder.load()[0], summary(folder.load()[0])
    hard = starts.hardest_problems(rows, means)
    assert len(hard) == 12
    flow = chosen(rows, "method == 'reduced_flow'")
    flow = flow[flow["start"].isin(starts.shown(means))]
    assert hard["iterations"].iloc[0] == flow["iterations"].max()
    assert hard["iterations"].is_monotonic_decreasing
    broken = join(
        [
            rows,
            table(
                [{"case": "ball", "start": "network", "method": "newton", "status": "no_start", "reason": "has none"}]
                * 3
            ),
        ]
    )
    assert starts.failures(broken, summary(broken)).query("why == 'has none' and start == 'network'")[
        "count"
    ].tolist() == [3]


def test_hold_rates_show_every_scenario_and_the_chosen_setting(held):
    folder, text = held
    rows, seen = folder.load()[0], Text(text)
    (rates,) = [table for table in seen.tables if table[0][:2] == ["scenario", "with"]]
    assert len(rates) - 1 == min(40, len(summary(rows)))
    means = page_module.module_of({"kind": "env"}).derive(summary(rows))
    picked = means[means["chosen"]]
    assert {(row["case"], row["controller"]) for row in picked.to_dict("records")} == {
        (case, key) for case in ("mild", "all") for key in CONTROLLERS if key != "estimated"
    }
    for (case, key), curve in means[means["case"].isin(["mild", "all"])].groupby(["case", "controller"]):
        best = picked[(picked["case"] == case) & (picked["controller"] == key)].iloc[0]
        assert best["held_mean"] == curve["held_mean"].max() or best["held_mean"] >= 0.99
    more = join(
        [
            rows,
            table(
                [
                    {
                        "case": "objects",
                        "controller": "pd",
                        "held": False,
                        "failure": "no_start",
                        "seed": 77,
                        "detail": "no grasp",
                    }
                ]
            ),
        ]
    )
    failures = holds.failures(more, means)
    assert failures["count"].sum() == (more["held"] == False).sum()  # noqa: E712
    assert failures[failures["failure"] == "no_start"][["count", "first seed", "detail"]].to_numpy().tolist() == [
        [1, 77, "no grasp"]
    ]
    assert {row.claim.name: row.met for row in write(folder).claims}[
        "the paper's pipeline holds random objects in six directions"
    ] is not None
    assert set(means["case"]) <= {*LABELS}


def test_any_table_gets_a_page(tmp_path):
    folder = Run.create(tmp_path, "other")
    folder.save(table([{"case": "a", "per_second": 2.0}, {"case": "a", "per_second": 4.0}]), {"kind": "something"})
    text = write(folder).path.read_text()
    (found,) = Text(text).tables
    assert dict(zip(*found, strict=True)) == {"case": "a", "n": "2", "per_second_median": "3", "per_second_max": "4"}
    assert "per_second" in text
    assert write(folder).claims == []


def test_a_run_whose_files_were_changed_is_refused(tmp_path):
    folder = Run.create(tmp_path, "x")
    folder.write_json("run.json", {"kind": "starts"})
    with pytest.raises(InvalidInputError, match=r"cannot read the table .*rows.parquet"):
        write(folder)
    folder.path("rows.parquet").write_bytes(b"no table")
    with pytest.raises(InvalidInputError, match="is not a table of results"):
        write(folder)
    assert not folder.path("report.html").exists()


def test_two_runs_side_by_side(tmp_path, capsys):
    def rows(factor: float, rate: float) -> pd.DataFrame:
        rng = np.random.default_rng(1)
        return table([
            {"case": "ball", "method": method, "problem": k, "iterations": int(rng.integers(20, 60)), "held": bool(rng.random() < rate),
             "microseconds": (factor if method == "flow" else 1.0) * rng.uniform(3.0, 4.0)}
            for method in ("flow", "newton") for k in range(200)
        ])  # fmt: skip

    for name, factor, rate in (("a", 1.0, 0.9), ("b", 1.2, 0.5), ("c", 1.0, 0.9)):
        Run.create(tmp_path, name).save(rows(factor, rate), {"kind": "starts"})
    a, b, c = (Run(tmp_path / name) for name in "abc")
    found = side_by_side.write(a, b, b).set_index(["method", "metric"])
    assert found.loc[("flow", "microseconds"), "verdict"] == "higher"
    assert found.loc[("flow", "microseconds"), "change"] == pytest.approx(1.2, rel=0.03)
    assert found.loc[("newton", "microseconds"), "verdict"] == "tie"
    assert found.loc[("flow", "held"), "verdict"] == "lower"
    assert found.loc[("flow", "held"), "change"] == pytest.approx(-0.4, abs=0.1)
    assert (found["low"] <= found["change"]).all()
    assert (found["change"] <= found["high"]).all()
    assert {*side_by_side.write(a, c, c)["verdict"]} == {"tie"}
    assert main(["report", "--compare", str(a.folder), str(b.folder)]) == 0
    assert "higher" in capsys.readouterr().out
    assert "are ties" in b.path("compare.html").read_text()
    Run.create(tmp_path, "d").save(table([{"hand": "x", "seed": 1, "held": True}]), {"kind": "env"})
    assert main(["report", "--compare", str(a.folder), str(tmp_path / "d")]) == 2
    assert "compare runs of one command" in capsys.readouterr().err
    assert main(["report"]) == 2
    assert "name one run's folder" in capsys.readouterr().err


def test_the_command_makes_the_page_again(made, capsys):
    folder, text = made
    folder.path("report.html").unlink()
    assert main(["report", str(folder.folder)]) == 0
    assert folder.path("report.html").read_text() == text
    assert "asked" in capsys.readouterr().out
    assert main(["report", str(folder.folder / "nothing")]) == 2
    assert "is not a finished run" in capsys.readouterr().err


def test_the_charts_show_every_main_start_at_its_numbers(made):
    folder, _ = made
    rows, means = folder.load()[0], summary(folder.load()[0])
    figure = starts.bars("iterations", "iterations")(rows, means)
    assert figure.get_figwidth() == WIDTH
    (panel,) = figure.axes
    labels = [tick.get_text() for tick in panel.get_yticklabels()]
    assert labels == [starts.start_info(key).short for key in starts.shown(means)]
    flow = chosen(means, "case == 'ball' and method == 'reduced_flow'").set_index("start")
    for place, key in enumerate(starts.shown(means)):
        ends = {
            tuple(line.get_xdata())
            for line in panel.lines
            if len(line.get_xdata()) == 2 and line.get_ydata()[0] == place - 0.2
        }
        assert ends == {(flow.loc[key, "iterations_median"], flow.loc[key, "iterations_p99"])}
    steps = np.sort(
        numbers(chosen(rows, "case == 'ball' and start == 'network' and method == 'reduced_flow'"), "iterations")
    )
    (panel,) = starts.network_figure(rows, means).axes
    line = next(line for line in panel.lines if line.get_label() == "network alone")
    assert line.get_xdata().tolist() == (1 + steps).tolist()
    assert line.get_ydata()[-1] == 1.0


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    assert EXECUTABLE is not None
    try:
        opened = browser(EXECUTABLE)
        tab = opened.__enter__()
    except (RuntimeError, TimeoutError, OSError) as error:
        pytest.skip(f"{EXECUTABLE} does not start here: {error}")
    yield tab
    opened.__exit__(None, None, None)


LUMINANCE = """(text, back) => { const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).map(Number).map(v => v / 255)
  .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b }
  const [a, b] = [light(text), light(back)].sort((x, y) => y - x); return (a + 0.05) / (b + 0.05) }"""


@needs_browser
@pytest.mark.parametrize("size", [(390, 800), (1280, 900)])
@pytest.mark.parametrize(("scheme", "background"), [("light", "rgb(255, 255, 255)"), ("dark", "rgb(21, 23, 26)")])
def test_it_opens_from_disk_without_requests_errors_or_overflow(chromium, made, size, scheme, background):
    path = made[0].path("report.html")
    chromium.requests.clear()
    chromium.errors.clear()
    chromium.show(path, *size, prefers_color_scheme=scheme)
    assert chromium.value("innerWidth") == size[0]
    assert chromium.value("document.documentElement.scrollWidth") <= size[0]
    broken = "Promise.all([...document.images].map(i => i.decode().then(() => !i.naturalWidth, () => true)))"
    found = chromium.value(broken)
    assert len(found) >= 6
    assert not any(found)
    assert {request for request in chromium.requests if not request.startswith("data:")} == {path.as_uri()}
    assert chromium.errors == []
    for selector, least in (("body", 7.0), (".MISSED", 4.5), (".met", 4.5)):
        style = f"getComputedStyle(document.querySelector({json.dumps(selector)})).color"
        assert chromium.value(f"({LUMINANCE})({style}, '{background}')") >= least, selector
    assert read(made[0].path("summary.csv")).shape[0] > 100
