"""The whole of `grasp evaluate` in small: rows of every set, start, method and roll-out, times, runs that go on, given starts."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from grasp_env.errors import InvalidInputError
from grasp_env.force.rules import CoreStart
from training.cli import main
from training.compare import comparison
from training.compare.cases import SETS
from training.compare.comparison import HELD_WITH, StartsConfig, plan, run
from training.compare.given import METHODS, Given
from training.compare.scenarios import HOLDS_OF_STARTS, RANDOM_STARTS
from training.compare.starts import STARTS
from training.results.columns import TIMES
from training.results.run import Run
from training.results.table import chosen, numbers

SMALL = StartsConfig(wrenches=6, timed=4, repeats=2, episodes=2, steps=10)
QUIET = Console(quiet=True)
OWN = """
import numpy as np
from dataclasses import dataclass
from grasp_env.force import ForceOptimizer, LinearCombination
from grasp_env.grasp import Grasp

@dataclass
class Sometimes:
    limit: float = 0.0
    def __call__(self, grasp, wrench):
        if wrench[0] > self.limit:
            raise ArithmeticError("not to the right")
        return LinearCombination()(grasp, wrench)

class Solver:
    def solve(self, problem):
        grasp = Grasp.from_contacts(problem.positions, problem.normals, problem.friction)
        return grasp.to_object_frame(ForceOptimizer(grasp, method="newton").solve(problem.wrench).force)

class NoSolver:
    pass

def outside(grasp, wrench):
    return -(grasp.pseudoinverse @ wrench).reshape(-1, 3)

two = 2
"""


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "my_rules.py"
    path.write_text(OWN)
    return path


@pytest.fixture(scope="module")
def given(own):
    lock = []  # a rule that only this process can name
    mine = {"squeeze": lambda grasp, wrench: CoreStart("single_value")(grasp, wrench) if lock == [] else None}
    return Given.of((f"sometimes={own}:Sometimes", f"outside={own}:outside"), (f"mine={own}:Solver",), mine)


@pytest.fixture(scope="module")
def made(tmp_path_factory, given):
    folder = Run.create(tmp_path_factory.mktemp("runs"), "small")
    return folder, *run(SMALL, given, folder, console=QUIET)


def test_every_set_start_method_and_scenario_is_there(made, given):
    _, rows, about = made
    holds = [f"hold_{name}" for name in HOLDS_OF_STARTS]
    assert list(dict.fromkeys(rows["case"])) == [*SETS, *holds, "model"]
    ball = rows[rows["case"] == "ball"]
    assert {*ball["start"].dropna()} == {*STARTS, "sometimes", "outside", "squeeze"}
    assert {*ball["method"]} == {*METHODS, "mine"}
    assert about["given"].keys() == {"sometimes", "outside", "squeeze", "mine"}
    held = rows[rows["case"].isin(holds)]
    assert {*held["start"]} == {*HELD_WITH, "learned_fixed", "sometimes", "outside", "squeeze"}
    counts = held.groupby(["case", "start"]).size()
    assert {case: {*counts[case]} for case in holds} == {
        f"hold_{name}": {SMALL.episodes if name in RANDOM_STARTS else 1} for name in HOLDS_OF_STARTS
    }
    for name in RANDOM_STARTS:  # every episode has a seed of its own
        episodes = chosen(held, f"case == 'hold_{name}' and start == 'single_value'")
        assert episodes["normal_force"].nunique() == len(episodes) == SMALL.episodes
    model = rows.iloc[-1]
    assert 0 < model["bytes"] < 2_000_000
    assert model["cpu_seconds"] > 0.0


def test_given_starts_are_counted_with_what_they_do_wrong(made):
    _, rows, _ = made
    flow = chosen(rows, "method == 'reduced_flow'")
    solved = flow[flow["case"].isin([name for name, which in SETS.items() if not which.starts])]
    mine = solved[solved["start"] == "squeeze"].drop(columns=[*TIMES, "start", "start_replaced"], errors="ignore")
    ours = solved[solved["start"] == "single_value"].drop(columns=[*TIMES, "start", "start_replaced"], errors="ignore")
    assert mine.reset_index(drop=True).equals(ours.reset_index(drop=True))  # the same rule
    assert {*solved[solved["start"] == "outside"]["reason"]} == {"outside the cones"}
    sometimes = solved[solved["start"] == "sometimes"]
    right = sometimes["status"] == "no_start"
    assert 0 < right.sum() < len(sometimes)
    assert {*sometimes[right]["reason"]} == {"ArithmeticError: not to the right"}
    held = flow[flow["case"].str.startswith("hold_")]
    assert held[held["start"] == "squeeze"]["held"].all()
    assert not held[held["start"] == "outside"]["held"].any()
    assert {*held[held["start"] == "outside"]["failure"]} == {"no_start"}
    assert {*chosen(rows, "method == 'mine'")["status"]} == {"optimal"}


def test_times_are_of_the_first_problems_of_a_set_and_of_what_has_a_start(made):
    _, rows, _ = made
    timed = rows[rows["microseconds"].notna()]
    assert {*timed["case"]} == {*comparison.TIMED_SETS}
    assert timed["problem"].max() < SMALL.timed
    assert (timed["microseconds"] > 0.0).all()
    for case in comparison.TIMED_SETS:
        of_set = timed[timed["case"] == case]
        counts = of_set.groupby(["start", "method"], dropna=False).size()
        assert counts["linear_combination", "newton"] == counts["squeeze", "reduced_flow"] == SMALL.timed
        assert len(of_set[of_set["method"] == "mine"]) == SMALL.timed
        inside = of_set[of_set["compiled_microseconds"].notna()]
        assert {"linear_combination", "internal_force", "learned_fixed"} <= {*inside["start"]}
        assert not {"squeeze", "learned_previous", "network"} & {*inside["start"]}
        assert inside["compiled_microseconds"].median() < inside["microseconds"].median()
    assert timed[timed["start"] == "outside"].empty
    alone = timed[timed["method"] == "reduced_flow"]["start_microseconds"]
    assert (alone > 0.0).all()
    # the shortest of the repeats: no call is as long as all of them
    assert (timed["microseconds"] < 1e5).all()


def test_an_interrupted_run_goes_on_and_gives_the_rows_of_a_whole_one(made, given, tmp_path, monkeypatch):
    _, whole, _ = made
    folder, real = Run.create(tmp_path, "run"), comparison.work
    done: list[str] = []

    def stopping(shard):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(shard.name)
        return real(shard)

    monkeypatch.setattr(comparison, "work", stopping)
    with pytest.raises(KeyboardInterrupt):
        run(SMALL, given, folder, on="inline", console=QUIET)
    assert len(list(folder.path("shards").glob("*.parquet"))) == 3
    again: list[str] = []
    monkeypatch.setattr(comparison, "work", lambda shard: (again.append(shard.name), real(shard))[1])
    rows, _ = run(SMALL, given, folder, on="inline", console=QUIET)
    assert [*done, *again] == plan(given)
    timeless = [name for name in whole.columns if name not in TIMES]
    assert rows[timeless].equals(whole[timeless])


def test_the_seed_decides_the_problems(made):
    _, rows, _ = made
    other = comparison.work(comparison.Shard("ball", replace(SMALL, seed=1), Given.of(), comparison.Objective()))
    one = numbers(chosen(rows, "case == 'ball' and start == 'lagrange' and method == 'newton'"), "start_gap")
    two = numbers(chosen(other, "start == 'lagrange' and method == 'newton'"), "start_gap")
    assert len(one) == len(two)
    assert (one != two).all()
    assert {*other["seed"]} == {1}


@pytest.mark.parametrize(
    ("starts", "solvers", "objects", "message"),
    [
        (("a=nothing/here",), (), {}, "no such file or saved model is there"),
        (("a={own}:no_rule",), (), {}, "has no 'no_rule'; it has .*Sometimes"),
        (("a={own}:two",), (), {}, "is no rule but of type int"),
        (("a=no_module:rule",), (), {}, "is not there: neither in the working directory nor installed"),
        (("ball is round={own}:outside",), (), {}, "needs a name of letters"),
        (("lagrange={own}:outside",), (), {}, "the name lagrange is taken"),
        (("newton={own}:outside",), (), {}, "the name newton is taken"),
        (("a={own}:outside",), ("a={own}:Solver",), {}, "the name a is taken"),
        ((), ("b={own}:NoSolver",), {}, "has no method solve: give it solve"),
        ((), ("b={own}",), {}, "names nothing: give --solver NAME=module:Class"),
        ((), (), {"held": threading.Lock().acquire}, "cannot be sent to the worker processes"),
        (("a={own}:two", "b=nothing/here"), (), {"c": 3}, "is no rule but of type int.*no such file.*the start c is no rule"),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_refused_before_anything_runs(own, starts, solvers, objects, message):
    with pytest.raises(InvalidInputError, match=message):
        Given.of(
            tuple(text.format(own=own) for text in starts), tuple(text.format(own=own) for text in solvers), objects
        )


def test_settings_are_checked():
    for wrong in ({"wrenches": 0}, {"repeats": -1}, {"seed": -1}, {"timed": 2.5}):
        with pytest.raises(InvalidInputError, match=next(iter(wrong))):
            StartsConfig(**wrong)
    assert StartsConfig(quick=True).resolved().wrenches == 50
    assert StartsConfig(quick=True, wrenches=10).resolved().wrenches == 10


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["evaluate", "--hands", "allegro"], "--hands belongs to `grasp evaluate env`, got `grasp evaluate starts`"),
        (["evaluate", "env", "--start", "a=b"], "--start belongs to `grasp evaluate starts`"),
        (["evaluate", "env", "--engines", "mujoco"], "--engines belongs to `grasp evaluate env --hands ...`"),
        (["evaluate", "transfer", "--wrenches", "3"], "--wrenches belongs to `grasp evaluate starts`"),
        (["evaluate", "env", "--hands", "nobody"], "unknown hand 'nobody'"),
        (["evaluate", "--on", "cloud"], "on must be inline, processes, ray or ray://HOST:PORT, got 'cloud'"),
    ],
)
def test_options_that_belong_elsewhere_are_refused(words, message, tmp_path, capsys):
    assert main([*words, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_a_quick_run_from_the_command_line(tmp_path, capsys, own):
    words = [
        "--quick",
        "--wrenches",
        "6",
        "--timed",
        "4",
        "--out",
        str(tmp_path),
        "--name",
        "q",
        "--start",
        f"mine={own}:Sometimes",
    ]
    assert main(["evaluate", *words]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("QUICK RUN")
    assert "MISSED  mine: cases without a start, all sets" in printed.out
    assert f"report: {tmp_path / 'q' / 'report.html'}" in printed.err
    files = {path.name for path in (tmp_path / "q").iterdir()}
    assert files >= {"rows.parquet", "rows.csv", "summary.csv", "run.json", "report.html", "plan.json"}
    assert not [name for name in files if name.startswith(".")]
    assert main(["evaluate", *words]) == 2
    assert "holds a finished run" in capsys.readouterr().err
    (tmp_path / "q" / "run.json").unlink()
    assert main(["evaluate", "--seed", "1", *words]) == 2
    assert "was begun with other settings (seed)" in capsys.readouterr().err


def test_the_best_of_the_repeats_is_kept_in_microseconds_and_a_call_that_raises_has_no_time(monkeypatch):
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
