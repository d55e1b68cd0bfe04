"""The whole of `grasp evaluate` in small; metrics from saved trials; claims that can fail; runs that go on."""

from __future__ import annotations

import copy
import json
import threading
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from grasp_env.errors import InvalidInputError
from grasp_env.force import RULES, Objective
from grasp_env.force.initial import SingleValue, StartRule
from training.cases.given import Given
from training.cases.set_table import SETS
from training.cases.start_table import FITTED, LEARNED, STARTS, row_of
from training.cases.starts import make_starts
from training.cli import main
from training.fit.settings import FitConfig
from training.runs import Run
from training.runs.statistics import ratio_interval, spread
from training.runs.words import number
from training.trials import comparison as evaluate_module
from training.trials.arrays import SCENARIOS
from training.trials.claims import claims
from training.trials.compare import cases_of, compare
from training.trials.comparison import evaluate, plan
from training.trials.findings import findings
from training.trials.metrics import metrics_of, start_metrics
from training.trials.ranks import wins
from training.trials.rollouts import roll_out_scenario
from training.trials.settings import EvaluateConfig

SMALL: dict[str, Any] = {"wrenches": 6, "timed": 4, "repeats": 2, "guarded": 60, "paths": 1, "episodes": 1, "steps": 10}


OWN = """
import numpy as np
from grasp_env.force import LinearCombination

class Sometimes:
    def __call__(self, grasp, wrench):
        if wrench[0] > 0.0:
            raise ArithmeticError("not to the right")
        return LinearCombination()(grasp, wrench)

def unbalanced(grasp, wrench):
    return np.tile([1.0, 0.0, 0.0], (grasp.n_contacts, 1))

def outside(grasp, wrench):
    return -(grasp.pseudoinverse @ wrench).reshape(-1, 3)

two = 2
"""
GIVEN = ("sometimes", "unbalanced", "outside", "squeeze")
"""Names of the starts that the run is given, the last from Python."""


def squeezing() -> dict[str, Any]:
    """A rule that only this process can name."""
    return {"squeeze": lambda grasp, wrench: SingleValue()(grasp, wrench)}


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> tuple[str, ...]:
    path = tmp_path_factory.mktemp("own") / "my_rules.py"
    path.write_text(OWN)
    return f"sometimes={path}:Sometimes", f"unbalanced={path}:unbalanced", f"outside={path}:outside"


@pytest.fixture(scope="module")
def run(tmp_path_factory, own) -> Run:
    out = tmp_path_factory.mktemp("runs")
    fit = FitConfig(steps=200, samples=8192, hidden=(32, 32), batch_size=512, threads=1)
    config = EvaluateConfig(out=str(out), name="small", fit=fit, start=own, **SMALL)
    found = evaluate(config, Console(quiet=True), squeezing())
    found.write_json("metrics.json", metrics_of(found))  # the pages have tests of their own
    return Run.open(out / "small", "metrics.json")


@pytest.fixture
def metrics(run):
    return copy.deepcopy(run.read_json("metrics.json"))


def verdicts(metrics, part):
    return [row["met"] for row in claims(metrics) if part in row["claim"]]


def test_everything_promised_is_there(run):
    names = ["metrics.json", "config.json", "plan.json", "model/four_finger.safetensors"]
    files = ["timing", "continuity", "guarantee", "rollouts", *(f"trials/{name}" for name in SETS)]
    for name in names + [f"{name}.npz" for name in files] + ["figures/hand.png"]:
        assert run.path(name).stat().st_size > 300, name
    assert not list(run.folder.rglob(".*"))  # no temporary files


def test_metrics_say_what_the_trials_say(run, metrics):
    trials = run.read_arrays("trials/ball.npz")
    for method, sets in metrics["starts"].items():
        assert list(sets) == list(SETS)
        basis = sets["ball"]["linear_combination"]
        assert basis["iterations"]["median"] == np.median(trials[f"{method}/linear_combination/iterations"])
        assert basis["iterations"] == sets["ball"]["linear_combination"]["iterations"]
        assert basis["gap_after"]["0"]["median"] == pytest.approx(basis["start_gap"]["median"])
    found = set(metrics["starts"]["reduced_flow"]["ball"])
    assert found == {*STARTS, FITTED, *GIVEN}
    assert metrics["table_one"]["rows"]["optimum"]["sum"] == pytest.approx(9.36, abs=0.01)
    for row in metrics["table_one"]["rows"].values():
        assert row["balance"] == pytest.approx(0.6, abs=1e-6)
    assert set(metrics["rollouts"]) == set(SCENARIOS)
    assert set(metrics["events"]["rollout_changes"]) <= {"lost", "landed", "slipped"}


def test_every_start_ends_at_the_optimum_of_the_ball(run):
    trials = run.read_arrays("trials/ball.npz")
    for key in STARTS:
        if f"newton/{key}/status" in trials:
            assert set(trials[f"newton/{key}/status"].tolist()) <= {0, 3, 4}


def test_learned_starts_keep_their_guarantee(metrics):
    for sets in metrics["starts"].values():
        for rows in sets.values():
            for key in set(LEARNED) & set(rows):
                if rows[key]["cases"]:
                    assert rows[key]["worse_than_basis"]["count"] == 0
                    assert rows[key]["margin_min"] > 0.0
    assert all(row["worse"] == 0 for row in metrics["guarantee"].values())


def test_given_starts_stand_with_the_others_and_what_they_do_wrong_is_counted(run, metrics):
    """In every set, by every method, timed, on the hand; nothing that they raise or return stops the run."""
    assert list(metrics["run"]["given"]) == [FITTED, *GIVEN]
    known = {key: (row["compiled"], row["second_order"]) for key, row in metrics["run"]["given"].items()}
    assert known == {FITTED: (True, False), **dict.fromkeys(GIVEN, (False, None))}
    for sets in metrics["starts"].values():
        for name, rows in sets.items():
            mine, ours = rows["squeeze"], rows["single_value"]  # the same rule
            assert {**mine, "worse_than_basis": None} == ours
            for key, why in (("unbalanced", "out of balance"), ("outside", "outside the cones")):
                assert rows[key]["no_start"] == rows[key]["cases"] == rows["squeeze"]["cases"]
                assert rows[key]["reasons"] == {why: rows[key]["cases"]}
            right = int((run.read_arrays(f"trials/{name}.npz")["case/wrench"][:, 0] > 0.0).sum())
            assert rows["sometimes"]["no_start"] == right
            assert rows["sometimes"]["reasons"] == ({"ArithmeticError: not to the right": right} if right else {})
    for rows in metrics["timing"]["total"].values():
        assert (rows["squeeze"]["best"]["n"], rows["outside"]["best"]["n"]) == (SMALL["timed"], 0)
    for rows in metrics["rollouts"].values():
        assert rows["squeeze"]["held"] == rows["squeeze"]["episodes"]
        assert rows["outside"]["held"] == 0
        assert rows["outside"]["failures"]
    said = {row["claim"].split(":")[0]: row for row in claims(metrics) if row["kind"] == "given"}
    assert {name: row["met"] for name, row in said.items()} == {
        "learned fitted": True, "squeeze": True, "sometimes": False, "unbalanced": False, "outside": False,
    }  # fmt: skip
    assert "ArithmeticError" in said["sometimes"]["measured"]
    for key in ("unbalanced", "outside"):  # a constant force that balances nothing is not smooth but none
        assert metrics["continuity"][key]["slope"]["n"] == 0
    assert metrics["continuity"]["squeeze"]["slope"] == metrics["continuity"]["single_value"]["slope"]


def test_a_given_start_is_measured_against_the_basis(metrics):
    def against(name):
        (row,) = [row for row in claims(metrics) if row["claim"].startswith(f"{name} against the 12-basis")]
        return row

    rows, total = metrics["starts"]["reduced_flow"]["ball"], metrics["timing"]["total"]["reduced_flow"]
    rows["squeeze"]["iterations"].update(median=3.0, p99=9.0)
    rows["linear_combination"]["iterations"].update(median=4.0, p99=8.0)
    total["linear_combination"]["best"].update(median=5.0, p99=6.0)
    total["squeeze"]["best"].update(median=4.0, p99=7.0)
    told = "median 3, p99 9 against median 4, p99 8; p50 4 against 5 us, p99 7 against 6 us"
    assert (against("squeeze")["measured"], against("squeeze")["met"]) == (told, True)
    total["squeeze"]["best"].update(median=5.5)
    assert against("squeeze")["met"] is False
    count = rows["outside"]["cases"]
    assert (against("outside")["measured"], against("outside")["met"]) == (f"no start on {count} of {count}", False)
    assert against("learned fitted")["kind"] == "reference"


def test_what_a_start_raises_is_told_by_its_given_name_and_cut_between_words():
    def raises(grasp, wrench):
        raise ValueError("many words " * 30)

    (why,) = (str(told) for told in roll_out_scenario("gravity", {"boom": raises}, 1, 0, Objective(), 5).values())
    assert why.startswith("does not begin: initial-force rule 'boom' fails with ValueError: many words")
    assert why.endswith(("many …", "words …"))
    starts = make_starts(Objective(), {"boom": raises})
    (text,) = set(compare("ball", cases_of("ball", 2, 0), starts, {}, Objective())["boom/reason"].tolist())
    assert text.startswith("ValueError: many words")
    assert text.endswith(("many …", "words …"))


def test_a_rule_of_the_package_without_a_row_is_compared_too(monkeypatch):
    """One entry of `RULES` is all that a new rule needs."""
    monkeypatch.setitem(RULES, "newest", StartRule("the newest of all", SingleValue))
    rules = Given().rules(Objective())
    assert list(rules) == ["newest"]
    assert (row_of("newest").label, row_of("newest").short) == ("the newest of all", "the newest of all")
    trials = compare("ball", cases_of("ball", 2, 0), make_starts(Objective(), rules), {}, Objective())
    assert start_metrics(trials, "newton")["newest"]["cases"] == 2


@pytest.mark.parametrize(
    ("start", "told"),
    [
        ("lagrange={}:unbalanced", "the name lagrange is taken"),
        ("optimum={}:unbalanced", "the name optimum is taken"),
        ("a/b={}:unbalanced", "needs a name of letters"),
        ("mine=nowhere_at_all:rule", "nowhere_at_all is not there"),
        ("mine=nowhere.py:rule", "nowhere.py is not there"),
        ("mine={}:two", "is no rule but of type int: a rule takes"),
        ("mine={}:three", "has no 'three'; it has LinearCombination, Sometimes, unbalanced, outside"),
        ("mine={}", "is no start: give NAME=module:rule"),
        ("mine=", "is no start"),
        ("mine=runs/fit/foo_finger", "no such file or saved model is there (runs/fit/foo_finger.json is missing, too)"),
        ("mine=.", "holds no saved model"),
        ("mine=there.json", "there.json"),
    ],
)
def test_a_start_that_is_none_is_told_before_anything_runs(own, tmp_path, start, told, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = own[0].partition("=")[2].rpartition(":")[0]
    assert main(["evaluate", "--out", str(tmp_path), "--start", start.format(file)]) == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_starts_belong_to_the_comparison_of_starts(capsys):
    assert main(["evaluate", "env", "--start", "mine=pathlib:Path"]) == 2
    assert "--start belongs to" in capsys.readouterr().err


def test_all_faults_of_starts_are_told_at_once():
    with pytest.raises(
        InvalidInputError,
        match=r"the name mine is taken.*x=y: no such file or saved model is there.*mine is no rule but of type int",
    ):
        Given.of(("mine=pathlib:Path", "x=y"), {"mine": 3})
    lock = threading.Lock()
    with pytest.raises(InvalidInputError, match="cannot be sent to the worker processes"):
        Given.of((), {"mine": lambda grasp, wrench: lock})
    with pytest.raises(InvalidInputError, match="at most 8 starts"):
        Given.of((), {f"start_{k}": max for k in range(9)})


def test_metrics_rebuild_without_solving(run, metrics, monkeypatch):
    monkeypatch.setattr("grasp_env.force.ForceOptimizer.solve", None)
    monkeypatch.setattr("grasp_env.sim.Scene.step", None)
    again = metrics_of(run)
    run.write_json("again.json", again)
    assert run.read_json("again.json") == metrics
    run.path("again.json").unlink()


def test_report_command_rebuilds(run, monkeypatch, capsys):
    monkeypatch.setattr("grasp_env.force.ForceOptimizer.solve", None)
    assert main(["report", str(run.folder)]) == 0
    assert run.path("report.html").is_file()
    assert "report.html" in capsys.readouterr().out.replace("\n", "")


def test_claims_can_fail_and_be_met(metrics):
    row, text = (
        metrics["starts"]["reduced_flow"]["ball"]["network"],
        "network alone, fixed grasp: iterations of the flow",
    )
    for median, p99, met in ((8.0, 60.0, True), (9.0, 60.0, False), (8.0, 61.0, False)):
        row["iterations"].update(median=median, p99=p99)
        assert verdicts(metrics, text) == [met]
    row["iterations"].update(median=0.0, p99=0.0)
    for name, value in (("no_start", 1), ("margin_min", 0.0)):
        changed = copy.deepcopy(metrics)
        changed["starts"]["reduced_flow"]["ball"]["network"][name] = value
        assert verdicts(changed, text) == [False]
    metrics["rollouts"]["constant"]["linear_combination"]["max_drift_mm"] = 1.5
    assert verdicts(metrics, "scenario constant") == [False]
    metrics["guarantee"]["learned_fixed"]["worse"] = 1
    assert verdicts(metrics, "learned, fixed grasp: starts worse") == [False]


def test_the_fastest_from_cold_is_named(metrics):
    total = metrics["timing"]["total"]
    for rows in total.values():
        for key, row in rows.items():
            row["best"].update(median=10.0, p99=12.0) if key not in ("previous_tangent", "learned_previous") else None
    total["newton"]["previous_tangent"]["best"].update(median=0.1, p99=0.1)  # not from cold
    total["newton"]["nearest_tangent"]["best"].update(median=1.0)

    def fastest():
        return next(row for row in claims(metrics) if row["claim"].startswith("fastest certified solve from cold"))

    for median, p99, met in ((8.4, 11.3, True), (8.6, 11.3, False), (8.4, 11.5, False)):
        total["newton"]["learned_fixed"]["best"].update(median=median, p99=p99)
        assert fastest()["measured"].startswith("winner: nearest of 10,000 stored, tangent, Newton: p50 1, ")
        assert fastest()["met"] is met
    total["newton"]["learned_fixed"]["best"].update(median=0.9)
    assert fastest()["measured"].startswith("winner: learned, fixed grasp, Newton: p50 0.9, ")


def test_what_was_found_is_what_the_numbers_say(metrics):
    rows, total = metrics["starts"]["reduced_flow"]["ball"], metrics["timing"]["total"]
    rows["squeeze"]["iterations"].update(median=0.0, p99=0.0)  # fewer than any learned start
    rows["network_newton_2"]["iterations"].update(median=1.0, p99=2.0)
    rows["basis_newton_2"]["iterations"].update(median=1.0, p99=2.0)
    for sets in total.values():
        for row in sets.values():
            row["best"].update(median=10.0, p99=12.0)
    total["newton"]["linear_combination"]["best"].update(median=5.0, p99=6.0)

    def found(about):
        (said,) = [text for text in findings(metrics) if text.startswith(f"{about}: ")]
        return said.replace("\xa0", " ")

    assert "“squeeze” 0 / 0 iterations and 10 / 12 µs" in found("Given starts")
    count = rows["outside"]["cases"]
    assert f"“outside” gave no start on {count} of {count} wrenches" in found("Given starts")
    assert "soonest from " in found("Fewest iterations")
    assert "“squeeze”" in found("Fewest iterations").partition(" (median")[0]
    assert "1 / 2, control (2 steps) 1 / 2, no gain." in found("What is learned")
    rows["basis_newton_2"]["iterations"].update(median=2.0, p99=25.0)
    assert "control (2 steps) 2 / 25, a gain of 1 in the median and a gain in the tail." in found("What is learned")
    rows["basis_newton_2"]["iterations"].update(median=1.0, p99=1.0)
    assert "control (2 steps) 1 / 1, a loss of 1 in the tail alone." in found("What is learned")
    rows["basis_newton_2"]["iterations"].update(p99=2.0)
    assert "Newton from “12-basis”, p50 / p99 5 / 6 µs" in found("Least time")
    assert "beats every learned start in time, whichever the method (p50 10 µs)" in found("Least time")
    total["newton"]["learned_fixed"]["best"].update(median=2.0)
    assert "beats every learned start (p50 10 µs) but Newton from “learned, fixed” (2)." in found("Least time")
    total["newton"]["linear_combination"]["best"].update(median=20.0)
    assert "is beaten by every learned start, whichever the method (p50 2 to 10 µs)" in found("Least time")
    assert verdicts(metrics, "learned, fixed grasp, by the flow or by Newton: faster than plain Newton") == [True]
    total["newton"]["linear_combination"]["best"].update(median=1.9)
    assert verdicts(metrics, "learned, fixed grasp, by the flow or by Newton: faster than plain Newton") == [False]
    del rows["linear_combination"], total["newton"]["linear_combination"], rows["basis_newton_2"]
    assert "12-basis" not in found("Fewest iterations") + found("Least time")
    metrics["timing"] = {}
    metrics["starts"]["reduced_flow"] = {}
    assert findings(metrics) == []


def test_what_was_not_measured_is_said(metrics):
    for rows in metrics["starts"]["reduced_flow"].values():
        rows.pop("learned_previous", None)
    row = next(
        row for row in claims(metrics) if row["claim"].startswith("learned, with the previous solution: random walk")
    )
    assert (row["met"], row["measured"]) == (None, "not measured in this run")


def test_who_wins(metrics):
    rows = metrics["starts"]["reduced_flow"]["jump_100"]
    for key in ("basis_tangent", "basis_newton", "previous_pseudoinverse"):
        rows.pop(key, None)  # each side's other entries
    entries = {"learned_fixed": (1, 10), "previous_tangent": (20, 60), "linear_combination": (40, 110)}
    for key, (median, p99) in entries.items():
        rows[key]["iterations"].update(median=median, p99=p99)

    def winner():
        return next(row["winner"] for row in wins(metrics) if row["set"] == "jump_100")

    assert winner() == "learned"
    rows["previous_tangent"]["iterations"].update(median=0, p99=10)
    assert winner() == "tie"
    rows["previous_tangent"]["iterations"].update(p99=5)
    assert winner() == "previous"


def test_an_interrupted_run_goes_on(run, tmp_path, monkeypatch):
    """What is whole stays, other settings are refused, and the results are those of a run that was not interrupted."""
    half = Run.create(tmp_path, "half")
    for path in [*(f"trials/{name}.npz" for name in SETS if name != "constant"), "plan.json", "fit.json", "timing.npz"]:
        half.path(path).write_bytes(run.path(path).read_bytes())
    for path in run.folder.glob("model/*"):
        half.path(f"model/{path.name}").write_bytes(path.read_bytes())
    plan_before, config = half.read_json("plan.json"), run.read_json("config.json")
    wanted = EvaluateConfig(
        **{
            **config,
            "out": str(tmp_path),
            "name": "half",
            "fit": FitConfig(**{**config["fit"], "hidden": tuple(config["fit"]["hidden"])}),
            "start": tuple(config["start"]),
        }
    )
    with pytest.raises(InvalidInputError, match="other settings"):
        evaluate(EvaluateConfig(out=str(tmp_path), name="half", **{**SMALL, "wrenches": 7}), Console(quiet=True))
    asked = []

    def stop(run, jobs, workers):
        asked.extend(job.name for job in jobs)
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate_module, "run_jobs", stop)
    with pytest.raises(KeyboardInterrupt):
        evaluate(wanted, Console(quiet=True), squeezing())
    assert set(asked) == {job for job in plan() if not job.startswith("trials/")} | {"trials/constant"}
    assert half.read_json("plan.json") == plan_before
    given = Given.of((f"{FITTED}={half.path(evaluate_module.MODEL)}", *wanted.start), squeezing())
    again = evaluate_module.work("trials/constant", wanted, given)
    first = run.read_arrays("trials/constant.npz")
    assert again.keys() == first.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(again[name], array, err_msg=name)


def test_settings_are_checked():
    with pytest.raises(InvalidInputError, match="repeats must be an integer >= 1"):
        EvaluateConfig(repeats=0)
    with pytest.raises(InvalidInputError, match="fit_seconds must be a number within 0 to"):
        EvaluateConfig(fit_seconds=float("nan"))
    quick = EvaluateConfig(quick=True, episodes=1, fit_seconds=3.0).resolved()
    assert (quick.wrenches, quick.fit.seconds) == (50, 3.0)
    assert quick.name.startswith("evaluate-")


def test_summary_and_ratio():
    values = np.concatenate([np.zeros(50), np.ones(50)])
    got = spread(values)
    assert (got["n"], got["max"], got["p95"]) == (100, 1.0, 1.0)
    assert got["median_low"] <= got["median"] <= got["median_high"]
    assert spread(np.empty(0))["median"] is None
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


def test_cli_errors(tmp_path, capsys):
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
