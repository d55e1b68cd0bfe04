"""Hold rates are counted right from hand-made trials; the report rebuilds without simulating; workers do not matter."""

from __future__ import annotations

import json
import shutil
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from grasp_env.config import EnvConfig
from grasp_env.errors import InvalidInputError
from training.cli import main
from training.report.holds import build_env_report
from training.runs import Run
from training.runs.statistics import mean_interval, wilson
from training.trials import holds
from training.trials.hold_metrics import cell_metrics, choose, env_metrics, failures, paired
from training.trials.hold_plan import CONTROLLERS, NO_START, SCENARIO_LABELS, Cell, plan
from training.trials.hold_rates import evaluate_env
from training.trials.holds import _NUMBERS, cell_json, columns, run_trial
from training.trials.settings import EnvEvaluateConfig

SHAPES = ("cuboid", "cylinder", "sphere", "capsule")


def made(outcomes: list[str], force: float = 20.0, drift: float = 2e-4) -> dict[str, np.ndarray]:
    """Trials of seeds 0, 1, ... with these failures ("": held)."""
    rows = []
    for seed, failure in enumerate(outcomes):
        numbers = dict.fromkeys(_NUMBERS, np.nan if failure == NO_START else 1.0)
        rows.append({
            "seed": seed, "redrawn": 0, "shape": SHAPES[seed % 4], "size_x": 0.1, "size_y": 0.09, "size_z": 0.0,
            "mass": 0.1 + 0.01 * seed, "friction": 0.5, "failure": failure, "detail": "", "status": "optimal",
            "held": not failure, **numbers, "cut_in_place": 0.0, "time": 4.0, "max_drift": drift * (1 + seed), "mean_drift": drift,
            "normal_force": np.nan if failure == NO_START else force + seed,
        })  # fmt: skip
    return columns(rows)


def test_rates_count_every_episode():
    trials = made(["", "dropped", "", NO_START, "", "", "closure_lost", "", "", ""])
    got = cell_metrics(trials)
    assert (got["held"], got["episodes"], got["started"]) == (7, 10, 9)
    assert got["rate"] == 0.7
    assert (got["rate_low"], got["rate_high"]) == wilson(7, 10)
    assert got["failures"] == {"closure_lost": 1, "dropped": 1, NO_START: 1}
    assert got["max_drift_mm"]["n"] == 7
    assert got["normal_force"]["n"] == 9
    assert got["largest_drift_mm"] == pytest.approx(2.0)
    json.dumps(got, allow_nan=False)


def test_not_lost_but_too_far_at_the_end_is_a_failure():
    trials = made(["", ""])
    trials["held"][1] = False
    assert cell_metrics(trials)["failures"] == {"drifted": 1}


def test_wilson_and_mean():
    low, high = wilson(495, 500)
    assert low == pytest.approx(0.9768, abs=1e-4)  # Agresti and Coull's formula, by hand
    assert high == pytest.approx(0.9957, abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    values = np.random.default_rng(0).normal(3.0, 1.0, 400)
    got = mean_interval(values)
    assert got["low"] < values.mean() == got["mean"] < got["high"]
    assert got["high"] - got["low"] == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.15)


def test_differences_are_paired_by_seed():
    base = made(["", "", "dropped", NO_START])
    other = made(["", "dropped", "", ""], force=30.0)
    other = {name: values[[2, 0, 1, 3]] for name, values in other.items()}  # the order does not matter
    got = paired(other, base)
    assert (got["pairs"], got["only_this"], got["only_base"]) == (4, 2, 1)
    assert got["held"]["mean"] == 0.25
    assert got["normal_force"] == {"n": 3, "mean": 10.0, "low": 10.0, "high": 10.0}
    other["mass"][0] += 0.1
    with pytest.raises(ValueError, match="mass differs"):
        paired(other, base)


def test_failures_say_cause_seed_and_object():
    trials = made(["", "dropped", NO_START])
    trials["detail"] = np.array(["", "", "the grasp did not settle"])
    first, second = failures("objects/pd", trials)
    assert (first["seed"], first["cause"], first["cell"]) == (1, "dropped", "objects/pd")
    assert first["object"] == "cylinder 100 x 90 mm, 110 g, friction 0.50"
    assert "fingers touching" in first["how"]
    assert (second["cause"], second["how"]) == (NO_START, "the grasp did not settle")


def test_the_margin_is_the_largest_that_holds():
    curve = [{"swept": margin, "rate": rate} for margin, rate in ((0.5, 1.0), (0.7, 0.995), (0.8, 0.99), (0.9, 0.7))]
    assert choose(curve, "swept", largest=True)["swept"] == 0.8
    assert choose(curve, "swept", largest=False)["swept"] == 0.5
    weak = [{"swept": margin, "rate": rate} for margin, rate in ((0.5, 0.9), (0.7, 0.9), (0.9, 0.3))]
    assert choose(weak, "swept", largest=True)["swept"] == 0.7
    assert choose([], "swept", largest=True) is None


def everything(outcomes: dict[str, list[str]]) -> tuple[list[dict], dict[str, dict[str, np.ndarray]]]:
    cells = [cell_json(cell) for cell in plan(8, quick=True)]
    return cells, {cell["name"]: made(outcomes.get(cell["name"], [""] * 8)) for cell in cells}


def test_claims_can_be_met_and_missed():
    cells, trials = everything({})
    verdicts = {row["claim"]: row["met"] for row in env_metrics(cells, trials)["claims"]}
    assert len(verdicts) == 8
    assert not any(met for claim, met in verdicts.items() if "from its curve" in claim)  # equal rates and squeezes
    assert not next(met for claim, met in verdicts.items() if claim.startswith("W_ext"))  # 1.6 mm there
    assert next(met for claim, met in verdicts.items() if "random objects against" in claim)
    cells, trials = everything({"objects/paper": ["dropped"] + [""] * 7, "all/paper/0.85": ["dropped"] * 8})
    metrics = env_metrics(cells, trials)
    verdicts = {row["claim"]: row["met"] for row in metrics["claims"]}
    assert not next(met for claim, met in verdicts.items() if "random objects against" in claim)
    assert metrics["chosen"]["all"]["paper"] == "all/paper/0.6"
    assert len(metrics["failures"]) == 9


def test_the_plan_is_sound():
    cells = plan(500)
    assert len({cell.name for cell in cells}) == len(cells)
    assert {cell.scenario for cell in cells} == set(SCENARIO_LABELS)
    assert {cell.controller for cell in cells} == set(CONTROLLERS)
    episodes = {cell.name: cell.episodes for cell in cells}
    assert episodes["objects/paper"] == episodes["six_directions/paper"] == 500
    json.dumps([cell_json(cell) for cell in cells], allow_nan=False)
    small = plan(4, quick=True)
    assert len(small) < len(cells)


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Run:
    """A finished run of hand-made trials."""
    run = Run.create(tmp_path_factory.mktemp("runs"), "made")
    cells, trials = everything({"objects/pd": ["dropped", NO_START] + [""] * 6})
    for name, values in trials.items():
        run.write_arrays(f"trials/{name}.npz", values)
    run.write_json("run.json", {
        "kind": "env", "quick": False, "seed": 0, "cells": cells, "config": {"name": "made"}, "command": "grasp", "time": "now",
        "machine": {"processor": "p", "cores": 2, "system": "s", "python": "3"}, "versions": {"numpy": "2"}, "commit": "c",
    })  # fmt: skip
    build_env_report(run)
    return run


def test_report_shows_everything(report):
    metrics = report.read_json("metrics.json")
    page, text = report.path("report.html").read_text(), report.path("report.md").read_text()
    for claim in metrics["claims"]:
        assert claim["measured"] in text
        assert claim["measured"] in page
    assert "http://" not in page
    assert "https://" not in page
    assert page.count("<img") == 3
    assert "cylinder 100 x 90 mm" in text
    for name in ("failures", "drift_ecdf", "rate_against_squeeze"):
        assert report.path(f"figures/{name}.png").stat().st_size > 3000


def test_the_protocol_says_this_runs_settings(report, tmp_path):
    """Another squeeze, spring and object than the defaults stand in the text, which no code repeats."""
    config = EnvConfig()
    text = report.path("report.md").read_text()
    assert f"internal force of {config.squeeze:g} N in total" in text
    assert f"spring of {config.pd_stiffness:g} N/m" in text
    other = Run(shutil.copytree(report.folder, tmp_path / "other"))
    facts = other.read_json("run.json")
    for cell in facts["cells"]:
        cell["resolved"] |= {"squeeze": 33.0, "pd_stiffness": 444.0, "mass_range": [0.01, 0.77], "max_drift": 0.055}
    other.write_json("run.json", facts)
    build_env_report(other)
    text = other.path("report.md").read_text()
    for part in ("33 N in total", "444 N/m", "0.01 to 0.77 kg", "Lost: 55 mm"):
        assert part in text


def test_report_rebuilds_without_simulating(report, monkeypatch, capsys):
    monkeypatch.setattr("training.trials.holds.FourFingerGrasp", None)
    before = report.read_json("metrics.json")
    report.path("report.html").unlink()
    assert main(["report", str(report.folder)]) == 0
    assert report.path("report.html").is_file()
    assert report.read_json("metrics.json") == before
    assert "report.html" in capsys.readouterr().out.replace("\n", "")


SHORT = {"disturbance": "random", "duration": 0.2}


def test_a_trial_depends_on_its_seed_alone():
    first, again, other = (run_trial(SHORT, True, seed) for seed in (3, 3, 4))
    assert first == again
    assert first["mass"] != other["mass"]
    squeezed = run_trial({**SHORT, "controller": "constant_squeeze"}, True, 3)
    for name in ("shape", "size_x", "size_y", "size_z", "mass", "friction"):
        assert squeezed[name] == first[name]
    assert first["time"] == pytest.approx(0.2)


def test_a_grasp_that_does_not_settle_is_counted():
    row = run_trial({**SHORT, "friction_error": 2.0}, False, 0)
    assert (row["failure"], row["held"]) == (NO_START, False)
    assert "settle" in row["detail"]
    assert cell_metrics(columns([row]))["started"] == 0


def test_workers_do_not_matter_and_an_interrupted_run_goes_on(tmp_path, monkeypatch):
    def run(name: str, workers: int, cells: list[Cell]) -> Run:
        config = EnvEvaluateConfig(out=str(tmp_path), name=name, workers=workers)
        build_env_report(evaluate_env(config, Console(quiet=True), cells))
        return Run(tmp_path / name)

    cells = [Cell("objects", "paper", 5, SHORT), Cell("objects", "pd", 2, {**SHORT, "controller": "pd"})]
    one = run("one", 1, cells)

    real = holds.run_jobs

    def stopped(here: Run, jobs: list[Any], workers: int) -> Any:
        yield from real(here, jobs[:1], workers)
        raise KeyboardInterrupt

    monkeypatch.setattr(holds, "run_jobs", stopped)
    with pytest.raises(KeyboardInterrupt):
        run("two", 2, cells)
    assert (tmp_path / "two/trials/objects/paper.npz").is_file()
    assert not (tmp_path / "two/run.json").exists()
    written = (tmp_path / "two/trials/objects/paper.npz").stat().st_mtime_ns
    monkeypatch.setattr(holds, "run_jobs", real)
    with pytest.raises(InvalidInputError, match="begun with other"):
        run("two", 2, cells[:1])
    two = run("two", 2, cells)
    assert (tmp_path / "two/trials/objects/paper.npz").stat().st_mtime_ns == written
    assert one.read_json("metrics.json")["cells"] == two.read_json("metrics.json")["cells"]
    with pytest.raises(InvalidInputError, match="finished run"):
        run("two", 2, cells)


@pytest.mark.slow
def test_quick_run_from_the_command_line(tmp_path, capsys):
    assert main(["evaluate", "env", "--quick", "--out", str(tmp_path), "--name", "q"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("QUICK RUN")
    assert "random objects against a random wrench" in out
    assert "QUICK RUN" in (tmp_path / "q/report.md").read_text()
