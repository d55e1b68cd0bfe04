"""The report from made-up trials: what it says, and what a headless Chromium shows of it without a network."""

from __future__ import annotations

import html
import json
import re
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from browser import Browser, browser, find_browser
from synthetic_run import CASES, synthetic_run

from grasp_env.errors import InvalidInputError
from training.report.comparison import build_report, write_pages
from training.report.details import newton_section
from training.report.facts import caveats_section
from training.report.first import charts
from training.report.page import Table, claims_section
from training.report.starts import STEPPED, label, matrix, network_section, pair, wins_section
from training.report.style import THEME, svg
from training.runs import Run
from training.trials.hold_metrics import CELL_METRICS
from training.trials.metrics import METRICS, PER_START
from training.trials.ranks import wins

EXECUTABLE = find_browser()
needs_browser = pytest.mark.skipif(
    EXECUTABLE is None, reason="no Chromium here: install Debian's (apt-get install chromium) or run .ci/run"
)
ROOT = Path(__file__).parents[2]
PAGE_LIMIT = 6e6
"""[bytes] of the page, all pictures in it."""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Run, dict[str, Any]]:
    run, metrics = synthetic_run(tmp_path_factory.mktemp("runs") / "synthetic")
    write_pages(run, metrics)
    return run, metrics


@pytest.fixture(scope="module")
def page(made) -> Path:
    return made[0].path("report.html")


class Reader(HTMLParser):
    """Checks that elements nest, and collects ids, anchors, pictures and table shapes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.alts: list[str | None] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag not in ("meta", "link", "img", "input", "source", "br"):
            self.open.append(tag)
        self.ids += [found["id"] or ""] if "id" in found else []
        self.links += [found["href"] or ""] if tag == "a" else []
        self.alts += [found.get("alt")] if tag == "img" else []

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.ids += [found["id"] or ""] if "id" in found else []

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_and_small(page):
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < PAGE_LIMIT
    assert "http:" not in text.replace('xmlns="http://www.w3.org/2000/svg"', "")
    assert "https:" not in text
    read = Reader(text)
    assert read.open == []
    assert len(read.ids) == len(set(read.ids))
    assert {link[1:] for link in read.links} <= set(read.ids)
    assert read.alts
    assert all(read.alts)
    assert set(re.findall(r"var\((--[\w-]+)\)", text)) <= {
        *(f"--c-{name}" for name in THEME), "--ink", "--paper", "--soft", "--line", "--good", "--bad", "--open", "--best", "--link",
    }  # fmt: skip
    referenced = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text))
    assert {first or second for first, second in referenced} <= set(read.ids)


def test_every_figure_lies_beside_the_page(made):
    run, _ = made
    text = run.path("report.md").read_text(encoding="utf-8")
    names = re.findall(r"\]\(figures/([^)]+)\)", text)
    kinds = {name.split("-")[0].split(".")[0] for name in names}
    assert kinds >= {
        "found", "fan", "ecdf", "budget", "profile", "violins", "continuity", "constant", "forces", "against", "rollout", "rl", "hand_paper", "training",
    }  # fmt: skip
    assert all(run.path(f"figures/{name}").stat().st_size > 200 for name in names)
    assert not [path for path in run.folder.rglob(".*") if path.is_file()]  # no temporary files


def test_both_texts_say_every_claim_missed_ones_first(made, page):
    run, metrics = made
    for text in (run.path("report.md").read_text(encoding="utf-8"), page.read_text(encoding="utf-8")):
        for claim in metrics["claims"]:
            assert claim["measured"] in text
        assert text.index("a claim that is missed") < text.index("a claim without") < text.index("a claim that is met")
    assert "<&>" not in page.read_text(encoding="utf-8")  # escaped
    (table,) = claims_section(metrics).blocks
    assert isinstance(table, Table)
    assert [row[0].text for row in table.cells] == ["NO", "not measured", "yes"]


def test_markdown_tables_have_as_many_cells_as_columns(made):
    width = 0
    for line in made[0].path("report.md").read_text(encoding="utf-8").splitlines():
        cells = line.replace("\\|", "").count("|") if line.startswith("|") else 0
        assert not (cells and width) or cells == width, line
        width = cells


def test_the_best_start_of_a_row_is_marked_and_one_that_is_missing_is_not(made):
    metrics = json.loads(json.dumps(made[1]))
    rows = metrics["starts"]["reduced_flow"]
    rows["ball"]["learned_fixed"]["no_start"] = 15  # of 30: its median says nothing about them
    table = matrix(metrics, "reduced_flow", ("linear_combination", "learned_fixed", "learned_previous"), "iterations")
    names = list(rows)
    for name, row in zip(names, table.cells, strict=True):
        kinds = [cell.kind for cell in row[1:]]
        assert kinds == (["", "", "best"] if name in ("ball", "random_3") else ["", "best", ""])
    assert table.cells[names.index("ball")][2].text.endswith("†")
    assert table.cells[names.index("random_3")][2].text == "–"


def test_the_network_alone_stands_beside_the_basis_with_as_many_newton_steps(made):
    (table,) = network_section(made[1]).blocks
    assert isinstance(table, Table)
    assert [row[0].text for row in table.cells] == [label(key) for key in STEPPED]
    row = made[1]["starts"]["reduced_flow"]["ball"]["network"]
    assert table.cells[3][1].text == pair(row["iterations"])
    assert "97" in network_section(made[1]).notes[0]  # % inside the cones before the repair


def test_the_first_screen_says_what_was_found_before_all_else(made, page):
    run, metrics = made
    assert len(metrics["found"]) == 3
    for text in (run.path("report.md").read_text(encoding="utf-8"), html.unescape(page.read_text(encoding="utf-8"))):
        places = [text.index(said.partition(":")[2]) for said in metrics["found"]]
        assert (
            max(places)
            < text.index("found-iterations")
            < text.index("found-microseconds")
            < text.index("a claim that is missed")
        )
        assert "Words used here" in text


def test_the_chart_of_the_first_screen_has_a_line_for_every_start_given(made):
    """In its own colour; one without a start on any case says so."""
    metrics = json.loads(json.dumps(made[1]))
    for sets in metrics["starts"].values():
        for rows in sets.values():
            rows["mine"] = rows["lagrange"]
            rows["never"] = {**rows["lagrange"], "no_start": CASES, "iterations": {"n": 0, "median": None}}
    metrics["run"]["given"] = {"mine": {"compiled": True}, "never": {"compiled": False}}
    for rows in metrics["timing"]["total"].values():
        rows["mine"] = rows["lagrange"]
    for (name, _, caption, alt, drawing), marks in zip(
        charts(metrics), (("mine", "never†"), ("mine", "never*†")), strict=True
    ):
        assert drawing is not None
        text = svg(drawing, name, alt)
        assert all(f">{mark}<" in text for mark in (*marks, "no start"))
        assert "--c-given_0" in text
        assert "mine, flow" in alt
        assert ("†" in caption) == (name == "found-iterations")


def test_a_saved_model_that_was_given_is_no_callable_of_python(made):
    metrics = json.loads(json.dumps(made[1]))
    for method, sets in metrics["starts"].items():
        for rows in sets.values():
            rows |= dict.fromkeys(("net", "layered", "rule"), rows["lagrange"])
        metrics["timing"]["total"][method] |= dict.fromkeys(
            ("net", "layered", "rule"), metrics["timing"]["total"][method]["lagrange"]
        )
    known = {"net": (True, False), "layered": (True, True), "rule": (False, None)}
    metrics["run"]["given"] = {key: {"compiled": one, "second_order": other} for key, (one, other) in known.items()}
    _, (*_, drawing) = charts(metrics)
    assert drawing is not None
    text = svg(drawing, "found", "")
    assert ">net<" in text
    assert ">rule*<" in text
    (told,) = [text for text in caveats_section(metrics).items if text.startswith("Newton steps")]
    inside, _, rest = told.partition(" None: ")
    none, _, unknown = rest.partition(" Not known: ")
    assert inside.endswith("; layered.")
    assert none.endswith("; net.")
    assert unknown.startswith("rule. ")


def test_a_start_that_fails_everywhere_is_counted_where_others_have_numbers(made):
    metrics = json.loads(json.dumps(made[1]))
    none = {"cases": CASES, "no_start": CASES, "not_applicable": 0, "iterations": {"n": 0, "median": None}}
    for sets in metrics["starts"].values():
        for rows in sets.values():
            rows["never"] = none
    metrics["wins"] = wins(metrics)
    told = f"no start on {CASES} of {CASES}"
    main, best, _ = wins_section(metrics).blocks
    assert isinstance(main, Table)
    assert isinstance(best, Table)
    assert {row[main.columns.index("never")].text for row in main.cells} == {told}
    assert {row[best.columns.index("best given")].text for row in best.cells} == {told}
    newton = newton_section(metrics).blocks[0]
    assert isinstance(newton, Table)
    assert [row[1].text for row in newton.cells if row[0].text == "never"] == [told]
    some = {"median": 3.0, "p99": 5001.0, "cases": CASES, "no_start": 1}
    assert pair(some) == f"3, no start on 1 of {CASES}"


def test_texts_follow_the_settings_and_numbers_of_the_run(made, tmp_path):
    """One repeat is no best of several; what the previous solution leaves, and which starts take Newton steps, is this run's."""
    metrics = json.loads(json.dumps(made[1]))

    def told(name: str) -> str:
        write_pages(Run(tmp_path / name), metrics)
        return (tmp_path / name / "report.md").read_text(encoding="utf-8")

    text = told("several")
    assert "Best of 3 repeats per wrench" in text
    assert "best of 3 on 30 wrenches of the held-out ball" in text  # however many of them were compared
    metrics["timing"]["repeats"] = 1
    for rows in metrics["starts"]["reduced_flow"].values():
        rows["previous_tangent"]["iterations"].update(median=0.0, p99=0.0)
        del rows["nearest_tangent"]
    text = told("once")
    assert "best of" not in text.lower().replace("★ marks the best of a row", "")
    assert "called once" in text
    assert "there nothing is left to gain" in text
    assert "Newton; previous, tangent; network + Newton" in text
    metrics["starts"]["reduced_flow"]["smooth"]["previous_tangent"]["iterations"].update(p99=50.0)
    assert "there is something left to gain" in told("left")


@pytest.mark.parametrize("name", [*PER_START, *CELL_METRICS, *METRICS])
def test_every_metric_is_shown(name):
    """A metric that no table asks for would be computed and told to nobody."""
    rooms = [ROOT / "training" / room for room in ("report", "trials")]
    texts = [path.read_text(encoding="utf-8") for room in rooms for path in room.glob("*.py")]
    uses = sum(len(re.findall(rf"[\"']{name}[\"']", text)) for text in texts)
    assert uses >= 2, f"{name} stands in its table of metrics alone: show it in a `Columns` of training/report"


def test_what_a_run_lacks_is_left_out_or_a_dash(made, tmp_path):
    _, metrics = made
    metrics = json.loads(json.dumps(metrics))
    for name in ("found", "events", "timing", "table_one", "continuity", "guarantee", "break_even", "rollouts", "wins"):
        del metrics[name]
    for rows in metrics["starts"]["reduced_flow"].values():
        for row in rows.values():
            del row["iterations_to"], row["gap_after"], row["raw"], row["start_gap"]
            row["iterations"] = {"n": 0, "median": None}
    metrics["run"] = {"quick": False}
    write_pages(Run(tmp_path), metrics)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert Reader(text).open == []
    assert "–" in text
    assert "Quick run" not in text
    write_pages(Run(tmp_path), {"run": {}})
    (tmp_path / "rl.json").write_text('{"rows": [1, 2], "other": {"a": null}}')
    write_pages(Run(tmp_path), {"run": {}})
    assert "Reinforcement learning" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_report_is_metrics_then_pages(made, tmp_path, monkeypatch):
    _, metrics = made
    monkeypatch.setattr("training.report.comparison.metrics_of", lambda run: {**metrics, "sets": {}})
    assert build_report(Run(tmp_path))["claims"] == metrics["claims"]
    first = (tmp_path / "report.html").read_bytes()
    assert Run(tmp_path).read_json("metrics.json")["claims"] == metrics["claims"]
    build_report(Run(tmp_path))
    assert (tmp_path / "report.html").read_bytes() == first


def test_a_run_of_an_older_version_is_refused(tmp_path):
    (tmp_path / "trials.npz").write_bytes(b"")
    with pytest.raises(InvalidInputError, match="older version"):
        build_report(Run(tmp_path))


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


def wide(tab: Browser) -> list[str]:
    """What sticks out of the page to the right, without what scrolls in a box of its own."""
    return tab.value(
        "[...document.querySelectorAll('body *')].filter(e => !e.closest('.scroll > *') && !e.closest('svg') && "
        "e.getBoundingClientRect().right > document.documentElement.clientWidth + 1).map(e => e.outerHTML.slice(0, 200))"
    )


@needs_browser
@pytest.mark.parametrize("size", [(360, 800), (1280, 900)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_opens_without_network_errors_or_overflow(chromium, page, size, scheme):
    chromium.requests.clear()
    chromium.errors.clear()
    chromium.show(page, *size, prefers_color_scheme=scheme)
    chromium.value("document.querySelectorAll('details').forEach(e => e.open = true)")
    assert chromium.value("innerWidth") == size[0]
    assert chromium.value("document.documentElement.scrollWidth") <= size[0]
    assert wide(chromium) == []
    assert chromium.value("[...document.images].length") >= 4
    broken = "Promise.all([...document.images].map(i => i.decode().then(() => !i.naturalWidth, () => true)))"
    assert not any(chromium.value(broken))
    assert set(chromium.requests) == {page.as_uri()}
    assert chromium.errors == []


LUMINANCE = """(text, back) => { const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).map(Number).map(v => v / 255)
  .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b }
  const [a, b] = [light(text), light(back)].sort((x, y) => y - x); return (a + 0.05) / (b + 0.05) }"""


@needs_browser
@pytest.mark.parametrize(("scheme", "background"), [("light", "rgb(255, 255, 255)"), ("dark", "rgb(21, 23, 26)")])
def test_it_is_readable_in_light_and_dark(chromium, page, scheme, background):
    chromium.show(page, 1280, 900, prefers_color_scheme=scheme)

    def style(selector: str, prop: str) -> str:
        return f"getComputedStyle(document.querySelector({json.dumps(selector)})).{prop}"

    assert chromium.value(style("body", "backgroundColor")) == background
    for selector, prop, least in (
        ("body", "color", 7.0), ("a", "color", 4.5), (".bad", "color", 4.5), (".good", "color", 4.5), (".open", "color", 4.5),
        ("figure svg text", "fill", 7.0), *((f".legend [style*='--c-{name})']", "borderTopColor", 3.0) for name in (
            "linear_combination", "learned_fixed", "previous_tangent", "single_value", "lagrange"
        )),
    ):  # fmt: skip
        ratio = chromium.value(f"({LUMINANCE})({style(selector, prop)}, '{background}')")
        assert ratio >= least, (selector, ratio)


@needs_browser
def test_the_animation_stops_when_asked_or_when_less_motion_is_wanted(chromium, page):
    shown = (
        "[...document.querySelectorAll('.loop img')].filter(i => i.offsetHeight).map(i => i.currentSrc.slice(5, 15))"
    )
    chromium.show(page, 360, 800)
    assert chromium.value(shown) == ["image/webp"] * 2
    chromium.value("document.querySelectorAll('.loop input').forEach(e => e.click())")
    assert chromium.value(shown) == ["image/jpeg"] * 2
    chromium.show(page, 360, 800, prefers_reduced_motion="reduce")
    assert chromium.value(shown) == ["image/jpeg"] * 2


@needs_browser
def test_it_prints_black_on_white(chromium, page):
    chromium.show(page, 800, 1100, media="print", prefers_color_scheme="dark")
    assert chromium.value("getComputedStyle(document.body).color") == "rgb(27, 27, 27)"
    assert chromium.value("getComputedStyle(document.querySelector('nav')).display") == "none"
    assert chromium.pdf().startswith(b"%PDF")


@needs_browser
def test_the_figures_show_on_their_own(chromium, made):
    for name in ("fan-ball.svg", "violins.svg", "rl-return.svg"):
        chromium.errors.clear()
        chromium.show(made[0].path(f"figures/{name}"), 800, 600)
        assert chromium.value("document.documentElement.tagName") == "svg"
        assert chromium.value("document.querySelectorAll('parsererror').length") == 0
        assert chromium.errors == []


def test_ci_installs_the_browser():
    script = Path(__file__).parents[2] / ".ci" / "run"
    assert "chromium" in script.read_text()
    assert shutil.which("bash")
