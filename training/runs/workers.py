"""Spawned processes that each compute with one thread, and runs that go on where they were interrupted."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from grasp_env.errors import InvalidInputError
from training.runs import Run

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Spawned workers; where the block raises, what waits is dropped. Submit inside `one_thread`."""
    made = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _quiet)
    try:
        yield made
    except BaseException:
        made.shutdown(wait=False, cancel_futures=True)
        raise
    made.shutdown()


@contextmanager
def one_thread() -> Iterator[None]:
    """Processes started in the block compute with one thread each: their libraries read these when they are loaded."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def begin(run: Run, plan: dict[str, Any], what: str) -> None:
    """Writes what this run is to plan.json, or checks that an interrupted one was the same.

    Args:
        run: the run.
        plan: what decides its results, JSON-able.
        what: may differ, for the message.

    Raises:
        InvalidInputError: it was begun with another plan.
    """
    if not run.path("plan.json").is_file():
        run.write_json("plan.json", plan)
    elif run.read_json("plan.json") != json.loads(json.dumps(plan)):  # as JSON, where tuples are lists
        raise InvalidInputError(
            f"{run.folder} was begun with other {what}: repeat its command to continue it, or choose another --name"
        )


def _quiet() -> None:
    """A worker leaves an interrupt to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
