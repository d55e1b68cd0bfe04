"""The benchmark of a loop's worst tick: what it counts, in C and from Python, and what it scores."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import ticks
from benchmarks.__main__ import main
from benchmarks.force.entrants.ours import ConicPython
from benchmarks.force.problems import load
from training.evaluation.results.table import read, summary

needs_gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="there is no gcc")


def few(sessions: int = 1):
    track = load("loop")
    return replace(track, sessions=track.sessions[:sessions])


@needs_gcc
def test_every_tick_is_timed_and_our_answers_are_right(tmp_path, capsys):
    """A small run of the program: a row for each tick, and a busy wait beside them."""
    words = ["ticks", "--solvers", "conic_python", "--ticks", "1200", "--python", "500"]
    assert main([*words, "--rounds", "2", "--out", str(tmp_path), "--name", "a"]) == 0
    told = capsys.readouterr().out
    assert all(word in told for word in ("p99", "p999", "max", "busy", "slowdown", "undisturbed"))
    rows = read(tmp_path / "a/rows.csv.xz")
    means = summary(rows).set_index("method")
    size = load("loop").size
    assert means["n"].to_dict() == {"conic_python": 2 * size, "busy": 4 * size}
    assert means.loc["conic_python", ["failed_sum", "wrong_sum"]].tolist() == [0.0, 0.0]
    assert rows["failed"].notna().sum() == size  # of a busy wait nothing is scored
    assert rows["typical"].notna().sum() == 2 * size
    ours = means.loc["conic_python"]
    order = ["latency_median", "latency_p99", "latency_p999", "latency_max"]
    assert sorted(ours[order]) == ours[order].tolist()
    assert ours["slowdown_max"] == pytest.approx(ours["latency_max"] / ours["latency_median"], 1e-3)
    assert means["undisturbed_max"].le(means["slowdown_max"]).all()
    busy = rows[rows["method"] == "busy"]["latency"]
    assert busy.median() == pytest.approx(busy.min(), rel=0.5)


def test_what_fails_is_counted():
    """An entrant that is wrong now and then, and raises an error once."""

    class Careless(ConicPython):
        name = "careless"
        calls = 0

        def solve(self, problem, start=None):
            self.calls += 1
            if problem.wrench is self.wrench:
                raise ZeroDivisionError
            answer = super().solve(problem, start)
            return answer if answer[0] is None else (1.01 * answer[0], *answer[1:])

        def setup(self, task):
            self.wrench = task.first.wrench
            super().setup(task)

    track = few()
    player = ticks.Player(Careless, track)
    player.play(2)
    solver = player.sessions[0].solver
    count = len(track.sessions[0].problems)
    assert solver.calls == (1 + count) + (1 + 2 * count)  # a pass begins with an untimed call
    rows = player.rows(track, judged=True)
    assert len(rows) == 2 * count
    exists = np.isfinite(track.sessions[0].references["sum"].value)
    assert rows["failed"].dropna().tolist() == exists.tolist()
    assert not rows["wrong"].dropna().any()


def test_times_are_of_their_ticks(monkeypatch):
    """The control takes the time that it is given, and interrupted ticks are marked."""
    now = [0]
    taken = [0]

    class Told:
        def setup(self, task):
            self.calls = 0

        def solve(self, problem, start=None):
            self.calls += 1
            now[0] += 1000 * self.calls
            taken[0] += self.calls % 10 == 0

    track = few()
    player = ticks.Player(Told, track)
    player.sessions[0].solver.calls = 0
    usage = type("Usage", (), {"ru_nivcsw": property(lambda self: taken[0])})()
    monkeypatch.setattr("time.perf_counter_ns", lambda: now[0])
    monkeypatch.setattr("resource.getrusage", lambda who: usage)
    player.play(1)
    player.play(2)
    rows = player.rows(track, judged=False)
    count = len(track.sessions[0].problems)
    calls = np.concatenate([2 + np.arange(count), 3 + count + np.arange(2 * count)])
    assert rows["latency"].tolist() == calls.tolist()
    assert rows["interrupted"].tolist() == (calls % 10 == 0).tolist()
    assert rows["problem"].tolist() == 3 * list(range(count))
    median = np.median(calls)
    assert rows["slowdown"].tolist() == (calls / median).round(3).tolist()
    typical = np.median(calls.reshape(3, count), axis=0) / median
    assert rows["typical"].dropna().tolist() == typical.round(3).tolist()
    assert rows["undisturbed"].notna().tolist() == (calls % 10 != 0).tolist()


@pytest.mark.parametrize(
    ("solvers", "said"),
    [
        (["sovler"], "no entrant 'sovler'"),
        (["newton_python"], "no solver plays: newton_python: it minimises something else"),
    ],
)
def test_what_cannot_play_is_told(solvers, said, tmp_path, capsys):
    assert main(["ticks", "--solvers", *solvers, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err
