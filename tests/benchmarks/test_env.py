"""The environment beside bare PyBullet in small, and its claims."""

from __future__ import annotations

import pytest

from grasp_env.errors import MissingExtraError
from training.evaluation.results.claims import judge
from training.evaluation.results.table import summary, table

env = pytest.importorskip("benchmarks.env", exc_type=MissingExtraError)


def test_steps_resets_and_memory(monkeypatch):
    rows = table(env.steps_beside_bare("usual", {}, 0, 2))
    step, bare = (
        rows[rows["case"] == case].reset_index()
        for case in ("step", "bare PyBullet calls of the step")
    )
    assert step["problem"].tolist() == bare["problem"].tolist() == [0, 1]  # one more was warm-up
    assert (step["microseconds"] > bare["microseconds"]).any()
    assert step["microseconds"].between(10.0, 1e5).all()
    assert step["ratio"].tolist() == pytest.approx(
        (step["microseconds"] / bare["microseconds"]).tolist()
    )
    assert step["per_second"].tolist() == pytest.approx((1e6 / step["microseconds"]).tolist())
    rows = table(env.reset_times("new", {"randomize": ("mass",)}, 0, 3))
    assert rows["problem"].tolist() == [0, 1, 2]
    assert rows["milliseconds"].between(0.01, 1e4).all()
    weight = {row["case"]: row["mebibytes"] for row in env.memory_of("same", {}, 20, 1)}
    assert 0.0 < weight["memory of an environment"] < weight["memory in all"] < 2000.0
    assert abs(weight["growth over the resets"]) < 20.0
    monkeypatch.setattr(env, "bare_loop", lambda inner, recorded: 1)
    with pytest.raises(AssertionError, match="went another way"):
        env.steps_beside_bare("usual", {}, 0, 1)


@pytest.mark.slow
def test_a_run_in_small_measures_every_claim():
    rows = env.run(env.Settings(rounds=2, resets=20, envs=1))
    assert all(row.met is not None for row in judge(env.BENCHMARK.claims, summary(rows)))
