"""The whole of `grasp evaluate` in small."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation.compare.small_run import CONFIG, HOLDS, NAMES, own_file, shrunk, small_run

from grasp_env.errors import GraspError
from training.evaluation.compare import comparison
from training.evaluation.compare.cases import SETS
from training.evaluation.compare.comparison import HELD_WITH, StartsConfig, plan, run
from training.evaluation.compare.given import Given
from training.evaluation.compare.holds import HoldsConfig
from training.evaluation.compare.methods import METHODS
from training.evaluation.compare.scenarios import HOLDS_OF_STARTS, RANDOM_STARTS
from training.evaluation.compare.starts import STARTS
from training.evaluation.results.columns import TIMES
from training.evaluation.results.table import chosen
from training.program.cli import main


def given() -> Given:
    own = own_file()
    return Given.of((f"sometimes={own}:Sometimes", f"outside={own}:outside"))


def test_plan_and_rows_are_complete():
    starts = (*HELD_WITH, "learned_fixed", "sometimes", "outside")
    assert {*plan(given())} == {
        *SETS,
        *(f"holds/{name}/{start}" for name in HOLDS_OF_STARTS for start in starts),
    }
    rows, about = small_run().folder.load()
    holds = [f"hold_{name}" for name in HOLDS]
    assert list(dict.fromkeys(rows["case"])) == [*NAMES, *holds, "model"]
    ball = rows[rows["case"] == "ball"]
    assert {*ball["start"]} == {*STARTS, "sometimes", "outside"}
    assert {*ball["method"]} == {*METHODS}
    assert about["given"].keys() == {"sometimes", "outside"}
    held = rows[rows["case"].isin(holds)]
    counts = held.groupby(["case", "start"]).size()
    for name in HOLDS:
        assert {*counts[f"hold_{name}"]} == {CONFIG.episodes if name in RANDOM_STARTS else 1}
    episodes = chosen(held, "case == 'hold_random' and start == 'linear_combination'")
    # every episode has a seed of its own
    assert episodes["normal_force"].nunique() == CONFIG.episodes
    assert 0 < rows["bytes"].iloc[-1] < 2_000_000


def test_given_starts_are_counted():
    rows = small_run().folder.load()[0]
    flow = chosen(rows, "method == 'reduced_flow'")
    assert {*chosen(flow, "case == 'ball' and start == 'outside'")["reason"]} == {
        "outside the cones"
    }
    sometimes = chosen(flow, "case == 'ball' and start == 'sometimes'")
    failed = sometimes[sometimes["status"] == "no_start"]
    assert 0 < len(failed) < len(sometimes)
    assert {*failed["reason"]} == {"ArithmeticError: not to the right"}
    assert {*chosen(flow, "case == 'hold_gravity' and start == 'outside'")["failure"]} == {
        "no_start"
    }


def test_times_are_of_the_first_problems():
    rows = small_run().folder.load()[0]
    timed = rows[rows["microseconds"].notna()]
    assert ((timed["microseconds"] > 0.0) & (timed["microseconds"] < 1e6)).all()
    assert {*timed["case"]} == {*comparison.TIMED_SETS}
    for _, of_set in timed.groupby("case"):
        assert of_set["problem"].max() == CONFIG.timed - 1
        inside = of_set[of_set["compiled_microseconds"].notna()]
        assert {"linear_combination", "internal_force", "learned_fixed"} <= {*inside["start"]}
        assert not {"sometimes", "learned_previous", "network"} & {*inside["start"]}
        assert inside["compiled_microseconds"].median() < inside["microseconds"].median()
    assert timed[timed["start"] == "outside"].empty
    assert (timed[timed["method"] == "reduced_flow"]["start_microseconds"] > 0.0).all()


def test_a_begun_run_continues_and_gives_the_rows_of_a_whole_one(tmp_path, monkeypatch):
    whole = small_run().folder.load()[0]
    folder = comparison.Run.create(tmp_path, "run")
    monkeypatch.setattr(comparison, "TIMED_SETS", ("ball",))
    with shrunk(("ball", "constant"), ("gravity",)):
        run(CONFIG, given(), folder, on="inline")
        monkeypatch.setattr(comparison, "work", None)  # finished shards are kept
        rows, _ = run(CONFIG, given(), folder, on="inline")
    expected = whole[whole["case"].isin(rows["case"])]
    columns = [name for name in rows.columns if name not in TIMES]
    order = ["case", "problem", "start", "method"]
    mine, theirs = (
        each[columns].sort_values(order, ignore_index=True) for each in (rows, expected)
    )
    assert mine.equals(theirs)


def test_the_command_refuses_to_overwrite(capsys):
    made = small_run()
    assert made.out.startswith("QUICK RUN")
    assert "MISSED  sometimes: cases without a start, all sets" in made.out
    assert f"report: {made.folder.path('report.html')}" in made.err
    files = {path.name for path in made.folder.folder.iterdir()}
    assert files >= {"rows.csv.xz", "summary.csv", "run.json", "report.html", "plan.json"}
    assert main(made.words) == 2
    assert "holds a finished run" in capsys.readouterr().err


def test_the_shortest_time_counts(monkeypatch):
    clock = iter([0, 3000, 0, 9000, 0, 0, 5000, 0, 2000, 0])

    def call(k: int) -> None:
        if k == 2:
            raise ValueError

    monkeypatch.setattr(comparison, "WARM_UP", 0)
    monkeypatch.setattr(comparison.time, "perf_counter_ns", lambda: next(clock))
    best = np.full(3, np.inf)
    for _ in range(2):
        comparison._time(call, best, [0, 1, 2], counted=True)
    assert best.tolist() == [3.0, 2.0, np.inf]


def starts_of(*starts):
    """A call that reads starts of a user."""
    return lambda: Given.of(tuple(text.format(own=own_file()) for text in starts))


REFUSED = [
    (starts_of("a=nothing/here"), "no such file or saved model is there"),
    (starts_of("a={own}:no_rule"), "has no 'no_rule'; it has .*Sometimes"),
    (starts_of("a={own}:two", "b=nothing/here"), "no rule but of type int.*no such file"),
    (starts_of("a=no_module:rule"), "is not there: neither in the working directory nor installed"),
    (starts_of("ball is round={own}:outside"), "needs a name of letters"),
    (starts_of("lagrange={own}:outside"), "the name lagrange is taken"),
    (starts_of("a={own}:outside", "a={own}:Sometimes"), "the name a is taken"),
    (starts_of(*(f"s{k}={{own}}:outside" for k in range(9))), "at most 8 starts of yours, got 9"),
    (starts_of("b={own}"), "names nothing: give --start NAME=module:rule"),
    (starts_of("a={own}:held"), "cannot be sent to the worker processes"),
    (lambda: StartsConfig(wrenches=0), "wrenches"),
    (
        lambda: HoldsConfig("hands", ("nobody",)),
        "unknown hand 'nobody': choose one of .* or the path of a URDF",
    ),
    (lambda: HoldsConfig("transfer", ("leap", "leap")), "hands need different names"),
    (
        lambda: HoldsConfig("hands", ("leap",), ("havok",)),
        "unknown engine 'havok': choose one of 'bullet', 'mujoco'",
    ),
    (lambda: HoldsConfig("hands"), "at least one hand"),
    (
        lambda: HoldsConfig("objects", ("leap",), objects=("a/mug.obj", "b/mug.stl")),
        "objects need different names",
    ),
    (
        lambda: HoldsConfig("objects", ("leap",), objects=("mug.obj=small",)),
        "must be FILE or FILE=SCALE",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_wrong_inputs_are_refused_before_anything_runs(call, message):
    with pytest.raises(GraspError, match=message):
        call()


def test_options_of_another_comparison_are_refused(tmp_path, capsys):
    for words, message in {
        "--hands allegro": "--hands belongs to `grasp evaluate env`, got `grasp evaluate starts`",
        "env --objects mug.stl": "--objects belongs to `grasp evaluate env --hands ...`, got `grasp evaluate env`",
        "soft --tuning 3": "--tuning belongs to `grasp evaluate errors`, got `grasp evaluate soft`",
        "--on cloud": "on must be inline, processes, ray or ray://HOST:PORT, got 'cloud'",
    }.items():
        assert main(["evaluate", *words.split(), "--out", str(tmp_path)]) == 2
        assert message in capsys.readouterr().err
    assert StartsConfig(quick=True).resolved().wrenches == 50
    assert StartsConfig(quick=True, wrenches=10).resolved().wrenches == 10
