"""Engines and hands side by side: counted right from hand-made trials; seeds are paired; reports rebuild without simulating."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from grasp_env.errors import InvalidInputError, UnknownNameError
from training.cli import main
from training.report.build import build_report
from training.report.hands import build_hands_report, build_transfer_report
from training.runs import Run
from training.trials import holds
from training.trials.hand_metrics import chance, hand_metrics, transfer_metrics
from training.trials.hand_plan import BOTH, ENGINES, Scenario, hands_plan, short_name, transfer_plan
from training.trials.hand_trials import evaluate_hands, evaluate_transfer, run_chunk
from training.trials.hold_plan import NO_START, NOT_PLACED
from training.trials.holds import _NUMBERS, columns, settings_of
from training.trials.settings import HandsConfig, TransferConfig

QUIET = Console(quiet=True)
WEAK = "the grasp did not settle within 0.6 s: joints at their torque limits: a (0.3 N m). No force; links push each other: b and c"


def made(outcomes: dict[str, list[str]], drift: dict[str, float] | None = None, **own: float) -> dict[str, np.ndarray]:
    """Trials of seeds 0, 1, ... with these failures ("": held), engine by engine."""
    rows = []
    for engine, failures in outcomes.items():
        for seed, failure in enumerate(failures):
            gone = failure in (NO_START, NOT_PLACED)
            numbers = (
                dict.fromkeys(_NUMBERS, np.nan) if gone else dict.fromkeys(_NUMBERS, 1.0) | {"cut_in_place": 0.0, **own}
            )
            numbers["max_drift"] = (drift or {}).get(engine, 1e-4) * (1.0 + 0.1 * (seed % 3))
            rows.append({
                "engine": engine, "seed": seed, "redrawn": 0, "shape": "sphere", "size_x": 0.05, "size_y": 0.0, "size_z": 0.0, "mass": 0.1,
                "friction": 0.5, "failure": failure, "detail": WEAK if gone else "", "status": "optimal", "held": not failure, **numbers,
            })  # fmt: skip
    return columns(rows)


def scenario(name: str = "hand/objects", count: int = 20) -> dict[str, Any]:
    return asdict(Scenario(name, "hand", "random objects", BOTH, count, {}))


def test_engines_are_compared_pair_by_pair():
    trials = made({"bullet": [""] * 18 + ["dropped"] * 2, "mujoco": ["closure_lost"] * 8 + [""] * 12}, {"mujoco": 3e-4})
    metrics = transfer_metrics([scenario()], {"hand/objects": trials})
    first, second = metrics["rows"]
    assert (first["held"], second["held"], first["against"]) == (18, 12, None)
    against = second["against"]
    assert (against["only_this"], against["only_base"], against["pairs"]) == (2, 8, 20)
    assert against["held"]["mean"] == pytest.approx(-0.3)
    assert against["chance"] == pytest.approx(2 * (1 + 10 + 45) / 2**10)
    (only,) = metrics["claims"]
    assert only["met"] is False
    assert "12 of 20" in only["measured"]
    drifts, same = metrics["findings"]
    assert "what is held drifts by 0.33 mm in MuJoCo, by 0.11 mm in Bullet" in drifts
    assert same.startswith("No difference beyond chance (5 %) in 1 comparisons")
    json.dumps(metrics, allow_nan=False)


def test_what_falls_in_one_engine_is_a_finding():
    trials = made({"bullet": [""] * 20, "mujoco": ["closure_lost"] * 9 + ["dropped"] + [""] * 10})
    (found,) = transfer_metrics([scenario()], {"hand/objects": trials})["findings"]
    assert (
        "MuJoCo holds 10 of 20, Bullet 20. 0 pairs are held by the former alone, 10 by the latter alone (chance 0.002)"
        in found
    )
    assert "What falls: 9 closure lost, 1 dropped." in found


def test_equal_engines_meet_the_claim():
    trials = made({"bullet": ["dropped"] + [""] * 19, "mujoco": [""] * 20})
    metrics = transfer_metrics([scenario()], {"hand/objects": trials})
    assert metrics["claims"][0]["met"] is True
    assert chance(1, 0) == 1.0


def test_causes_name_torques_and_what_did_not_start():
    trials = made(
        {"bullet": [NO_START, NOT_PLACED, "dropped", ""], "mujoco": [""] * 4}, cut_in_place=1.0, torque_margin=0.25
    )
    row = hand_metrics([scenario(count=4)], {"hand/objects": trials})["rows"][0]
    assert row["failures"] == {NO_START: 1, NOT_PLACED: 1, "torque": 1}
    assert row["reasons"] == {"links touch each other": 2, "torque": 2}
    assert row["torque_margin"]["mean"] == row["least_margin"] == 0.25
    assert (row["started"], row["saturated"]) == (2, 2)


def test_plans_are_sound(tmp_path: Path):
    plan = transfer_plan(("four_finger", "allegro"), 300) + hands_plan(
        ("leap", str(tmp_path / "mine.urdf")), ("bullet",), 50
    )
    assert len({one.name for one in plan}) == len(plan)
    assert all(set(one.engines) <= set(ENGINES) for one in plan)
    json.dumps([asdict(one) for one in plan], allow_nan=False)
    episodes = {one.name: one.episodes for one in plan}
    assert episodes["allegro/objects"] == episodes["four_finger/estimated"] == 300
    assert episodes["mine/cube/gravity"] == 1
    assert episodes["mine/random/gravity"] == episodes["mine/cube/random"] == 50
    for name, settings in ENGINES.items():
        pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
        assert settings_of({"hand": "four_finger", **settings}).resolved().physics_rate == (
            250 if name == "bullet" else 1000
        )
    assert short_name("four_finger") == "four_finger"


@pytest.mark.parametrize("kind", [TransferConfig, HandsConfig])
def test_hands_must_exist_and_differ(kind: Any, tmp_path: Path):
    with pytest.raises(
        UnknownNameError, match=r"unknown hand 'nobody': choose one of .* or the path of a .urdf file that exists"
    ):
        kind(hands=("nobody",))
    with pytest.raises(InvalidInputError, match="different names"):
        kind(hands=("four_finger", "four_finger"))
    with pytest.raises(UnknownNameError, match="unknown hand"):
        kind(hands=(str(tmp_path / "none.urdf"),))
    with pytest.raises(InvalidInputError, match="episodes"):
        kind(hands=("four_finger",), episodes=0)


def test_commands_refuse_what_is_no_engine(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["evaluate", "env", "--hands", "four_finger", "--engines", "havok", "--out", str(tmp_path)]) == 2
    assert "havok" in capsys.readouterr().err
    with pytest.raises(UnknownNameError, match="unknown engine 'havok': choose one of 'bullet', 'mujoco'"):
        HandsConfig(hands=("four_finger",), engines=("havok",))
    with pytest.raises(InvalidInputError, match="at least one hand and one engine"):
        HandsConfig(hands=())


SHORT = {"disturbance": "random", "duration": 0.1}


def test_a_seed_is_the_same_object_in_every_engine():
    pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    rows = run_chunk(asdict(Scenario("a", "four_finger", "", BOTH, 2, SHORT)), [3, 4])
    assert [row["engine"] for row in rows] == ["bullet", "mujoco"] * 2
    for one, other in (rows[:2], rows[2:]):
        for name in ("seed", "shape", "size_x", "size_y", "size_z", "mass", "friction"):
            assert one[name] == other[name]
        assert other["mean_drift"] != one["mean_drift"]  # they are different engines
        assert other["normal_force"] == pytest.approx(one["normal_force"], rel=0.01)
        assert one["torque_margin"] > 0.0
    assert rows == run_chunk(asdict(Scenario("a", "four_finger", "", BOTH, 2, SHORT)), [3, 4])


def test_transfer_in_small_goes_on_where_it_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    plan = [Scenario(f"four_finger/{name}", "four_finger", name, BOTH, 1, SHORT) for name in ("objects", "estimated")]
    config = TransferConfig(out=str(tmp_path), name="t", workers=1, quick=True)
    real = holds.run_jobs

    def stopped(run: Run, jobs: list[Any], workers: int) -> Any:
        yield from real(run, jobs[:1], workers)
        raise KeyboardInterrupt

    monkeypatch.setattr(holds, "run_jobs", stopped)
    with pytest.raises(KeyboardInterrupt):
        evaluate_transfer(config, QUIET, plan)
    assert (tmp_path / "t/trials/four_finger/objects.npz").is_file()
    assert not (tmp_path / "t/run.json").exists()
    monkeypatch.setattr(holds, "run_jobs", real)
    with pytest.raises(InvalidInputError, match="begun with other"):
        evaluate_transfer(config, QUIET, plan[:1])
    run = evaluate_transfer(config, QUIET, plan)
    metrics = build_transfer_report(run)
    assert [row["held"] for row in metrics["rows"]] == [1] * 4
    assert set(metrics["run"]["speed"]["four_finger"]) == set(BOTH)
    page, text = run.path("report.html").read_text(), run.path("report.md").read_text()
    assert page.count("<img") == 3
    assert "What holds in one engine and falls in the other" in text
    assert "QUICK RUN" in text
    run.path("report.html").unlink()
    monkeypatch.setattr("training.trials.holds.FourFingerGrasp", None)
    assert build_report(Run(run.folder)) == metrics
    assert run.path("report.html").is_file()


def test_hands_in_small(tmp_path: Path):
    plan = [
        Scenario(
            "four_finger/cube/random", "four_finger", "cube", ("bullet",), 2, {"size": (0.1, 0.1, 0.1), **SHORT}, False
        )
    ]
    run = evaluate_hands(HandsConfig(hands=("four_finger",), out=str(tmp_path), name="h", workers=1), QUIET, plan)
    (row,) = build_hands_report(run)["rows"]
    assert (row["held"], row["episodes"], row["reasons"]) == (2, 2, {})
    assert 0.0 < row["least_margin"] < 12.0
    assert row["against"] is None
    text = run.path("report.md").read_text()
    assert "torque margin, mean [N m]" in text
    assert "QUICK" not in text


@pytest.mark.slow
def test_quick_runs_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    for words in (["transfer"], ["env"]):
        assert (
            main(["evaluate", *words, "--hands", "four_finger", "--quick", "--out", str(tmp_path), "--name", words[0]])
            == 0
        )
        assert capsys.readouterr().out.startswith("QUICK RUN")
        assert "QUICK RUN" in (tmp_path / words[0] / "report.md").read_text()
