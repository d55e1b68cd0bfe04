"""Episodes are counted right and depend on their seed alone; plans are sound."""

from __future__ import annotations

import json
import os
from dataclasses import asdict

import numpy as np
import pytest
import trimesh
from engines import needs_bullet

from grasp_env.errors import InvalidInputError, SimulationError
from training.evaluation.compare import holds, scenarios
from training.evaluation.compare.holds import (
    HoldsConfig,
    draw_object,
    episode_columns,
    run,
    settings_of,
    trial,
    work,
)
from training.evaluation.compare.scenarios import RANDOM_WRENCH, Scenario, mesh_settings
from training.evaluation.results.run import Run
from training.evaluation.results.table import summary
from training.program.cli import main

SHORT = {"disturbance": "random", "duration": 0.1}
OBJECT = ("shape", "size_x", "size_y", "size_z", "mass", "friction")


def info(**changes):
    """The report of a step of the environment."""
    force = np.array([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    return {
        "fault": "",
        "is_success": True,
        "overlap": 2e-5,
        "stray_share": 0.01,
        "saturated": 0.0,
        "drift": 1e-4,
        "tilt": 0.01,
        "slip_distance": 2e-4,
        "force_error": 0.1,
        "stray_force": 0.0,
        "torque_margin": 0.3,
        "limited": 1,
        "iterations": 40,
        "status": "optimal",
        "time": 0.1,
        "measured_force": force,
        "commanded_force": 2.0 * force,
        "peak_torque": 0.5,
        "touching": np.array([True, True]),
        "contact_changes": 0,
        **changes,
    }


def test_columns_of_an_episode():
    steps = [
        info(drift=5e-4),
        info(drift=3e-4, tilt=0.02, iterations=20, time=0.2, stray_force=0.7, torque_margin=0.1),
    ]
    row = episode_columns(steps)
    assert (row["held"], row["failure"]) == (True, None)
    assert (row["drift"], row["end_drift"]) == pytest.approx((0.5, 0.3))  # millimetres
    assert row["tilt"] == pytest.approx(np.degrees(0.02))
    assert row["slip"] == row["end_slip"] == pytest.approx(0.2)
    assert (row["overlap"], row["stray_share"]) == (pytest.approx(0.02), 0.01)
    assert (row["iterations"], row["limited"], row["time"], row["stray_force"]) == (30, 2, 0.2, 0.7)
    assert (row["normal_force"], row["commanded_force"], row["torque_margin"]) == (3.0, 6.0, 0.1)
    assert row["contact_always"]
    assert not episode_columns([info(touching=np.array([True, False])), info()])["contact_always"]


def test_failures_have_causes_and_no_drift():
    for last, failure in (
        ({"fault": "slid"}, "slid"),
        ({"fault": "dropped", "saturated": 0.5}, "torque"),
        ({"fault": "dropped", "saturated": 0.5, "drift": 2e-3}, "dropped"),
    ):
        row = episode_columns([info(), info(is_success=False, **last)])
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
    assert (item.mass, redrawn, len(points)) == (first["mass"], first["redrawn"], 4)


def test_grasps_that_do_not_begin_are_not_held(monkeypatch):
    row = trial({**SHORT, "mass": 300.0}, False, 0)
    assert (row["failure"], row["held"]) == ("no_start", False)
    assert "settle" in row["detail"]
    for error, failure in ((InvalidInputError, "not_placed"), (SimulationError, "no_start")):

        def refuse(error=error, **settings):
            raise error("cannot reach the object")

        monkeypatch.setattr(holds, "FourFingerGrasp", refuse)
        row = trial(SHORT, False, 0)
        assert (row["held"], row["failure"]) == (False, failure)
        assert row["detail"] == "cannot reach the object"


@needs_bullet
def test_a_seed_is_the_same_object_in_every_engine():
    pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")
    rows = work((Scenario("objects", {"hand": "four_finger"}, 2, SHORT, scenarios.BOTH), (3, 4)))
    assert rows["engine"].tolist() == ["bullet", "mujoco"] * 2
    assert rows["seed"].tolist() == [3, 3, 4, 4]
    for seed in (3, 4):
        one, other = rows[rows["seed"] == seed].to_dict("records")
        mine, theirs = ({name: row.get(name) for name in OBJECT} for row in (one, other))
        assert mine == theirs
        assert one["end_drift"] != other["end_drift"]  # they are different engines
        assert other["normal_force"] == pytest.approx(one["normal_force"], rel=0.01)


@needs_bullet
def test_objects_of_mesh_files_are_held(tmp_path):
    path = str(tmp_path / "brick.stl")
    trimesh.creation.box((50, 50, 50)).export(path)
    engines = ("bullet", "faces")
    plan = HoldsConfig("objects", ("allegro",), engines, objects=(f"{path}=0.001",)).plan()
    rows = work((next(scenario for scenario in plan if scenario.case == "mesh_gravity"), (0,)))
    assert rows["held"].all()
    assert [*zip(rows["object"], rows["engine"], strict=True)] == [("brick", e) for e in engines]
    np.testing.assert_allclose(rows["mass"], 0.15)


PLAN = [
    Scenario("objects", {"controller": "paper"}, 5, SHORT),
    Scenario("objects", {"controller": "pd"}, 1, {**SHORT, "controller.kind": "pd"}),
    Scenario(
        "friction",
        {"controller": "paper"},
        1,
        {**SHORT, "mass": 300.0},
        random_objects=False,
    ),
]


def test_begun_runs_continue(tmp_path, monkeypatch):
    config = HoldsConfig(seed=7)
    rows, _ = run(config, plan=PLAN, workers=1)
    assert rows["seed"].tolist() == [*range(7, 12), 7, 7]
    means = summary(rows)
    assert means[["case", "controller", "n", "held_sum"]].to_numpy().tolist() == [
        ["objects", "paper", 5, 5.0],
        ["objects", "pd", 1, 1.0],
        ["friction", "paper", 1, 0.0],
    ]
    folder = Run.create(tmp_path, "again")
    assert run(config, folder, PLAN, on="inline")[0].equals(rows)
    monkeypatch.setattr(holds, "trial", None)  # finished shards are kept
    assert run(config, folder, PLAN, on="inline")[0].equals(rows)


def test_plans_are_sound(tmp_path):
    objects = HoldsConfig(
        "objects", ("allegro", "leap"), episodes=5, objects=("parts/duck.obj=0.06", "mug.stl")
    ).plan()
    hands = scenarios.hands_plan(("leap", str(tmp_path / "mine.urdf")), ("bullet",), 50)
    controllers = scenarios.controllers_plan(500)
    transfer = scenarios.transfer_plan(("four_finger", "allegro"), 300)
    soft = HoldsConfig("soft").plan()
    for plan in (controllers, [*transfer, *hands], objects, soft):
        assert len({one.name for one in plan}) == len(plan)
        assert all(
            {*one.engines} <= {*scenarios.ENGINES} and one.case in scenarios.LABELS for one in plan
        )
        json.dumps([asdict(one) for one in plan], allow_nan=False)
    episodes = {one.name: one.episodes for one in (*controllers, *transfer, *hands, *soft)}
    for name, count in {
        "objects/paper": 500,
        "objects/pd": 500,
        "six_directions/paper": 500,
        "six_directions/pd": 62,
        "path_1/paper": 1,
        "weak/allegro": 300,
        "estimated/four_finger": 300,
        "contacts/four_finger": 100,
        "soft/jaws": 100,
        "soft_pyramid/three_finger": 50,
        "cube_gravity/mine": 1,
        "random_gravity/mine": 50,
        "cube_random/mine": 50,
    }.items():
        assert episodes[name] == count, name
    settings = {one.name: one.settings for one in controllers}
    assert settings["objects/pd"] == {**RANDOM_WRENCH, **scenarios.CONTROLLERS["pd"]}
    for one in objects:
        assert one.episodes == (5 if one.case == "mesh_random" else 1)
    assert mesh_settings("C:\\parts\\mug.stl=0.001")[0] == "mug"
    for text in ("lr=2/mug.stl=1", "lr=2/mug.stl"):
        assert mesh_settings(text)[1]["object"]["mesh"] == "lr=2/mug.stl"


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["env"],
        ["env", "--hands", "four_finger"],
        ["transfer", "--hands", "four_finger"],
        ["soft"],
        ["errors"],
    ],
)
def test_quick_runs_from_the_command_line(words, tmp_path, capsys):
    assert main(["evaluate", *words, "--quick", "--out", str(tmp_path), "--name", "q"]) == 0
    assert capsys.readouterr().out.startswith("QUICK RUN")
    assert "Quick run." in (tmp_path / "q" / "report.html").read_text()
    assert os.path.getsize(tmp_path / "q" / "rows.csv.xz") > 1000
