"""Episodes are counted right, depend on their seed alone, and are the same whatever runs them."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace

import numpy as np
import pytest
from engines import needs_bullet
from rich.console import Console

from grasp_env.errors import InvalidInputError, SimulationError, UnknownNameError
from grasp_env.sim.engine import engine_of
from training.cli import main
from training.compare import holds
from training.compare.holds import (
    NO_START,
    HoldsConfig,
    Shard,
    draw_object,
    episode_columns,
    run,
    settings_of,
    trial,
    work,
)
from training.compare.scenarios import (
    BOTH,
    CONTROLLERS,
    ENGINES,
    LABELS,
    RANDOM_WRENCH,
    Scenario,
    controllers_plan,
    hands_plan,
    short_name,
    transfer_plan,
)  # fmt: skip
from training.results.run import Run
from training.results.table import summary

QUIET = Console(quiet=True)
SHORT = {"disturbance": "random", "duration": 0.1}
OBJECT = ("shape", "size_x", "size_y", "size_z", "mass", "friction")


def info(**changes):
    """What a step of the environment reports."""
    force = np.array([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    return {
        "fault": "", "is_success": True, "overlap": 2e-5, "stray_share": 0.01, "saturated": 0.0, "drift": 1e-4, "tilt": 0.01, "slip_distance": 2e-4, "force_error": 0.1,
        "stray_force": 0.0, "torque_margin": 0.3, "limited": 1, "iterations": 40, "status": "optimal", "time": 0.1,
        "measured_force": force, "commanded_force": 2.0 * force, "peak_torque": 0.5, "touching": np.array([True, True]),
        "contact_changes": 0, **changes,
    }  # fmt: skip


def test_an_episode_comes_to_what_its_steps_say():
    row = episode_columns(
        [info(), info(drift=3e-4, tilt=0.02, iterations=20, time=0.2, stray_force=0.7, torque_margin=0.1)]
    )
    assert (row["held"], row["failure"]) == (True, None)
    assert row["drift"] == row["end_drift"] == pytest.approx(0.3)  # millimetres
    assert row["tilt"] == pytest.approx(np.degrees(0.02))
    assert row["slip"] == row["end_slip"] == pytest.approx(0.2)
    assert (row["overlap"], row["stray_share"]) == (pytest.approx(0.02), 0.01)
    assert (row["iterations"], row["limited"], row["time"], row["stray_force"]) == (30, 2, 0.2, 0.7)
    assert (row["normal_force"], row["commanded_force"]) == (3.0, 6.0)
    assert row["torque_margin"] == 0.1
    assert row["contact_always"]
    assert not episode_columns([info(touching=np.array([True, False])), info()])["contact_always"]


@pytest.mark.parametrize(
    ("last", "failure"),
    [
        ({"fault": "dropped", "is_success": False}, "dropped"),
        ({"fault": "slid", "is_success": False}, "slid"),
        ({"fault": "dropped", "is_success": False, "saturated": 0.5}, "torque"),
        ({"fault": "dropped", "is_success": False, "saturated": 0.5, "drift": 2e-3}, "dropped"),
    ],
)
def test_a_failure_has_its_cause_and_no_drift_of_what_was_held(last, failure):
    row = episode_columns([info(), info(**last)])
    assert (row["held"], row["failure"]) == (False, failure)
    assert not {"drift", "tilt", "slip"} & {*row}
    assert row["end_drift"] == 1e3 * last.get("drift", 1e-4)


def test_an_episode_depends_on_its_seed_alone():
    first, again, other = (trial(SHORT, True, seed) for seed in (3, 3, 4))
    assert first == again
    assert first["mass"] != other["mass"]
    squeezed = trial({**SHORT, "controller.kind": "constant_squeeze"}, True, 3)
    assert [squeezed[name] for name in OBJECT] == [first[name] for name in OBJECT]
    assert first["time"] == pytest.approx(0.1)
    item, points, redrawn = draw_object(3, settings_of(SHORT))
    assert (item.mass, redrawn) == (first["mass"], first["redrawn"])
    assert len(points) == 4


def test_a_grasp_that_does_not_settle_counts_as_not_held():
    row = trial({**SHORT, "controller.friction_error": 2.0}, False, 0)
    assert (row["failure"], row["held"]) == (NO_START, False)
    assert "settle" in row["detail"]


@pytest.mark.parametrize(("error", "failure"), [(InvalidInputError, "not_placed"), (SimulationError, "no_start")])
def test_a_hand_without_a_place_and_one_that_does_not_take_hold_are_told_apart(error, failure, monkeypatch):
    def refuse(**settings):
        raise error("cannot reach the object")

    monkeypatch.setattr(holds, "FourFingerGrasp", refuse)
    row = trial(SHORT, False, 0)
    assert (row["held"], row["failure"], row["detail"]) == (False, failure, "cannot reach the object")
    assert "normal_force" not in row


@needs_bullet
def test_a_seed_is_the_same_object_in_every_engine():
    pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    shard = Shard(Scenario("objects", {"hand": "four_finger"}, 2, SHORT, BOTH), (3, 4))
    rows = work(shard)
    assert rows["engine"].tolist() == ["bullet", "mujoco"] * 2
    assert rows["seed"].tolist() == [3, 3, 4, 4]
    for seed in (3, 4):
        one, other = rows[rows["seed"] == seed].to_dict("records")
        assert [one[name] for name in OBJECT if name in one] == [other[name] for name in OBJECT if name in other]
        assert one["end_drift"] != other["end_drift"]  # they are different engines
        assert other["normal_force"] == pytest.approx(one["normal_force"], rel=0.01)
    assert rows.equals(work(shard))


PLAN = [
    Scenario("objects", {"controller": "paper"}, 5, SHORT),
    Scenario("objects", {"controller": "pd"}, 2, {**SHORT, "controller.kind": "pd"}),
    Scenario("friction", {"controller": "paper"}, 1, {**SHORT, "controller.friction_error": 2.0}, random_objects=False),
]


def test_workers_do_not_matter_an_interrupted_run_goes_on_and_every_episode_counts(tmp_path, monkeypatch):
    config = HoldsConfig(seed=7)
    rows, about = run(config, plan=PLAN, workers=2, console=QUIET)
    assert rows["seed"].tolist() == [*range(7, 12), 7, 8, 7]
    assert about["scenarios"] == [asdict(scenario) for scenario in PLAN]
    assert about["steps_per_second"].keys() == {f"four_finger, {engine_of().name}"}
    means = summary(rows)
    assert means[["case", "controller", "n", "held_sum"]].to_numpy().tolist() == [
        ["objects", "paper", 5, 5.0], ["objects", "pd", 2, 2.0], ["friction", "paper", 1, 0.0],
    ]  # fmt: skip
    folder, real, seen = Run.create(tmp_path, "again"), holds.trial, []

    def stopping(settings, random_objects, seed, rule=None):
        if len(seen) == 6:
            raise KeyboardInterrupt
        seen.append(seed)
        return real(settings, random_objects, seed, rule)

    monkeypatch.setattr(holds, "trial", stopping)
    with pytest.raises(KeyboardInterrupt):
        run(config, folder, PLAN, on="inline", console=QUIET)
    seen.clear()
    again, _ = run(config, folder, PLAN, on="inline", console=QUIET)
    assert seen == [7, 8, 7]  # the finished shards of the first scenario are kept
    assert again.equals(rows)


def test_plans_are_sound():
    plan = controllers_plan(500)
    assert len({one.name for one in plan}) == len(plan)
    assert {one.case for one in plan} <= {*LABELS}
    episodes = {one.name: one.episodes for one in plan}
    assert episodes["objects/paper"] == episodes["objects/pd"] == episodes["six_directions/paper"] == 500
    assert episodes["six_directions/pd"] == 62
    assert (episodes["mild/paper/0.6"], episodes["mild/pd/40"], episodes["path_1/paper"]) == (100, 60, 1)
    settings = {one.name: one.settings for one in plan}
    assert settings["objects/paper"] == RANDOM_WRENCH
    assert settings["friction/pd"] == {
        **RANDOM_WRENCH,
        **CONTROLLERS["pd"],
        "controller.friction_error": 0.25,
        "controller.friction_margin": 0.6,
    }
    assert "controller.friction_margin" not in settings["friction/paper"]
    assert settings["mild/paper/0.3"]["controller.friction_margin"] == 0.3
    assert settings["all/pd/120"]["controller.squeeze"] == 120.0
    assert not next(one for one in plan if one.name == "path_1/paper").random_objects
    assert sum(one.episodes for one in controllers_plan(4, True)) < 160


def test_plans_of_hands_and_engines(tmp_path):
    plan = transfer_plan(("four_finger", "allegro"), 300)
    both = plan + hands_plan(("leap", str(tmp_path / "mine.urdf")), ("bullet",), 50)
    assert len({one.name for one in both}) == len(both)
    assert all({*one.engines} <= {*ENGINES} and one.case in LABELS for one in both)
    json.dumps([asdict(one) for one in both], allow_nan=False)
    episodes = {one.name: one.episodes for one in both}
    assert episodes["weak/allegro"] == episodes["estimated/four_finger"] == 300
    assert episodes["all_safe/four_finger"] == 100
    assert episodes["cube_gravity/mine"] == 1
    assert episodes["random_gravity/mine"] == episodes["cube_random/mine"] == 50
    assert short_name("four_finger") == "four_finger"
    pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    for name, settings in ENGINES.items():
        rate = settings_of({"hand": "four_finger", **settings}).engine.rate
        assert rate == (250 if name in ("bullet", "faces") else 1000)


def test_hands_and_engines_must_exist_and_differ(tmp_path):
    with pytest.raises(
        UnknownNameError,
        match=r"unknown hand 'nobody': choose one of .* or the path of a URDF, xacro or MJCF file that exists",
    ):
        HoldsConfig("hands", ("nobody",))
    with pytest.raises(InvalidInputError, match="different names"):
        HoldsConfig("transfer", ("four_finger", "four_finger"))
    with pytest.raises(UnknownNameError, match="unknown hand"):
        HoldsConfig("hands", (str(tmp_path / "none.urdf"),))
    with pytest.raises(UnknownNameError, match="unknown engine 'havok': choose one of 'bullet', 'mujoco'"):
        HoldsConfig("hands", ("four_finger",), ("havok",))
    with pytest.raises(InvalidInputError, match="at least one hand"):
        HoldsConfig("hands")
    with pytest.raises(InvalidInputError, match="episodes"):
        HoldsConfig(episodes=-1)
    quick = replace(HoldsConfig("hands", ("allegro",)), quick=True).plan()
    assert {one.episodes for one in quick} == {1, 2}
    assert all(one.settings["hand"] == "allegro" for one in quick)


@pytest.mark.slow
@pytest.mark.parametrize("words", [["env"], ["env", "--hands", "four_finger"], ["transfer", "--hands", "four_finger"]])
def test_quick_runs_from_the_command_line(words, tmp_path, capsys):
    assert main(["evaluate", *words, "--quick", "--out", str(tmp_path), "--name", "q"]) == 0
    assert capsys.readouterr().out.startswith("QUICK RUN")
    assert "Quick run." in (tmp_path / "q" / "report.html").read_text()
    assert os.path.getsize(tmp_path / "q" / "rows.parquet") > 1000
