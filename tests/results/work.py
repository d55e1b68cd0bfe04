"""Functions of shards for the tests of the map; workers import this module."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from training.results.table import pd, table


def names(shards: Sequence[Any]) -> dict[str, Any]:
    """Shards by their number."""
    return {f"{place:05d}": shard for place, shard in enumerate(shards)}


def squares(shard: tuple[int, int]) -> pd.DataFrame:
    """Rows of a few numbers, of a generator of the shard's own."""
    first, count = shard
    rng = np.random.default_rng(first)
    return table([{"case": f"shard {first}", "problem": k, "gap": rng.random()} for k in range(count)])


def slow_first(shard: tuple[int, Path]) -> pd.DataFrame:
    """The first shard ends last."""
    place, folder = shard
    while place == 0 and len(list(folder.iterdir())) < 3:
        pass
    (folder / str(place)).touch()
    return table([{"problem": place}])


def dies_once(shard: tuple[int, Path]) -> pd.DataFrame:
    """A worker is killed in the middle of its work, the first time only."""
    place, folder = shard
    mark = folder / "died"
    if place == 1 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    with (folder / "calls").open("a") as file:
        file.write(f"{place}\n")
    return table([{"problem": place}])


def dies(shard: int) -> pd.DataFrame:
    """A worker is killed whenever it tries."""
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def fails(shard: tuple[int, Path]) -> pd.DataFrame:
    """The third shard fails until a file is there."""
    place, folder = shard
    with (folder / "calls").open("a") as file:
        file.write(f"{place}\n")
    if place == 2 and not (folder / "mended").exists():
        raise RuntimeError("out of luck")
    return table([{"problem": place}])


def threads(shard: int) -> pd.DataFrame:
    """How many threads the libraries of a worker may use."""
    return table([{"problem": shard, "workers": int(os.environ.get("OMP_NUM_THREADS", 0))}])


def process(shard: tuple[int, Path]) -> pd.DataFrame:
    """Which process runs a shard. It waits for a second one, which a busy machine may take many seconds to start, for a minute at most."""
    place, folder = shard
    (folder / f"process-{os.getpid()}").touch()
    until = time.monotonic() + 60
    while len(list(folder.glob("process-*"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    return table([{"problem": place, "bytes": os.getpid()}])
