"""Reports from a run's saved trials: metrics.json, figures, report.md, self-contained report.html. Solves nothing."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from training import figures
from training.metrics import (
    Trials,
    claims,
    rollout_metrics,
    start_metrics,
    table_one,
    timing_metrics,
)
from training.rollouts import SCENARIO_LABELS
from training.runs import Run
from training.starts import LABELS, WRENCH_SETS

FIGURES: dict[str, str] = {
    "hand.png": "The simulated hand holding the 0.1 m cuboid (PyBullet, software renderer).",
    "iterations_ecdf.png": "Share of held-out wrenches solved within k accepted steps of the reduced flow.",
    "convergence.png": "Convergence per start on the paper's constant wrench (the paper's Fig. 3).",
    "forces_over_time.png": "Optimal contact forces along the paper's W_ext(t), full size.",
    "start_against_optimum.png": "Start against optimum along W_ext(t), normal forces (the paper's Fig. 4).",
    "rollout.png": "Roll-outs with the paper's start: drift, commanded and measured thumb force, iterations.",
}


def build_report(run: Run) -> dict[str, Any]:
    """Makes every output of a run from `trials.npz`, `timing.npz`, `traces.npz`, `rollouts.npz` and `run.json`.

    Returns:
        The metrics, as written to metrics.json.
    """
    trials, timing = run.read_arrays("trials.npz"), run.read_arrays("timing.npz")
    traces, rollouts = run.read_arrays("traces.npz"), run.read_arrays("rollouts.npz")
    metrics: dict[str, Any] = {
        "run": run.read_json("run.json"),
        "starts": start_metrics(trials),
        "timing": timing_metrics(timing),
        "table_one": table_one(trials),
        "rollouts": rollout_metrics(rollouts),
    }
    metrics["claims"] = claims(trials, metrics)
    run.write_json("metrics.json", metrics)
    _draw(run, trials, traces, rollouts)
    context = {
        **metrics,
        "labels": LABELS,
        "sets": WRENCH_SETS,
        "scenarios": SCENARIO_LABELS,
        "figures": {name: text for name, text in FIGURES.items() if run.path(f"figures/{name}").is_file()},
    }
    run.write_text("report.md", render("report.md.j2", context))
    images = {
        name: base64.b64encode(run.path(f"figures/{name}").read_bytes()).decode("ascii") for name in context["figures"]
    }
    run.write_text("report.html", render("report.html.j2", {**context, "images": images}))
    return metrics


def _draw(run: Run, trials: Trials, traces: Trials, rollouts: Trials) -> None:
    drawings: dict[str, Callable[[], Figure]] = {
        "convergence.png": lambda: figures.convergence(traces),
        "iterations_ecdf.png": lambda: figures.iterations_ecdf(trials),
        "forces_over_time.png": lambda: figures.forces_over_time(trials),
        "start_against_optimum.png": lambda: figures.start_against_optimum(trials),
        "rollout.png": lambda: figures.rollout(rollouts),
    }
    for name, draw in drawings.items():
        figure = draw()
        run.write(f"figures/{name}", lambda path, figure=figure: figure.savefig(path, format="png", dpi=130))
        figures.close(figure)


def render(template: str, context: dict[str, Any]) -> str:
    """A template of this package, filled; one that names what `context` lacks raises."""
    environment = Environment(
        loader=PackageLoader("training", "templates"),
        autoescape=select_autoescape(["html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["percent"] = lambda value: "–" if value is None else f"{100 * value:.3g} %"
    return environment.get_template(template).render(context)


def number(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits and no exponent between 1e-3 and 1e5; an absent one as a dash.

    Example:
        >>> number(1234.5678), number(0.00012345), number(None), number(42)
        ('1235', '0.000123', '–', '42')
    """
    if value is None:
        return "–"
    if value == 0 or (float(value).is_integer() and abs(value) < 1e5):
        return f"{value:.0f}"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:.{digits}g}" if abs(value) >= 1e-4 else f"{value:.{digits - 1}e}"


def report_path(run: Run) -> Path:
    """The page to open."""
    return run.folder / "report.html"
