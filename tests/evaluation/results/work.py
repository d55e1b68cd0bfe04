"""Functions of shards for the tests of the map; workers import this module."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from training.evaluation.results.table import pd, table


def names(shards: Sequence[Any]) -> dict[str, Any]:
    """Shards by their number."""
    return {f"{place:05d}": shard for place, shard in enumerate(shards)}


def squares(shard: tuple[int, int]) -> pd.DataFrame:
    """Rows of random numbers from the shard's own generator."""
    first, count = shard
    rng = np.random.default_rng(first)
    return table(
        [{"case": f"shard {first}", "problem": k, "gap": rng.random()} for k in range(count)]
    )


def dies_once(shard: tuple[int, Path]) -> pd.DataFrame:
    """Shard 1 kills its worker the first time. The rows hold the number of threads of a worker."""
    place, folder = shard
    mark = folder / "died"
    if place == 1 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    with (folder / "calls").open("a") as file:
        file.write(f"{place}\n")
    return table([{"problem": place, "workers": int(os.environ.get("OMP_NUM_THREADS", 0))}])


def dies(shard: int) -> pd.DataFrame:
    """Kill the worker every time."""
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def fails(shard: tuple[int, Path]) -> pd.DataFrame:
    """Shard 2 fails until a file exists."""
    place, folder = shard
    with (folder / "calls").open("a") as file:
        file.write(f"{place}\n")
    if place == 2 and not (folder / "mended").exists():
        raise RuntimeError("out of luck")
    return table([{"problem": place}])


def process(shard: tuple[int, Path]) -> pd.DataFrame:
    """Wait, for a minute at most, until two processes run shards; the rows hold the process."""
    place, folder = shard
    (folder / f"process-{os.getpid()}").touch()
    until = time.monotonic() + 60
    while len(list(folder.glob("process-*"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    return table([{"problem": place, "bytes": os.getpid()}])
