"""The whole of `grasp evaluate` in small; the report rebuilds from saved trials; metrics count what fails."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from training import metrics as metrics_module
from training.cli import main
from training.evaluate import evaluate
from training.report import build_report, number
from training.runs import Run
from training.settings import EvaluateConfig, FitConfig
from training.starts import LABELS
from training.statistics import ratio_interval, summary


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    out = tmp_path_factory.mktemp("runs")
    config = EvaluateConfig(
        out=str(out),
        name="small",
        wrenches=20,
        timed=12,
        episodes=1,
        fit=FitConfig(steps=200, samples=8192, hidden=(32, 32), batch_size=512, threads=1),
    )
    evaluate(config, Console(quiet=True))
    return Run.open(out / "small", "metrics.json")


def test_everything_promised_is_there(run):
    names = ["report.html", "report.md", "metrics.json", "config.json", "model/four_finger.safetensors"]
    figures = ["convergence", "iterations_ecdf", "forces_over_time", "start_against_optimum", "rollout", "hand"]
    for name in names + [f"figures/{figure}.png" for figure in figures]:
        assert run.path(name).stat().st_size > 500
    assert not list(run.folder.rglob(".*"))  # no temporary files


def test_report_says_what_the_trials_say(run):
    metrics, trials = run.read_json("metrics.json"), run.read_arrays("trials.npz")
    assert metrics["starts"]["ball"].keys() == LABELS.keys()
    basis = metrics["starts"]["ball"]["linear_combination"]
    assert basis["iterations"]["median"] == np.median(trials["ball/linear_combination/iterations"])
    page, text = run.path("report.html").read_text(), run.path("report.md").read_text()
    for claim in metrics["claims"]:
        assert claim["measured"] in text
        assert claim["measured"] in page
    assert "http://" not in page
    assert "https://" not in page  # opens without a network
    assert metrics["table_one"]["rows"]["optimum"]["sum"] == pytest.approx(9.36, abs=0.01)
    for row in metrics["table_one"]["rows"].values():
        assert row["balance"] == pytest.approx(0.6, abs=1e-6)


def test_every_start_ends_at_the_optimum(run):
    trials = run.read_arrays("trials.npz")
    for key in LABELS:
        gaps = trials[f"ball/{key}/end_gap"]
        assert np.nanmax(gaps) <= 1e-4


def test_report_rebuilds_without_solving(run, monkeypatch, capsys):
    before = run.read_json("metrics.json")
    monkeypatch.setattr("grasp_env.force.ForceOptimizer.solve", None)
    monkeypatch.setattr("grasp_env.sim.Scene.step", None)
    run.path("report.html").unlink()
    assert main(["report", str(run.folder)]) == 0
    assert run.path("report.html").is_file()
    after = run.read_json("metrics.json")
    assert {k: v for k, v in after.items() if k != "run"} == {k: v for k, v in before.items() if k != "run"}
    assert "report.html" in capsys.readouterr().out.replace("\n", "")


def test_missing_starts_are_counted_not_dropped(run):
    trials = dict(run.read_arrays("trials.npz"))
    trials["ball/lagrange/status"] = np.array([3] * 5 + [1] + [0] * 14)
    row = metrics_module.start_metrics(trials)["ball"]["lagrange"]
    assert row["no_start"] == 5
    assert row["not_converged"] == 1
    assert row["iterations"]["n"] == 15


def test_claims_can_fail(run):
    trials = dict(run.read_arrays("trials.npz"))
    metrics = run.read_json("metrics.json")
    trials["ball/learned_shipped/iterations"] = trials["ball/linear_combination/iterations"]
    metrics["rollouts"]["constant"]["linear_combination"]["max_drift_mm"] = 1.5
    verdicts = {row["claim"]: row["met"] for row in metrics_module.claims(trials, metrics)}
    assert not next(met for claim, met in verdicts.items() if claim.startswith("learned, shipped: median"))
    assert not next(met for claim, met in verdicts.items() if "constant" in claim)


def test_a_start_that_does_not_exist_fails_its_claims(run):
    trials, metrics = dict(run.read_arrays("trials.npz")), run.read_json("metrics.json")
    for column, value in (("iterations", -1), ("status", 3), ("start_gap", np.nan)):
        trials[f"ball/learned_shipped/{column}"] = np.full(20, value)
    verdicts = [row["met"] for row in metrics_module.claims(trials, metrics) if "learned, shipped" in row["claim"]]
    assert verdicts == [False, False]


def test_summary_and_ratio():
    values = np.concatenate([np.zeros(50), np.ones(50)])
    got = summary(values)
    assert (got["n"], got["max"], got["p95"]) == (100, 1.0, 1.0)
    assert got["median_low"] <= got["median"] <= got["median_high"]
    assert summary(np.empty(0))["median"] is None
    ratio, low, high = ratio_interval(np.full(30, 2.0), np.full(30, 8.0))
    assert ratio == low == high == 0.25
    assert number(None) == "–"


def test_run_folders(tmp_path):
    run = Run.create(tmp_path, "a")

    def broken(path):
        path.write_text("half")
        raise RuntimeError("disk")

    run.write_text("x.txt", "whole")
    with pytest.raises(RuntimeError):
        run.write("x.txt", broken)
    assert run.path("x.txt").read_text() == "whole"
    assert [path.name for path in run.folder.iterdir()] == ["x.txt"]
    with pytest.raises(ValueError, match="Out of range float"):
        run.write_json("n.json", {"x": float("nan")})


def test_cli_errors_and_json(tmp_path, capsys):
    assert main(["solve", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "optimal"
    assert answer["equilibrium_residual"] < 1e-9
    assert main(["solve", "--initial", "best"]) == 2
    assert "'learned'" in capsys.readouterr().err
    assert main(["solve", "--json", "--wrench", "1000", "500", "-600", "-100", "200", "0"]) == 2
    out, error = capsys.readouterr()
    assert json.loads(out)["status"] == "iteration_limit"  # and what it says is JSON, without Infinity
    assert "max_iterations" in error
    assert main(["solve", "--preset", "hexapod"]) == 2
    assert main(["report", str(tmp_path)]) == 2
    assert "run.json is missing" in capsys.readouterr().err
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert main(["evaluate", "--out", str(blocked)]) == 2
    assert "cannot write" in capsys.readouterr().err
    assert main(["demo", "--video", str(tmp_path / "hand.avi")]) == 2


def test_a_finished_run_is_not_overwritten(run, capsys):
    assert main(["evaluate", "--quick", "--out", str(run.folder.parent), "--name", run.folder.name]) == 2
    assert "finished run" in capsys.readouterr().err


def test_solve_from_a_fitted_model(run, capsys):
    assert main(["solve", "--json", "--initial", str(run.folder / "model" / "four_finger")]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "optimal"


def test_demo_picture_and_video(tmp_path):
    for name in ("hand.png", "hand.gif", "hand.mp4"):
        assert main(["demo", "--video", str(tmp_path / name), "--seconds", "0.2"]) == 0
        assert (tmp_path / name).stat().st_size > 2000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.gif", "hand.mp4", "hand.png"]


def test_build_report_is_deterministic(run):
    first = build_report(run)
    assert build_report(run) == first
