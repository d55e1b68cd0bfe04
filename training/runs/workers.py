"""Spawned processes that each compute with one thread, and runs that go on where they were interrupted."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

from grasp_env.errors import InvalidInputError
from training.runs import Run

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Job(NamedTuple):
    """What becomes one file of arrays.

    Attributes:
        name: of the file, without .npz.
        calls: (function, arguments), picklable, for workers.
        join: their answers, in order, to the arrays.
    """

    name: str
    calls: list[tuple[Callable[..., Any], tuple[Any, ...]]]
    join: Callable[[list[Any]], dict[str, np.ndarray]]

    def done(self, run: Run) -> bool:
        """Whether its file is there, which it is only when it is whole."""
        return run.path(f"{self.name}.npz").is_file()


def run_jobs(run: Run, jobs: list[Job], workers: int) -> Iterator[tuple[str, float]]:
    """Yields (job, seconds) of every call that has been answered; a job's file is written as soon as its last one is.

    Args:
        run: receives the files.
        jobs: what to do, the longest first.
        workers: spawned processes, each with one thread; 0: one per core. The results do not depend on it.
    """
    if not jobs:
        return
    answers: dict[str, list[Any]] = {job.name: [None] * len(job.calls) for job in jobs}
    left = {job.name: len(job.calls) for job in jobs}
    with _pool(min(workers or os.cpu_count() or 1, sum(left.values()))) as started:
        with _one_thread():
            waiting = {
                started.submit(_timed, *call): (job, place) for job in jobs for place, call in enumerate(job.calls)
            }
        for future in as_completed(waiting):
            job, place = waiting.pop(future)
            answers[job.name][place], seconds = future.result()
            left[job.name] -= 1
            if not left[job.name]:
                run.write_arrays(f"{job.name}.npz", job.join(answers.pop(job.name)))
            yield job.name, seconds


def _timed(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, float]:
    begun = time.perf_counter()
    return function(*arguments), time.perf_counter() - begun


class Bars(Progress):
    """Bars as wide as the terminal, and beneath them what a task has to say in its field `note`; no line is wrapped."""

    def get_renderables(self) -> Iterator[RenderableType]:
        """What is drawn, from the top."""
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            if task.fields.get("note"):
                yield Text(task.fields["note"], style="dim", no_wrap=True, overflow="ellipsis")


def progress(console: Console) -> Bars:
    """The bar of everything that takes long; where nobody looks, none."""
    # the bar takes what the rest leaves; numbers and times are never cut, a name longer than half a line of 80 is
    name = Column(no_wrap=True, overflow="ellipsis", max_width=max(8, console.width - 48))
    columns = (
        TextColumn("{task.description}", table_column=name),
        BarColumn(bar_width=None),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
    )
    return Bars(*columns, console=console, transient=False, disable=not console.is_terminal, expand=True)


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Spawned workers; where the block raises, what waits is dropped. Submit inside `_one_thread`."""
    made = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _quiet)
    try:
        yield made
    except BaseException:
        made.shutdown(wait=False, cancel_futures=True)
        raise
    made.shutdown()


@contextmanager
def _one_thread() -> Iterator[None]:
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
