"""The map: the same rows wherever it runs, nothing lost when a worker dies or the work is interrupted."""

from __future__ import annotations

import pytest
from results import work
from results.work import names

from grasp_env.errors import InvalidInputError, SimulationError
from training.results.shards import map_shards
from training.results.table import pd, write

SHARDS = names([(0, 3), (1, 50), (2, 1), (3, 7)])


def test_processes_give_the_bytes_of_the_loop(tmp_path):
    inline = map_shards(work.squares, SHARDS, on="inline")
    spawned = map_shards(work.squares, SHARDS, workers=2)
    for name, mapped in (("a", inline), ("b", spawned)):
        write(tmp_path / name, mapped.rows)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert inline.rows["problem"].tolist() == [*range(3), *range(50), 0, *range(7)]
    assert (inline.workers, spawned.workers) == (1, 2)


def test_rows_keep_the_order_of_the_shards_whoever_ends_first(tmp_path):
    shards = names([(place, tmp_path) for place in range(4)])
    assert map_shards(work.slow_first, shards, workers=2).rows["problem"].tolist() == [0, 1, 2, 3]


def test_the_shard_of_a_killed_worker_runs_again_and_finished_ones_do_not(tmp_path):
    shards = names([(place, tmp_path) for place in range(4)])
    mapped = map_shards(work.dies_once, shards, workers=1, keep=tmp_path / "shards")
    assert mapped.rows["problem"].tolist() == [0, 1, 2, 3]
    assert sorted((tmp_path / "calls").read_text().split()) == ["0", "1", "2", "3"]


def test_workers_that_always_die_end_in_an_error():
    with pytest.raises(SimulationError, match="killed 3 times in a row"):
        map_shards(work.dies, names([0]), workers=1)


@pytest.mark.parametrize("on", ["inline", "processes"])
def test_an_interrupted_map_goes_on_where_it_stopped(tmp_path, on):
    shards, keep = names([(place, tmp_path) for place in range(4)]), tmp_path / "shards"
    with pytest.raises(RuntimeError, match="out of luck"):
        map_shards(work.fails, shards, on=on, workers=1, keep=keep)
    kept = {path.stem for path in keep.glob("*.parquet")}
    assert {"00000", "00001"} <= kept
    assert "00002" not in kept
    (tmp_path / "mended").touch()
    rows = map_shards(work.fails, shards, on=on, workers=1, keep=keep).rows
    assert rows["problem"].tolist() == [0, 1, 2, 3]
    calls = (tmp_path / "calls").read_text().split()
    assert {place: calls.count(place) for place in calls} | {"2": 2} == {"0": 1, "1": 1, "2": 2, "3": 1}
    assert map_shards(work.fails, shards, on=on, keep=keep).rows.equals(rows)  # nothing is left to do
    assert (tmp_path / "calls").read_text().split() == calls


def test_workers_compute_with_one_thread():
    assert map_shards(work.threads, names([0, 1]), workers=2).rows["workers"].tolist() == [1, 1]


def test_a_place_that_there_is_not_is_refused():
    with pytest.raises(InvalidInputError, match="on must be inline, processes, ray or ray://HOST:PORT, got 'cloud'"):
        map_shards(work.squares, SHARDS, on="cloud")


def test_no_shards_are_no_rows():
    assert map_shards(work.squares, {}, on="inline").rows.equals(pd.DataFrame())
