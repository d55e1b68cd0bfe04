"""The report of the hold rates, from saved trials: metrics.json, figures, report.md, report.html. Nothing is simulated here."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.report.first import found_section
from training.report.glossary import HOLDS
from training.report.page import (
    Columns,
    Picture,
    Section,
    Table,
    claims_section,
    png,
    provenance_section,
    shown,
    write_page,
)
from training.report.style import new_figure
from training.runs import Run
from training.trials.arrays import Trials
from training.trials.hold_metrics import ASKED_RATE, SAME_RULE, env_metrics, interval_text
from training.trials.hold_plan import BASELINES, CONTROLLER_LABELS, CURVES, ERRORS, SAFE_START, SCENARIO_LABELS

_LISTED = 400


def build_env_report(run: Run) -> dict[str, Any]:
    """Makes every output of a run from `run.json` and `trials/`; returns the metrics, as written to metrics.json."""
    facts = run.read_json("run.json")
    trials = {cell["name"]: run.read_arrays(f"trials/{cell['name']}.npz") for cell in facts["cells"]}
    metrics = {"run": facts, **env_metrics(facts["cells"], trials)}
    facts["config"]["episodes_run"] = max((cell["episodes"] for cell in facts["cells"]), default=0)
    run.write_json("metrics.json", metrics)
    name = f"Hold rates: {facts['config']['name']}"
    write_page(run, name, bool(facts["quick"]), _sections(metrics, _pictures(run, metrics, trials)))
    return metrics


def _pictures(run: Run, metrics: dict[str, Any], trials: dict[str, Trials]) -> dict[str, Picture]:
    """The figures that this run has trials for, by name."""
    drawings: dict[str, tuple[Figure, str, str]] = {"failures": (
        failure_bars(metrics), "Failures by cause", "Episodes that were not held, by cause; of the swept settings only the chosen ones."
    )}  # fmt: skip
    if "objects/paper" in trials:
        text = "Largest drift of an episode by shape, paper's pipeline, random objects; lost ones count as never below."
        drawings["drift_ecdf"] = drift_ecdf(trials), "Drift by shape", text
    if metrics["chosen"]:
        text = (
            "Hold rate against the squeeze it costs; the number beside a point is its friction margin, or its squeeze in newtons, bold "
            "the chosen one; 95 % intervals."
        )
        drawings["rate_against_squeeze"] = rate_against_squeeze(metrics), "Rate against squeeze", text
    return {name: png(run, f"figures/{name}.png", *drawing) for name, drawing in drawings.items()}


def _protocol(metrics: dict[str, Any]) -> list[str]:
    """How the episodes were made, in the numbers of this run's own settings."""
    resolved = {cell["scenario"]: cell["resolved"] for cell in reversed(metrics["run"]["cells"])}
    base = resolved.get("objects") or next(iter(resolved.values()))
    size, mass, friction = (base[f"{name}_range"] for name in ("size", "mass", "friction"))
    drift, tilt = 1e3 * base["max_drift"], base["max_tilt"]
    pushed = resolved.get("six_directions")
    also = (
        f" (six_directions: {1e3 * pushed['max_drift']:g} mm, {math.degrees(pushed['max_tilt']):.3g} degrees)"
        if pushed
        else ""
    )
    force, moment = base["random_force"], base["random_moment"]
    return [
        f"Every trial is an episode of FourFingerGrasp-v0 in an environment of its own ({base['agent_rate']} Hz agent, "
        f"{base['control_rate']} Hz control, {base['physics_rate']} Hz physics), no agent. A seed gives the object (any shape, "
        f"{1e3 * size[0]:g} to {1e3 * size[1]:g} mm, {mass[0]:g} to {mass[1]:g} kg, friction {friction[0]:g} to {friction[1]:g}, "
        "uniform) and the disturbance, the same for all controllers: comparisons are paired by seed. Objects that no reachable "
        "force-closure grasp is found for are redrawn before any controller sees them, and counted. A grasp that then does not close "
        f"or settle counts as an episode not held (no_start). Lost: {drift:g} mm or {tilt:g} rad away{also}, or no force closure "
        f"for {base['max_contact_gap']:g} s; only controllers that optimise can lose by the last rule, which is the stricter one. "
        "All controllers start from the grasp that the paper's pipeline has settled; where friction is over-estimated the "
        f"baselines' start uses a friction margin of {SAFE_START['friction_margin']:g}.",
        f"The random wrench is Ornstein-Uhlenbeck, {force:g} N and {moment:g} N m standard deviation per axis "
        f"({math.sqrt(3.0) * force:.2g} N and {math.sqrt(3.0) * moment:.2g} N m root mean square), correlation time "
        f"{base['random_time']:g} s. Baselines: constant squeeze is a fixed internal force of {base['squeeze']:g} N in total "
        "(unless swept) plus the least-norm balance; PD holds each tip by a spring of "
        f"{base['pd_stiffness']:g} N/m. Only the controllers with measured wrench are told it; PD uses none. Tactile noise matters "
        "only where the wrench is estimated.",
        "Rates have 95 % Wilson intervals, means and paired differences 95 % bootstrap intervals. Drift and tilt are sampled at "
        f"{base['agent_rate']} Hz; their means are over the episodes that were held; the normal force is the measured total, averaged "
        "over the episode, over all that started.",
    ]


def _sections(metrics: dict[str, Any], pictures: dict[str, Picture]) -> list[Section | None]:
    cells = metrics["cells"]
    resolved = {cell["scenario"]: cell["resolved"] for cell in metrics["run"]["cells"]}

    def of(title: str, note: str, *scenarios: str, figure: str = "") -> Section:
        rows = [(row,) for row in cells if row["scenario"] in scenarios]
        return _section(note, Table.of(title, CELLS, rows, words=2), pictures.get(figure))

    def sweep(scenario: str, figure: str) -> Section:
        best = metrics["chosen"].get(scenario, {})
        chosen = ", ".join(
            f"{CONTROLLER_LABELS[row['controller']]} {_swept(row)}" for row in cells if row["name"] in best.values()
        )
        note = (
            f"Friction margin or squeeze is swept. The margin's rule: {metrics['margin_rule']}. The squeeze's: {SAME_RULE}. "
            f"Chosen: {chosen}. Differences are to the paper's pipeline at its chosen margin."
        )
        return of(f"Rate against squeeze: {SCENARIO_LABELS[scenario]}", note, scenario, figure=figure)

    by_shape = [(key, shape, row) for key, rows in metrics["shapes"].items() for shape, row in rows.items()]
    pushed, objects, limit = resolved.get("six_directions"), resolved.get("objects"), metrics["run"].get("torque_limit")
    push = (
        f"Pushes of {pushed['push_per_mass']:g} N/kg along the six axes, {pushed['duration']:g} s in one grasp; "
        if pushed
        else ""
    )
    lost, more = metrics["failures"], f", here the first {_LISTED}" if len(metrics["failures"]) > _LISTED else ""
    told = [[row["cell"], str(row["seed"]), row["cause"], row["object"], row["how"]] for row in lost[:_LISTED]]
    return [
        found_section(metrics["found"], (), HOLDS),
        claims_section(metrics),
        Section("protocol", "How it was measured", (), (), _protocol(metrics)),
        of("Random objects, random wrench", f"{objects['duration']:g} s against the random wrench." if objects else "", "objects", figure="drift_ecdf"),
        _section("The same episodes.", Table.of("By shape", SHAPES, by_shape, words=2)),
        of("Six directions", f"{push}{_fewer(cells)}", "six_directions"),
        of("The paper's W_ext(t)", "Nothing is random: one episode each" + (f"; the joints allow {limit:g} N m." if limit else "."), "path_0.25", "path_1"),
        of("One error at a time", "The random wrench again.", *ERRORS),
        *(sweep(scenario, "rate_against_squeeze" if scenario == "all" else "") for scenario in CURVES),
        _section(
            f"Every episode that was not held ({len(lost)}); metrics.json has all{more}.",
            Table("Failures", ("cell", "seed", "cause", "object", "how"), told, words=5),
            pictures.get("failures"),
        ),
        provenance_section(metrics["run"]),
    ]  # fmt: skip


def _fewer(cells: list[dict[str, Any]]) -> str:
    """Whether all controllers met as many pushes."""
    counts = {row["controller"]: row["episodes"] for row in cells if row["scenario"] == "six_directions"}
    part = [CONTROLLER_LABELS[key] for key, count in counts.items() if count < max(counts.values())]
    return f"a part of the seeds alone: {', '.join(part)}." if part else "the same seeds for all."


def _section(note: str, table: Table, picture: Picture | None = None) -> Section:
    """A table and its figure, under the table's name; empty without rows."""
    key = "".join(letter if letter.isalnum() else "-" for letter in table.caption.lower())
    return Section(key, table.caption, (note,), [table, *([picture] if picture else [])] if table.rows else ())


def _label(row: dict[str, Any]) -> str:
    return CONTROLLER_LABELS[row["controller"]] + ("" if row["swept"] is None else f", {_swept(row)}")


def _difference(name: str, factor: float) -> Callable[..., str]:
    return lambda row: "–" if row["against_paper"] is None else interval(row["against_paper"][name], factor)


def _rate_text(row: dict[str, Any]) -> str:
    return f"{100 * row['rate']:.1f} [{100 * row['rate_low']:.1f}, {100 * row['rate_high']:.1f}]"


NUMBERS: Columns = (
    ("held", lambda *item: f"{item[-1]['held']} of {item[-1]['episodes']}"),
    ("rate, 95 % interval [%]", lambda *item: _rate_text(item[-1])),
    ("largest drift, mean [mm]", lambda *item: interval(item[-1]["max_drift_mm"])),
    ("worst [mm]", shown("largest_drift_mm")),
    ("total normal force, mean [N]", lambda *item: interval(item[-1]["normal_force"])),
    ("peak torque [N m]", shown("peak_torque")),
    ("iterations, mean", shown("iterations", "mean")),
    ("not held", lambda *item: ", ".join(f"{count} {cause}" for cause, count in item[-1]["failures"].items()) or "–"),
)
"""Of every cell; see `hold_metrics.CELL_METRICS`."""
CELLS: Columns = (
    ("scenario", lambda row: SCENARIO_LABELS[row["scenario"]]),
    ("controller", _label),
    *NUMBERS,
    ("held more than the paper's [%]", _difference("held", 100.0)),
    ("normal force more [N]", _difference("normal_force", 1.0)),
    ("drift, mean over an episode [mm]", lambda row: interval(row["mean_drift_mm"])),
    ("slip, mean [mm]", lambda row: interval(row["slip_mm"])),
    ("started", shown("started")),
    ("objects redrawn", shown("unreachable")),
)
SHAPES: Columns = (
    ("controller", lambda key, shape, row: CONTROLLER_LABELS[key]),
    ("shape", lambda key, shape, row: shape),
    *NUMBERS,
)


def _swept(row: dict[str, Any]) -> str:
    return f"margin {row['swept']:g}" if row["controller"] not in BASELINES else f"{row['swept']:g} N"


def interval(mean: dict[str, Any], factor: float = 1.0) -> str:
    """A mean with its interval, times a factor."""
    scaled = {key: None if mean[key] is None else factor * mean[key] for key in ("mean", "low", "high")}
    return interval_text(scaled, "").replace("  ", " ")


COLOURS = {"paper": "#1f5fa8", "estimated": "#2e8b57", "constant_squeeze": "#c08a3e", "pd": "#b3261e"}
_SHAPE_COLOURS = {"cuboid": "#1f5fa8", "cylinder": "#2e8b57", "sphere": "#b3261e", "capsule": "#c08a3e"}
CAUSE_COLOURS = {
    "no_start": "#8a8a8a", "not_placed": "#c9c9c9", "torque": "#1f5fa8", "dropped": "#b3261e", "drifted": "#e07a5f", "closure_lost": "#c08a3e",
    "force_optimisation": "#7a4fa3", "simulation_diverged": "#1b1b1b",
}  # fmt: skip


def rate_against_squeeze(metrics: dict[str, Any]) -> Figure:
    """Hold rate against the mean total normal force that it costs, one panel per scenario, one point per swept value."""
    figure, panels = new_figure(8.2, 3.4 * len(metrics["chosen"]), rows=len(metrics["chosen"]))
    for axes, (scenario, chosen) in zip(np.ravel(panels), metrics["chosen"].items(), strict=True):
        for key, best in chosen.items():
            rows = [row for row in metrics["cells"] if (row["scenario"], row["controller"]) == (scenario, key)]
            _curve(axes, [row for row in rows if row["normal_force"]["mean"] is not None], key, best)
        axes.axhline(100 * ASKED_RATE, color="black", linewidth=0.8, linestyle=":")
        axes.set(xscale="log", ylabel="episodes held [%]", ylim=(-4, 108))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        axes.set_title(SCENARIO_LABELS[scenario], fontsize=9)
    np.ravel(panels)[-1].set_xlabel("mean total normal force [N], measured")
    handles, names = np.ravel(panels)[-1].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, frameon=False, loc="outside upper center", ncols=2)
    return figure


def _curve(axes: Any, rows: list[dict[str, Any]], key: str, best: str) -> None:
    """One controller's points with intervals, each with its swept value, that of `best` bold."""
    if not rows:
        return
    force, rate = np.array([_triple(row["normal_force"]) for row in rows]), np.array([_rate(row) for row in rows])
    axes.errorbar(
        force[:, 0], 100 * rate[:, 0], xerr=_bars(force), yerr=100 * _bars(rate), fmt="o-", color=COLOURS[key],
        label=CONTROLLER_LABELS[key], linewidth=1.0, elinewidth=0.8, markersize=4,
    )  # fmt: skip
    for row, x, y in zip(rows, force[:, 0], 100 * rate[:, 0], strict=True):
        axes.annotate(
            f"{row['swept']:g}", (x, y), textcoords="offset points", xytext=(3, 4), fontsize=7, color=COLOURS[key],
            weight="bold" if row["name"] == best else "normal",
        )  # fmt: skip


def drift_ecdf(trials: dict[str, Trials]) -> Figure:
    """Share of episodes whose largest drift is below x, paper's pipeline on random objects, by shape; lost ones never are."""
    figure, axes = new_figure(7.2, 4.2)
    mine = trials["objects/paper"]
    for shape, colour in _SHAPE_COLOURS.items():
        pick = mine["shape"] == shape
        if not pick.any():
            continue
        drift = np.sort(1e3 * mine["max_drift"][pick & mine["held"]])
        share = np.arange(1, len(drift) + 1) / pick.sum()
        axes.step(np.maximum(drift, 1e-4), share, where="post", color=colour, label=f"{shape} ({pick.sum()})")
    axes.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", xlabel="largest drift of an episode [mm]", ylabel="share of episodes", ylim=(0, 1.01))
    axes.legend(fontsize=8, frameon=False)
    return figure


def cause_bars(rows: list[dict[str, Any]], labels: list[str], size: tuple[float, float], letters: int) -> Figure:
    """Share of episodes that were not held, by cause, a bar a row.

    Args:
        rows: with failures and episodes.
        labels: of the bars.
        size: width, and height without the bars [inches].
        letters: size of the labels [points].
    """
    figure, axes = new_figure(size[0], size[1] + 0.24 * len(rows))
    left = np.zeros(len(rows))
    for cause, colour in CAUSE_COLOURS.items():
        share = np.array([100 * row["failures"].get(cause, 0) / row["episodes"] for row in rows])
        if share.any():
            axes.barh(np.arange(len(rows)), share, left=left, color=colour, label=cause.replace("_", " "))
            left += share
    axes.set(yticks=np.arange(len(rows)), yticklabels=labels, xlabel="episodes not held [%]", xlim=(0, 100))
    axes.tick_params(axis="y", labelsize=letters)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if left.any():
        axes.legend(fontsize=8, frameon=False)
    return figure


def failure_bars(metrics: dict[str, Any]) -> Figure:
    """Share of episodes that were not held, by cause, for every cell but the swept ones."""
    chosen = {name for best in metrics["chosen"].values() for name in best.values()}
    rows = [row for row in metrics["cells"] if row["swept"] is None or row["name"] in chosen]
    return cause_bars(rows, [_cell_label(row) for row in rows], (8.8, 0.9), 7)


def _cell_label(row: dict[str, Any]) -> str:
    swept = "" if row["swept"] is None else f", {row['swept']:g}"
    return f"{SCENARIO_LABELS[row['scenario']]}: {CONTROLLER_LABELS[row['controller']]}{swept}"


def _triple(mean: dict[str, Any]) -> tuple[float, float, float]:
    return mean["mean"], mean["low"], mean["high"]


def _rate(row: dict[str, Any]) -> tuple[float, float, float]:
    return row["rate"], row["rate_low"], row["rate_high"]


def _bars(values: np.ndarray) -> np.ndarray:
    """(2, n) lengths of error bars of (n, 3) values, lower and upper ends."""
    return np.maximum(np.stack([values[:, 0] - values[:, 1], values[:, 2] - values[:, 0]]), 0.0)
