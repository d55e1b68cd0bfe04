"""`grasp evaluate`: compare all starts over spawned workers, time them alone, save every trial."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from grasp_env.force import AdaptiveStep, InitialForceRule, Objective
from grasp_env.force.initial import CompiledRule, is_rule
from grasp_env.grasp import presets
from policies import LearnedInitialForce
from policies.learned import PRETRAINED
from training.cases.given import Given, model_path
from training.cases.set_table import SETS
from training.cases.sets import fixed_cases
from training.cases.start_table import FITTED, SHIPPED, given_in
from training.cases.starts import Made, load_models, make_starts, models_in, steps_inside
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


def evaluate(
    config: EvaluateConfig,
    console: Console | None = None,
    starts: Mapping[str, InitialForceRule | str | Path] | None = None,
) -> Run:
    """Runs what is not there yet; all trials lie in `<out>/<name>` afterwards.

    Args:
        config: what is compared.
        console: for progress; None: stderr.
        starts: starts of your own by name, besides those of `config.start`: rules, or paths of saved models.

    Raises:
        InvalidInputError: a start is none, the folder cannot be written, the run is finished, or was begun with other settings.
    """
    console, begun = console or Console(stderr=True), time.perf_counter()
    config = config.resolved()
    given = Given.of(config.start, starts)
    run = Run.create(config.out, config.name)
    settings = {key: value for key, value in asdict(config).items() if key not in ("out", "name", "workers")}
    begin(run, {"kind": "starts", **settings, "starts": given.said()}, "settings")
    run.write_json("config.json", asdict(config))
    if config.fit_seconds or config.fit.steps:
        given = replace(given, texts=(f"{FITTED}={_fit(run, config, console)}", *given.texts))
    jobs = [Job(job, [(work, (job, config, given))], _only) for job in plan()]
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
                wrenches, _rules(given, objective(config)), objective(config), config.repeats, lambda: bar.advance(task)
            )
            run.write_arrays("timing.npz", timing)
            seconds["timing"] = time.perf_counter() - start
    parts = [run.read_arrays(f"rollouts/{name}.npz") for name in SCENARIOS]
    run.write_arrays("rollouts.npz", {key: value for arrays in parts for key, value in arrays.items()})
    record_animations(run, LearnedInitialForce.pretrained(), quick=config.quick, seed=config.seed)
    seconds["all"] = time.perf_counter() - begun
    run.write_json("run.json", about(run, config, given, seconds))
    return run


def plan() -> list[str]:
    """The jobs of a run, longest first: "trials/<set>", "rollouts/<scenario>", "continuity", "guarantee"."""
    names = [f"rollouts/{name}" for name in SCENARIOS] + ["guarantee", "continuity"]
    return names + [f"trials/{name}" for name in sorted(SETS, key=lambda name: -SETS[name].share)]


def _only(answers: list[Trials]) -> Trials:
    (arrays,) = answers
    return arrays


def work(job: str, config: EvaluateConfig, given: Given) -> Trials:
    """One job, in a worker: its arrays."""
    phi = objective(config)
    rules, starts = _starts(given, phi)
    models = models_in(rules)
    kind, _, name = job.partition("/")
    if kind == "trials":
        return compare(name, cases_of(name, config.wrenches, config.seed), starts, models, phi)
    if kind == "rollouts":
        return rollouts.roll_out_scenario(name, {**ROLLED, **rules}, config.episodes, config.seed, phi, config.steps)
    if kind == "continuity":
        return continuity(starts, phi, config.paths, config.seed)
    return guarantee(models, config.guarded, config.seed)


def objective(config: EvaluateConfig) -> Objective:
    """The Phi of a run."""
    return Objective(config.fit.force_weight, config.fit.barrier_weight)


def about(run: Run, config: EvaluateConfig, given: Given, seconds: dict[str, float]) -> dict[str, Any]:
    """What run.json says: machine, settings, models, starts that were given."""
    rule, rules, said = AdaptiveStep(), _rules(given, objective(config)), given.said()
    files = {key: PRETRAINED / name for key, name in SHIPPED.items()}
    files |= {key: path for key, what in said.items() if (path := model_path(what)) is not None}
    models = {
        key: {**model.checkpoint.card, "bytes": _bytes(files[key]) if key in files else None}
        for key, model in models_in(rules).items()
    }
    return {
        "kind": "starts",
        **provenance(),
        "quick": config.quick,
        "config": asdict(config),
        "models": models,
        "given": {
            key: {
                "what": said.get(key, "a rule of grasp_env.force"),
                "remembers": bool(getattr(rules[key], "remembers", False)),
                "compiled": is_rule(rules[key], CompiledRule),
                "second_order": steps_inside(rules[key]),
            }
            for key in given_in(rules)
        },
        "grasp": config.fit.preset,
        "friction": float(presets.preset(config.fit.preset).friction[0]),
        "force_weight": config.fit.force_weight,
        "barrier_weight": config.fit.barrier_weight,
        "rollouts": rollouts.settings(),
        "step_rule": {"name": type(rule).__name__, **vars(rule)},
        "seconds": seconds,
        "fit": run.read_json("fit.json") if FITTED in rules else None,
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


def _rules(given: Given, phi: Objective) -> dict[str, InitialForceRule]:
    """The models of the package, then what was given."""
    return {**load_models(), **given.rules(phi)}


@functools.cache
def _starts(given: Given, phi: Objective) -> tuple[dict[str, InitialForceRule], dict[str, Made]]:
    rules = _rules(given, phi)
    return rules, make_starts(phi, rules)


def _bytes(stem: Path) -> int:
    """Size of a model's two files."""
    return sum(path.stat().st_size for path in stem.parent.glob(f"{stem.name}.*"))
