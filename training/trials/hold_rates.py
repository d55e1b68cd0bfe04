"""`grasp evaluate env`: roll out every cell over spawned workers, keep each as it is done."""

from __future__ import annotations

from dataclasses import asdict

from rich.console import Console

from training.runs import Run, default_name, provenance
from training.runs.workers import begin
from training.trials.hold_plan import Cell, plan
from training.trials.holds import cell_json, roll_out, run_chunk, torque_limit
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
    roll_out(run, cells, CHUNK, run_chunk, config, console)
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
