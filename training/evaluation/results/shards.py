"""Map of a function over shards: inline, in processes, or on a Ray cluster.

Rows and their order do not depend on where the shards run. Times are never measured in the map.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from grasp_env.errors import InvalidInputError, SimulationError
from grasp_env.inputs.extras import need
from training.evaluation.results import table
from training.evaluation.results.bars import progress
from training.evaluation.results.table import pd

ON = "inline, processes, ray or ray://HOST:PORT"
"""Places in which shards can run."""
ATTEMPTS = 3
"""Number of times in a row that workers may be killed without finishing a shard."""
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment that gives each worker one thread of BLAS and torch, which read it on loading."""

Work = Callable[[Any], "pd.DataFrame"]
"""Function from a shard to its rows, of a module, so that workers can import it."""
Answer = tuple["pd.DataFrame", float]
"""Rows of a shard, and their processor time [s]."""
Runner = Callable[[Work, dict[str, Any]], Iterator[tuple[str, Answer]]]
"""Function that runs work on shards and yields (name, answer) as they finish."""


def map_shards(
    function: Work,
    shards: Mapping[str, Any],
    *,
    on: str = "processes",
    workers: int = 0,
    keep: Path | None = None,
    label: str = "shards",
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Call a function on every shard and join the rows in the order of the shards.

    Args:
        function: takes a shard and returns its rows, which depend on the shard alone.
        shards: picklable shards by name; they start in this order, so the longest come first.
        on: "inline" (this process), "processes" (spawned on this machine), "ray" (the cluster of
            RAY_ADDRESS, or the one that runs on this machine) or "ray://HOST:PORT" (the Ray client
            server of another machine).
        workers: number of processes; 0: one per core. Ray uses the cores of its cluster.
        keep: folder that keeps finished shards, so that an interrupted map can continue; None:
            nothing is kept.
        label: label of the progress bar.

    Returns:
        The rows, and the description of the map for run.json: "on"; "workers", the number of shards
        that ran in parallel; "wall_seconds", without the start of Ray; "cpu_seconds" of the shards
        that ran, in which kept shards count as zero.

    Raises:
        InvalidInputError: `on` is invalid, or there is no such cluster.
        SimulationError: workers were killed `ATTEMPTS` times in a row without finishing a shard.
    """
    if on not in ("inline", "processes", "ray") and not on.startswith("ray://"):
        raise InvalidInputError(f"on must be {ON}, got {on!r}")
    files = {name: keep and keep / f"{name.replace('/', '-')}.csv" for name in shards}
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
    done = {name: table.read(file) for name, file in files.items() if file and file.is_file()}
    remaining = {name: shard for name, shard in shards.items() if name not in done}
    count = min(workers or os.cpu_count() or 1, max(1, len(remaining)))
    cpu = 0.0
    with progress() as bar, _runner(on, count) as (run, count):
        task = bar.add_task(label, total=len(shards), completed=len(done))
        begun = time.perf_counter()
        for name, (rows, seconds) in run(function, remaining):
            done[name] = rows
            cpu += seconds
            if file := files[name]:
                table.write(file, rows)
            bar.update(task, advance=1, description=f"{label}: {name}")
        wall = time.perf_counter() - begun
    about = {"on": on, "workers": count, "wall_seconds": wall, "cpu_seconds": cpu}
    return table.join(done[name] for name in shards), about


def _call(function: Work, shard: Any) -> Answer:
    """Run one shard and measure its processor time."""
    begun = time.process_time()
    rows = table.table(function(shard))
    return rows, time.process_time() - begun


@contextmanager
def _runner(on: str, workers: int) -> Iterator[tuple[Runner, int]]:
    """Yield the runner of a place, and the number of shards that it runs in parallel."""
    if on == "inline":
        yield _inline, 1
    elif on == "processes":
        yield partial(_processes, workers=workers), workers
    else:
        with _ray(on) as runner:
            yield runner


def _inline(function: Work, shards: dict[str, Any]) -> Iterator[tuple[str, Answer]]:
    for name, shard in shards.items():
        yield name, _call(function, shard)


def _processes(
    function: Work, shards: dict[str, Any], workers: int
) -> Iterator[tuple[str, Answer]]:
    """Run shards in spawned processes. If one is killed, its shards run again in new processes."""
    remaining = dict(shards)
    attempts = 0
    while remaining:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, context, _ignore_interrupts)
        problem = None
        attempts += 1
        try:
            waiting: dict[Future[Answer], str] = {}
            # a worker may die while the others still get their work
            with _one_thread(), suppress(BrokenProcessPool, OSError):
                for name, shard in remaining.items():
                    waiting[pool.submit(_call, function, shard)] = name
            for future in as_completed(waiting):
                if future.cancelled():
                    continue
                failed = future.exception()
                if failed is None:
                    attempts = 0
                    del remaining[waiting[future]]
                    yield waiting[future], future.result()
                elif problem is None:  # shards that run may finish and are kept; no other starts
                    problem = failed
                    for other in waiting:
                        other.cancel()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
        if problem is not None and not isinstance(problem, BrokenProcessPool):
            raise problem
        if attempts == ATTEMPTS:
            raise SimulationError(
                f"worker processes were killed {ATTEMPTS} times in a row while {', '.join(sorted(remaining))[:200]} ran, most likely for "
                "lack of memory: use fewer workers; finished shards are kept"
            )


@contextmanager
def _ray(on: str) -> Iterator[tuple[Runner, int]]:
    """Run shards as tasks of a Ray cluster, which repeats the shards of a lost worker or node."""
    need("ray")
    import ray  # pyright: ignore[reportMissingImports]

    try:
        address = on if on.startswith("ray://") else "auto"
        quiet: Any = {"logging_level": logging.ERROR, "log_to_driver": False}
        ray.init(address=address, runtime_env={"env_vars": THREADS}, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise InvalidInputError(
            f"no Ray cluster was found for --on {on} ({str(error)[:200]}): start one with `ray start --head`, set RAY_ADDRESS, or use "
            "--on processes"
        ) from error
    try:

        def run(function: Work, shards: dict[str, Any]) -> Iterator[tuple[str, Answer]]:
            task = ray.remote(num_cpus=1, max_retries=ATTEMPTS)(_call)
            waiting = {task.remote(function, shard): name for name, shard in shards.items()}
            while waiting:
                done, _ = ray.wait(list(waiting))
                for reference in done:
                    yield waiting.pop(reference), ray.get(reference)

        yield run, int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Give processes that start in the block one thread each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(THREADS)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _ignore_interrupts() -> None:
    """Ignore interrupts in a worker; its parent handles them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
