"""`grasp evaluate`: fit a network, compare all starts, roll out the hand, save every trial, build the report."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import imageio.v3 as imageio
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from grasp_env.force import ForceOptimizer, InitialForceRule
from grasp_env.grasp import presets
from policies import LearnedInitialForce
from training.fit import fit
from training.report import build_report, report_path
from training.rollouts import RANDOM_SCENARIOS, SCENARIOS, picture, roll_out_all
from training.runs import Run, provenance
from training.settings import EvaluateConfig
from training.starts import compare, make_starts, save, time_starts, traces, wrench_sets


def evaluate(config: EvaluateConfig, console: Console | None = None) -> dict[str, Any]:
    """Runs the whole comparison and returns the metrics; everything lies in `<out>/<name>` afterwards."""
    console = console or Console(stderr=True)
    config = config.resolved()
    shown = console.is_terminal
    run = Run.create(config.out, config.name)
    run.write_json("config.json", asdict(config))
    shipped = LearnedInitialForce.pretrained()
    console.print(f"fitting a network for {config.fit.seconds:.0f} s" if not config.fit.steps else "fitting a network")
    result = fit(config.fit, progress=shown, command="grasp evaluate")
    result.checkpoint.save(run.path("model/four_finger"))
    fitted = LearnedInitialForce(result.checkpoint)
    learned: dict[str, InitialForceRule] = {"learned_fitted": fitted, "learned_shipped": shipped}
    grasp = presets.preset(config.fit.preset)
    optimizer = ForceOptimizer(grasp, force_weight=config.fit.force_weight, barrier_weight=config.fit.barrier_weight)
    starts = make_starts(optimizer.objective, learned)
    sets = wrench_sets(config.wrenches, config.seed)
    with _progress(console) as bar:
        task = bar.add_task("comparing starts", total=sum(len(values) for values in sets.values()))
        trials = [(name, compare(grasp, w, starts, optimizer, lambda: bar.advance(task))) for name, w in sets.items()]
        save(run, "trials.npz", trials)
        task = bar.add_task("timing calls", total=1)
        run.write_arrays("timing.npz", time_starts(grasp, sets["ball"][: config.timed], starts, optimizer))
        bar.advance(task)
        constant = sets["constant"][0]
        near = optimizer.solve(0.97 * constant)  # the wrench before it, 3 % away
        run.write_arrays("traces.npz", traces(grasp, constant, starts, optimizer, near))
        rules: dict[str, str | InitialForceRule] = {
            "single_value": "single_value",
            "linear_combination": "linear_combination",
            "previous_tangent": "previous",
            **learned,
        }
        episodes = (len(SCENARIOS) + len(RANDOM_SCENARIOS) * (config.episodes - 1)) * len(rules)
        task = bar.add_task("rolling out the hand", total=episodes)
        run.write_arrays(
            "rollouts.npz",
            roll_out_all(rules, config.episodes, config.seed, optimizer.objective, lambda: bar.advance(task)),
        )
    run.write("figures/hand.png", lambda path: imageio.imwrite(path, picture(), extension=".png"))
    run.write_json(
        "run.json",
        {
            **provenance(),
            "quick": config.quick,
            "config": asdict(config),
            "fit": {"card": result.checkpoint.card, "curve": np.asarray(result.curve)},
            "shipped": shipped.checkpoint.card,
            "friction": float(grasp.friction[0]),
            "step_rule": {"name": type(optimizer.step_rule).__name__, **vars(optimizer.step_rule)},
        },
    )
    metrics = build_report(run)
    console.print(f"report: {report_path(run)}")
    return metrics


def _progress(console: Console) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)
