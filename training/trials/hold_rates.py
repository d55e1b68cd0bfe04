"""`grasp evaluate env`: roll out every cell over spawned workers, keep each as it is done."""

from __future__ import annotations

from dataclasses import asdict
from itertools import chain
from typing import Any

import numpy as np
from rich.console import Console

from training.runs import Run, default_name, provenance
from training.runs.workers import Job, begin, progress, run_jobs
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
        cells: instead of `hold_plan.plan`.

    Raises:
        InvalidInputError: the run is finished, or was begun with other settings.
    """
    console = console or Console(stderr=True)
    if cells is None:
        cells = plan(QUICK_EPISODES if config.quick else config.episodes, config.quick)
    run = Run.create(config.out, config.name or default_name("env"))
    begun = {"seed": config.seed, "quick": config.quick, "cells": [cell_json(cell) for cell in cells]}
    begin(run, begun, "episodes, seed or settings")
    jobs = [job for job in jobs_of(cells, config.seed) if not job.done(run)]
    with progress(console) as bar:
        task = bar.add_task("episodes", total=sum(len(job.calls) for job in jobs))
        for job, _ in run_jobs(run, jobs, config.workers):
            bar.update(task, advance=1, description=f"{job}, {CHUNK} episodes at a time")
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


def jobs_of(cells: list[Cell], seed: int) -> list[Job]:
    """A job per cell, trials/<name>, its episodes of the seeds seed, seed + 1, ... in chunks."""

    def chunks(cell: Cell) -> list[list[int]]:
        seeds = range(seed, seed + cell.episodes)
        return [list(seeds[k : k + CHUNK]) for k in range(0, len(seeds), CHUNK)]

    return [
        Job(f"trials/{cell.name}", [(run_chunk, (asdict(cell), chunk)) for chunk in chunks(cell)], _joined)
        for cell in cells
    ]


def _joined(chunks: list[list[dict[str, Any]]]) -> dict[str, np.ndarray]:
    return columns(list(chain.from_iterable(chunks)))
