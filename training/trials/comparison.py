"""`grasp evaluate`: compare all starts over spawned workers, time them alone, save every trial."""

from __future__ import annotations

import functools
import os
import time
from concurrent.futures import as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from grasp_env.force import AdaptiveStep, Objective
from grasp_env.grasp import presets
from policies import LearnedInitialForce
from policies.learned import PRETRAINED
from training.cases.set_table import SETS
from training.cases.sets import fixed_cases
from training.cases.start_table import SHIPPED
from training.cases.starts import Start, load_models, make_starts
from training.demo.loops import record_animations
from training.runs import Run, provenance
from training.runs.workers import begin, one_thread, pool
from training.trials.arrays import SCENARIOS, Trials
from training.trials.compare import cases_of, compare
from training.trials.continuity import continuity
from training.trials.guarantee import guarantee
from training.trials.rollouts import roll_out_scenario
from training.trials.settings import EvaluateConfig
from training.trials.timing import time_calls

MODEL = "model/four_finger"
"""Of the network fitted in a run."""


def evaluate(config: EvaluateConfig, console: Console | None = None) -> Run:
    """Runs what is not there yet; all trials lie in `<out>/<name>` afterwards.

    Raises:
        InvalidInputError: the folder cannot be written, the run is finished, or was begun with other settings.
    """
    console, begun = console or Console(stderr=True), time.perf_counter()
    config = config.resolved()
    run = Run.create(config.out, config.name)
    settings = {key: value for key, value in asdict(config).items() if key not in ("out", "name", "workers")}
    begin(run, {"kind": "starts", **settings}, "settings")
    run.write_json("config.json", asdict(config))
    fitted = _fit(run, config, console) if config.fit_seconds or config.fit.steps else None
    jobs = [job for job in plan() if not run.path(file_of(job)).is_file()]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    seconds: dict[str, float] = {}
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("comparing starts", total=len(jobs))
        for job, took in run_jobs(run, jobs, config, fitted):
            seconds[job] = took
            bar.update(task, advance=1, description=job)
        if not run.path("timing.npz").is_file():
            task = bar.add_task("timing calls", total=config.repeats)
            start = time.perf_counter()
            wrenches = np.array([case.wrench for case in fixed_cases("ball", config.timed, config.seed)])
            timing = time_calls(
                wrenches, load_models(fitted), objective(config), config.repeats, lambda: bar.advance(task)
            )
            run.write_arrays("timing.npz", timing)
            seconds["timing"] = time.perf_counter() - start
    rollouts = [run.read_arrays(f"rollouts/{name}.npz") for name in SCENARIOS]
    run.write_arrays("rollouts.npz", {key: value for arrays in rollouts for key, value in arrays.items()})
    record_animations(run, LearnedInitialForce.pretrained(), quick=config.quick, seed=config.seed)
    seconds["all"] = time.perf_counter() - begun
    run.write_json("run.json", about(run, config, fitted, seconds))
    return run


def plan() -> list[str]:
    """The jobs of a run, longest first: "trials/<set>", "rollouts/<scenario>", "continuity", "guarantee"."""
    names = [f"rollouts/{name}" for name in SCENARIOS] + ["guarantee", "continuity"]
    return names + [f"trials/{name}" for name in sorted(SETS, key=lambda name: -SETS[name].share)]


def file_of(job: str) -> str:
    """Where a job's arrays are kept."""
    return f"{job}.npz"


def run_jobs(run: Run, jobs: list[str], config: EvaluateConfig, fitted: Path | None) -> Any:
    """Yields (job, seconds) as each is done and its file is whole."""
    if not jobs:
        return
    with pool(min(config.workers or os.cpu_count() or 1, len(jobs))) as started:
        with one_thread():
            waiting = {started.submit(work, job, config, fitted): job for job in jobs}
        for done in as_completed(waiting):
            arrays, took = done.result()
            run.write_arrays(file_of(waiting[done]), arrays)
            yield waiting[done], took


def work(job: str, config: EvaluateConfig, fitted: Path | None) -> tuple[Trials, float]:
    """One job, in a worker: its arrays and how long it took [s]."""
    begun = time.perf_counter()
    models, starts = _starts(fitted, config.fit.force_weight, config.fit.barrier_weight)
    phi = objective(config)
    kind, _, name = job.partition("/")
    if kind == "trials":
        out = compare(name, cases_of(name, config.wrenches, config.seed), starts, models, phi)
    elif kind == "rollouts":
        named = {
            "single_value": "single_value",
            "linear_combination": "linear_combination",
            "previous_tangent": "previous",
        }
        out = roll_out_scenario(name, {**named, **models}, config.episodes, config.seed, phi, config.steps)
    elif kind == "continuity":
        out = continuity(starts, phi, config.paths, config.seed)
    else:
        out = guarantee(models, config.guarded, config.seed)
    return out, time.perf_counter() - begun


def objective(config: EvaluateConfig) -> Objective:
    """The Phi of a run."""
    return Objective(config.fit.force_weight, config.fit.barrier_weight)


def about(run: Run, config: EvaluateConfig, fitted: Path | None, seconds: dict[str, float]) -> dict[str, Any]:
    """What run.json says: machine, settings, models."""
    rule = AdaptiveStep()
    files = {key: PRETRAINED / name for key, name in SHIPPED.items()} | ({"learned_fitted": fitted} if fitted else {})
    models = {key: {**model.checkpoint.card, "bytes": _bytes(files[key])} for key, model in load_models(fitted).items()}
    return {
        "kind": "starts",
        **provenance(),
        "quick": config.quick,
        "config": asdict(config),
        "models": models,
        "grasp": config.fit.preset,
        "friction": float(presets.preset(config.fit.preset).friction[0]),
        "force_weight": config.fit.force_weight,
        "barrier_weight": config.fit.barrier_weight,
        "step_rule": {"name": type(rule).__name__, **vars(rule)},
        "seconds": seconds,
        "fit": run.read_json("fit.json") if fitted is not None else None,
    }


def _fit(run: Run, config: EvaluateConfig, console: Console) -> Path:
    """Fits the network of this run, goes on fitting it, or finds it fitted; where it lies."""
    stem = run.path(MODEL)
    if not run.path("fit.json").is_file():
        from training.fit.four_finger import fit  # torch is slow to import, and most runs fit nothing
        from training.fit.state import StateFile

        console.print(f"fitting a network, {config.fit.seconds:.0f} s" if not config.fit.steps else "fitting a network")
        state = StateFile(stem, {})
        result = fit(config.fit, console.is_terminal, "grasp evaluate", stem, resume=state.path.exists())
        result.checkpoint.save(stem)
        state.remove()
        run.write_json("fit.json", {"card": result.checkpoint.card, "curve": np.asarray(result.curve)})
    return stem


@functools.cache
def _starts(
    fitted: Path | None, force_weight: float, barrier_weight: float
) -> tuple[dict[str, LearnedInitialForce], dict[str, Start]]:
    models = load_models(fitted)
    return models, make_starts(Objective(force_weight, barrier_weight), models)


def _bytes(stem: Path) -> int:
    """Size of a model's two files."""
    return sum(path.stat().st_size for path in stem.parent.glob(f"{stem.name}.*"))
