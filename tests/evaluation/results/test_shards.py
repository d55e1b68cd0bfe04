"""The map gives the same rows wherever it runs, and loses nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from evaluation.results import work
from evaluation.results.work import names

from grasp_env.errors import InvalidInputError, SimulationError
from training.evaluation.results.shards import map_shards
from training.evaluation.results.table import pd, write

HERE = Path(__file__).parent
NAMESPACE = ("unshare", "--net", "--map-root-user")
SHARDS = names([(0, 3), (1, 50), (2, 1), (3, 7)])


def test_processes_give_the_bytes_of_the_loop(tmp_path):
    inline = map_shards(work.squares, SHARDS, on="inline")
    spawned = map_shards(work.squares, SHARDS, workers=2)
    for name, (rows, _) in (("a", inline), ("b", spawned)):
        write(tmp_path / name, rows)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert inline[0]["problem"].tolist() == [*range(3), *range(50), 0, *range(7)]
    assert (inline[1]["workers"], spawned[1]["workers"]) == (1, 2)
    assert map_shards(work.squares, {}, on="inline")[0].equals(pd.DataFrame())


def test_shards_of_killed_workers_run_again(tmp_path, monkeypatch):
    shards = names([(place, tmp_path) for place in range(4)])
    rows, _ = map_shards(work.dies_once, shards, workers=1, keep=tmp_path / "shards")
    assert rows["problem"].tolist() == [0, 1, 2, 3]
    assert rows["workers"].tolist() == [1] * 4  # threads of a worker
    assert sorted((tmp_path / "calls").read_text().split()) == ["0", "1", "2", "3"]
    monkeypatch.setattr("training.evaluation.results.shards.ATTEMPTS", 2)
    with pytest.raises(SimulationError, match="killed 2 times in a row"):
        map_shards(work.dies, names([0]), workers=1)


@pytest.mark.parametrize("on", ["inline", "processes"])
def test_an_interrupted_map_continues(tmp_path, on):
    shards = names([(place, tmp_path) for place in range(4)])
    keep = tmp_path / "shards"
    with pytest.raises(RuntimeError, match="out of luck"):
        map_shards(work.fails, shards, on=on, workers=1, keep=keep)
    kept = {path.stem for path in keep.glob("*.csv")}
    assert {"00000", "00001"} <= kept
    assert "00002" not in kept
    (tmp_path / "mended").touch()
    rows, _ = map_shards(work.fails, shards, on=on, workers=1, keep=keep)
    assert rows["problem"].tolist() == [0, 1, 2, 3]
    calls = (tmp_path / "calls").read_text().split()
    assert {place: calls.count(place) for place in calls} == {"0": 1, "1": 1, "2": 2, "3": 1}
    assert map_shards(work.fails, shards, on=on, keep=keep)[0].equals(rows)  # nothing is left to do
    assert (tmp_path / "calls").read_text().split() == calls


def test_rows_keep_the_order_of_the_shards(monkeypatch):
    """A stub of Ray's functions, without a cluster."""
    started: list[dict] = []
    stub = SimpleNamespace(
        init=lambda **options: started.append(options),
        shutdown=lambda: started.clear(),
        get=lambda reference: reference[0](),
        remote=lambda **options: (
            lambda call: SimpleNamespace(remote=lambda *given: (lambda: call(*given),))
        ),
        wait=lambda waiting: (waiting[-1:], waiting[:-1]),
        cluster_resources=lambda: {"CPU": 2.0},
    )
    monkeypatch.setitem(sys.modules, "ray", stub)
    monkeypatch.setattr("training.evaluation.results.shards.need", lambda extra: None)
    rows, about = map_shards(work.squares, SHARDS, on="ray")
    assert rows.equals(map_shards(work.squares, SHARDS, on="inline")[0])
    assert (about["workers"], started) == (2, [])  # shut down

    def refuse(**options):
        raise ConnectionError("nobody answers")

    stub.init = refuse
    for on, message in (
        ("ray", "no Ray cluster was found for --on ray"),
        ("cloud", "on must be inline, processes"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            map_shards(work.squares, SHARDS, on=on)


@pytest.mark.slow
def test_two_ray_nodes_give_the_bytes_of_the_loop(tmp_path):
    """Ray listens on all interfaces, so it runs in a network namespace with nothing but loopback."""
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    if (
        not all(map(shutil.which, ("unshare", "ip")))
        or subprocess.run([*NAMESPACE, "true"], timeout=30).returncode
    ):
        pytest.skip("no network namespace can be made here")
    paths = [str(path) for path in (HERE.parents[1], HERE.parent)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    command = [*NAMESPACE, sys.executable, str(HERE / "ray_cluster.py"), str(tmp_path)]
    run = subprocess.run(
        command, env=env, cwd=HERE.parents[1], capture_output=True, text=True, timeout=240
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert "workers 2, processes 2, dead [0, 1, 2, 3]" in run.stdout
    assert (tmp_path / "ray.csv").read_bytes() == (tmp_path / "inline.csv").read_bytes()
