"""`grasp evaluate`: compare all starts over spawned workers, time them alone, save every trial."""

from __future__ import annotations

import functools
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

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
from training.runs.workers import Job, begin, progress, run_jobs
from training.trials import rollouts
from training.trials.arrays import SCENARIOS, Trials
from training.trials.compare import cases_of, compare
from training.trials.continuity import continuity
from training.trials.guarantee import guarantee
from training.trials.settings import EvaluateConfig
from training.trials.timing import time_calls

MODEL = "model/four_finger"
"""Of the network fitted in a run."""
ROLLED = {"single_value": "single_value", "linear_combination": "linear_combination", "previous_tangent": "previous"}
"""The starts of the roll-outs besides the models, and what the environment calls them."""


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
    jobs = [Job(job, [(work, (job, config, fitted))], _only) for job in plan()]
    jobs = [job for job in jobs if not job.done(run)]
    seconds: dict[str, float] = {}
    with progress(console) as bar:
        task = bar.add_task("comparing starts", total=len(jobs))
        for job, took in run_jobs(run, jobs, config.workers):
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
    parts = [run.read_arrays(f"rollouts/{name}.npz") for name in SCENARIOS]
    run.write_arrays("rollouts.npz", {key: value for arrays in parts for key, value in arrays.items()})
    record_animations(run, LearnedInitialForce.pretrained(), quick=config.quick, seed=config.seed)
    seconds["all"] = time.perf_counter() - begun
    run.write_json("run.json", about(run, config, fitted, seconds))
    return run


def plan() -> list[str]:
    """The jobs of a run, longest first: "trials/<set>", "rollouts/<scenario>", "continuity", "guarantee"."""
    names = [f"rollouts/{name}" for name in SCENARIOS] + ["guarantee", "continuity"]
    return names + [f"trials/{name}" for name in sorted(SETS, key=lambda name: -SETS[name].share)]


def _only(answers: list[Trials]) -> Trials:
    (arrays,) = answers
    return arrays


def work(job: str, config: EvaluateConfig, fitted: Path | None) -> Trials:
    """One job, in a worker: its arrays."""
    models, starts = _starts(fitted, config.fit.force_weight, config.fit.barrier_weight)
    phi = objective(config)
    kind, _, name = job.partition("/")
    if kind == "trials":
        return compare(name, cases_of(name, config.wrenches, config.seed), starts, models, phi)
    if kind == "rollouts":
        return rollouts.roll_out_scenario(name, {**ROLLED, **models}, config.episodes, config.seed, phi, config.steps)
    if kind == "continuity":
        return continuity(starts, phi, config.paths, config.seed)
    return guarantee(models, config.guarded, config.seed)


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
        "rollouts": rollouts.settings(),
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
