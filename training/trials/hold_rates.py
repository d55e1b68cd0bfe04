"""`grasp evaluate env`: roll out every cell over spawned workers, keep each as it is done."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from training.runs import Run, default_name, provenance
from training.runs.workers import begin, one_thread, pool
from training.trials.hold_plan import Cell, plan
from training.trials.holds import cell_json, columns, run_chunk, torque_limit
from training.trials.settings import EnvEvaluateConfig

CHUNK = 4
"""Seeds a worker is given at a time."""


def evaluate_env(config: EnvEvaluateConfig, console: Console | None = None, cells: list[Cell] | None = None) -> Run:
    """Runs what is not there yet; all trials lie in `<out>/<name>` afterwards.

    Args:
        config: the settings.
        console: for the progress; None: stderr.
        cells: instead of `holds.plan`.

    Raises:
        InvalidInputError: the run is finished, or was begun with other settings.
    """
    console = console or Console(stderr=True)
    if cells is None:
        cells = plan(QUICK_EPISODES if config.quick else config.episodes, config.quick)
    run = Run.create(config.out, config.name or default_name("env"))
    begun = {"seed": config.seed, "quick": config.quick, "cells": [cell_json(cell) for cell in cells]}
    begin(run, begun, "episodes, seed or settings")
    missing = [cell for cell in cells if not run.path(_file(cell.name)).is_file()]
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        console=console, disable=not console.is_terminal,
    )  # fmt: skip
    with bar:
        task = bar.add_task("episodes", total=sum(cell.episodes for cell in missing))

        def advance(cell: str, count: int) -> None:
            bar.update(task, advance=count, description=cell)

        roll_out_cells(run, missing, config.seed, config.workers or os.cpu_count() or 1, advance)
    settings = {key: value for key, value in asdict(config).items() if key != "name"}
    facts = {
        "kind": "env",
        **provenance(),
        **begun,
        "torque_limit": torque_limit(),
        "config": {**settings, "name": run.folder.name},
    }
    run.write_json("run.json", facts)
    return run


QUICK_EPISODES = 4
"""Of every scenario of a quick run."""


def roll_out_cells(
    run: Run, cells: list[Cell], seed: int, workers: int, advance: Callable[[str, int], None] = lambda cell, count: None
) -> None:
    """Runs cells and saves each, `trials/<name>.npz`, as soon as its last trial is done.

    Args:
        run: receives the files.
        cells: what to run, episodes seed, seed + 1, ...
        seed: of the first episode.
        workers: spawned processes.
        advance: told of the trials done.
    """
    if not cells:
        return
    with pool(workers) as started:
        pending: list[tuple[Cell, list[tuple[Future[list[dict[str, Any]]], int]]]] = []
        for cell in cells:
            chunks = [list(range(k, min(k + CHUNK, cell.episodes))) for k in range(0, cell.episodes, CHUNK)]
            with one_thread():
                jobs = [
                    (started.submit(run_chunk, asdict(cell), [seed + k for k in chunk]), len(chunk)) for chunk in chunks
                ]
            pending.append((cell, jobs))
        for cell, jobs in pending:
            rows: list[dict[str, Any]] = []
            for job, count in jobs:
                rows += job.result()
                advance(cell.name, count)
            run.write_arrays(_file(cell.name), columns(rows))


def _file(cell: str) -> str:
    return f"trials/{cell}.npz"
