"""The report of `grasp evaluate env`, from its saved trials: metrics.json, figures, report.md, self-contained report.html."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

from training.report import hold_figures as env_figures
from training.report.pages import render
from training.report.style import close
from training.runs import Run
from training.runs.words import number
from training.trials.hold_metrics import SAME_RULE, env_metrics, interval_text
from training.trials.hold_plan import BASELINES, CONTROLLER_LABELS, CURVES, ERRORS, SCENARIO_LABELS

FIGURES = {
    "rate_against_squeeze.png": "Hold rate against the squeeze it costs; the number beside a point is its "
    "friction margin, or its squeeze in newtons, bold the chosen one; 95 % intervals.",
    "drift_ecdf.png": "Largest drift of an episode by shape, paper's pipeline, random objects; lost ones count as never below.",
    "failures.png": "Episodes that were not held, by cause; of the swept settings only the chosen ones.",
}
_LISTED = 400
PROTOCOL = (
    "Every trial is an episode of FourFingerGrasp-v0 in an environment of its own (50 Hz agent, 250 Hz control and physics), no "
    "agent. A seed gives the object (any shape, 70 to 120 mm, 0.05 to 0.5 kg, friction 0.3 to 0.8, uniform) and the disturbance, "
    "the same for all controllers: comparisons are paired by seed. Objects that no reachable force-closure grasp is found for are "
    "redrawn before any controller sees them, and counted. A grasp that then does not close or settle counts as an episode not "
    "held (no_start). Lost: 20 mm or 0.35 rad away (six_directions: 50 mm, 15 degrees), or no force closure for 0.1 s; only "
    "controllers that optimise can lose by the last rule, which is the stricter one. All controllers start from the grasp that the "
    "paper's pipeline has settled; where friction is over-estimated the baselines' start uses a friction margin of 0.6.",
    "The random wrench is Ornstein-Uhlenbeck, 2 N and 0.06 N m standard deviation per axis (3.5 N and 0.10 N m root mean "
    "square), correlation time 0.3 s. Baselines: constant squeeze is a fixed internal force of 20 N in total (unless swept) plus "
    "the least-norm balance; PD holds each tip by a spring of 500 N/m. Only the controllers with measured wrench are told it; PD "
    "uses none. Tactile noise matters only where the wrench is estimated.",
    "Rates have 95 % Wilson intervals, means and paired differences 95 % bootstrap intervals. Drift and tilt are sampled at 50 Hz; "
    "their means are over the episodes that were held; the normal force is the measured total, averaged over the episode, "
    "over all that started.",
)


def build_env_report(run: Run) -> dict[str, Any]:
    """Makes every output of a run from `run.json` and `trials/`; returns the metrics, as written to metrics.json."""
    facts = run.read_json("run.json")
    trials = {cell["name"]: run.read_arrays(f"trials/{cell['name']}.npz") for cell in facts["cells"]}
    metrics = {"run": facts, **env_metrics(facts["cells"], trials)}
    facts["config"]["episodes_run"] = max((cell["episodes"] for cell in facts["cells"]), default=0)
    run.write_json("metrics.json", metrics)
    drawings: dict[str, Callable[[], Figure]] = {"failures.png": lambda: env_figures.failure_bars(metrics)}
    if "objects/paper" in trials:
        drawings["drift_ecdf.png"] = lambda: env_figures.drift_ecdf(trials)
    if metrics["chosen"]:
        drawings["rate_against_squeeze.png"] = lambda: env_figures.rate_against_squeeze(metrics)
    for name, draw in drawings.items():
        figure = draw()
        run.write(f"figures/{name}", lambda path, figure=figure: figure.savefig(path, format="png", dpi=130))
        close(figure)
    tables = [table for table in _tables(metrics) if table["rows"]]
    for table in tables:
        table["figures"] = [name for name in table["figures"] if name in drawings]
    context = {**metrics, "tables": tables, "protocol": PROTOCOL, "figures": FIGURES}
    run.write_text("report.md", render("env_report.md.j2", context))
    images = {name: base64.b64encode(run.path(f"figures/{name}").read_bytes()).decode("ascii") for name in drawings}
    run.write_text("report.html", render("env_report.html.j2", {**context, "images": images}))
    return metrics


def _tables(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    cells = metrics["cells"]

    def of(*scenarios: str) -> list[list[str]]:
        return [_row(row) for row in cells if row["scenario"] in scenarios]

    def sweep(scenario: str, figures: list[str]) -> dict[str, Any]:
        best = metrics["chosen"].get(scenario, {})
        chosen = ", ".join(
            f"{CONTROLLER_LABELS[row['controller']]} {_swept(row)}" for row in cells if row["name"] in best.values()
        )
        note = (
            f"Friction margin or squeeze is swept. The margin's rule: {metrics['margin_rule']}. The squeeze's: {SAME_RULE}. "
            f"Chosen: {chosen}. Differences are to the paper's pipeline at its chosen margin."
        )
        label = SCENARIO_LABELS[scenario]
        return _table(f"Rate against squeeze: {label}", note, of(scenario), figures)

    return [
        _table("Random objects, random wrench", "4 s against the random wrench.", of("objects"), ["drift_ecdf.png"]),
        {**_table("By shape", "The same episodes.", [
            [CONTROLLER_LABELS[key], shape, *_numbers(row)] for key, rows in metrics["shapes"].items() for shape, row in rows.items()
        ]), "columns": ["controller", "shape", *_COLUMNS], "words": ["controller", "shape"]},
        _table(
            "Six directions",
            "Pushes of 10 N/kg along the six axes, 12 s in one grasp; the baselines and the estimated wrench on a part of the seeds.",
            of("six_directions"),
        ),
        _table(
            "The paper's W_ext(t)", "Nothing is random: one episode each; the joints allow 12 N m.", of("path_0.25", "path_1")
        ),
        _table("One error at a time", "The random wrench again.", of(*ERRORS)),
        *(sweep(scenario, ["rate_against_squeeze.png"] if scenario == "all" else []) for scenario in CURVES),
        {
            "title": "Failures",
            "note": f"Every episode that was not held ({len(metrics['failures'])}); metrics.json has all"
            + (f", here the first {_LISTED}." if len(metrics["failures"]) > _LISTED else "."),
            "columns": ["cell", "seed", "cause", "object", "how"],
            "words": ["cell", "cause", "object", "how"],
            "rows": [
                [row["cell"], str(row["seed"]), row["cause"], row["object"], row["how"]] for row in metrics["failures"][:_LISTED]
            ],
            "figures": ["failures.png"],
        },
    ]  # fmt: skip


_COLUMNS = (
    "held", "rate, 95 % interval [%]", "largest drift, mean [mm]", "worst [mm]", "total normal force, mean [N]",
    "peak torque [N m]", "iterations, mean", "not held",
)  # fmt: skip


def _table(title: str, note: str, rows: list[list[str]], figures: list[str] | None = None) -> dict[str, Any]:
    columns = ["scenario", "controller", *_COLUMNS, "held more than the paper's [%]", "normal force more [N]"]
    words = ["scenario", "controller", "not held"]
    return {"title": title, "note": note, "columns": columns, "words": words, "rows": rows, "figures": figures or []}


def _row(row: dict[str, Any]) -> list[str]:
    pair = row["against_paper"]
    label = CONTROLLER_LABELS[row["controller"]] + ("" if row["swept"] is None else f", {_swept(row)}")
    difference = ["–", "–"] if pair is None else [_interval(pair["held"], 100.0), _interval(pair["normal_force"])]
    return [SCENARIO_LABELS[row["scenario"]], label, *_numbers(row), *difference]


def _numbers(row: dict[str, Any]) -> list[str]:
    return [
        f"{row['held']} of {row['episodes']}",
        f"{100 * row['rate']:.1f} [{100 * row['rate_low']:.1f}, {100 * row['rate_high']:.1f}]",
        _interval(row["max_drift_mm"]),
        number(row["largest_drift_mm"]),
        _interval(row["normal_force"]),
        number(row["peak_torque"]),
        number(row["iterations"]["mean"]),
        ", ".join(f"{count} {cause}" for cause, count in row["failures"].items()) or "–",
    ]


def _swept(row: dict[str, Any]) -> str:
    return f"margin {row['swept']:g}" if row["controller"] not in BASELINES else f"{row['swept']:g} N"


def _interval(mean: dict[str, Any], factor: float = 1.0) -> str:
    scaled = {key: None if mean[key] is None else factor * mean[key] for key in ("mean", "low", "high")}
    return interval_text(scaled, "").replace("  ", " ")
