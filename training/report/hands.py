"""The reports of engines and of hands side by side, from saved trials: metrics.json, figures, report.md, report.html."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.report.holds import CAUSE_COLOURS, NUMBERS, interval
from training.report.page import (
    Columns,
    Picture,
    Section,
    Table,
    at,
    claims_section,
    png,
    provenance_section,
    write_page,
)
from training.report.style import new_figure
from training.runs import Run
from training.runs.words import number
from training.trials.hand_metrics import hand_metrics, transfer_metrics
from training.trials.hand_plan import ENGINE_LABELS, short_name

COLOURS = {
    "bullet": "#1f5fa8", "mujoco": "#b3261e", "bullet_1000": "#5b9bd5", "noslip": "#c08a3e", "pyramidal": "#7a4fa3", "soft": "#2e8b57",
}  # fmt: skip
_LISTED = 400
_PROTOCOL = (
    "Every trial is an episode of FourFingerGrasp-v0 in an environment of its own, no agent; a seed gives the object and the disturbance, "
    "the same in all engines, and the same force loop drives them: joint torques go in, joints, object and contact forces come out. A "
    "hand without a place of its own is placed for each object; where no place is found, or the grasp does not settle, the episode counts "
    "as not held. Rates have 95 % Wilson intervals, means and paired differences 95 % bootstrap intervals; pairs that differ are told "
    "with the probability of as uneven a split by chance (McNemar, exact)."
)
_ENGINES = (
    "Bullet runs at the control rate of 250 Hz; MuJoCo at 1000 Hz, with elliptic cones, the stiffest contacts that its steps allow and no "
    "damping in the joints. Contact forces are means over a control tick in both."
)
_CONTACTS = (
    "From the numbers below. MuJoCo's pyramidal cones lie inside the round ones and touch them in four directions: between these they give "
    "0.71 of the friction, so a friction margin up to 0.7 is inside them. Its contacts are springs: soft ones let a finger sink in and "
    "creep, and forces arrive late."
)


def build_transfer_report(run: Run) -> dict[str, Any]:
    """Makes every output of a comparison of engines; returns the metrics, as written to metrics.json."""
    return _build(run, "Engines", transfer_metrics, _transfer_sections)


def build_hands_report(run: Run) -> dict[str, Any]:
    """Makes every output of a comparison of hands; returns the metrics, as written to metrics.json."""
    return _build(run, "Hands", hand_metrics, _hand_sections)


def _build(
    run: Run, title: str, measure: Callable[..., dict[str, Any]], sections: Callable[..., list[Section]]
) -> dict[str, Any]:
    facts = run.read_json("run.json")
    trials = {scenario["name"]: run.read_arrays(f"trials/{scenario['name']}.npz") for scenario in facts["scenarios"]}
    metrics = {"run": facts, "claims": [], **measure(facts["scenarios"], trials)}
    run.write_json("metrics.json", metrics)
    rows = metrics["rows"]
    pictures = [
        png(run, "figures/rates.png", rates(rows), "Hold rates", "Episodes held, with 95 % intervals."),
        png(run, "figures/causes.png", causes(rows), "Failures by cause", "Episodes that were not held, by cause."),
    ]
    write_page(run, f"{title}: {facts['config']['name']}", bool(facts["quick"]), sections(metrics, pictures))
    return metrics


def _transfer_sections(metrics: dict[str, Any], pictures: list[Picture]) -> list[Section]:
    return [
        claims_section(metrics),
        Section("findings", "What holds in one engine and falls in the other", (_CONTACTS,), (), metrics["findings"]),
        Section("rates", "Hold rates side by side", (_PROTOCOL, _ENGINES), [_table(metrics, TRANSFER), *pictures]),
        Section("speed", "Speed", (), [_speeds(metrics)]),
        *_ends(metrics),
    ]


def _hand_sections(metrics: dict[str, Any], pictures: list[Picture]) -> list[Section]:
    causes = (
        "Causes: dropped or drifted; torque (lost within half a second after torques had to be cut while the object was in its place: no force within the limits balanced the wrench); closure lost; not placed; "
        "no start (the fingers did not close, or the grasp did not settle), with the reasons that showed; simulation diverged."
    )
    return [
        Section("rates", "Hold rates", (_PROTOCOL, causes), [_table(metrics, HANDS), *pictures]),
        Section("speed", "Speed", (), [_speeds(metrics)]),
        *_ends(metrics),
    ]


def _ends(metrics: dict[str, Any]) -> list[Section]:
    lost, more = metrics["failures"], f", here the first {_LISTED}" if len(metrics["failures"]) > _LISTED else ""
    rows = [
        [row["cell"], ENGINE_LABELS[row["engine"]], str(row["seed"]), row["cause"], row["object"], row["how"]]
        for row in lost[:_LISTED]
    ]
    table = Table("Failures", ("scenario", "engine", "seed", "cause", "object", "how"), rows, words=6)
    note = f"Every episode that was not held ({len(lost)}); metrics.json has all{more}."
    return [Section("failures", "Failures", (note,), [table] if rows else ()), provenance_section(metrics["run"])]


def _table(metrics: dict[str, Any], columns: Columns) -> Table:
    return Table.of("Every scenario and engine", columns, [(row,) for row in metrics["rows"]], words=3)


def _speeds(metrics: dict[str, Any]) -> Table:
    rows = [
        [short_name(hand), ENGINE_LABELS[engine], number(rate)]
        for hand, rates in metrics["run"]["speed"].items() for engine, rate in rates.items()
    ]  # fmt: skip
    return Table("Agent steps per second, one environment alone", ("hand", "engine", "steps per second"), rows, words=2)


def _against(text: Callable[[dict[str, Any]], str]) -> Callable[..., str]:
    return lambda row: "–" if row["against"] is None else text(row["against"])


_FIRST: Columns = (
    ("hand", lambda row: row["hand"]),
    ("scenario", lambda row: row["label"]),
    ("engine", lambda row: ENGINE_LABELS[row["engine"]]),
    *NUMBERS,
    ("force error, mean [N]", lambda row: interval(row["force_error"])),
)
_DIFFERENCE: Columns = (
    ("held more than the first [%]", _against(lambda pair: interval(pair["held"], 100.0))),
    ("pairs held by it alone, by the first alone", _against(lambda pair: f"{pair['only_this']}, {pair['only_base']}")),
    ("chance", _against(lambda pair: number(pair["chance"], 2))),
)
TRANSFER: Columns = (
    *_FIRST,
    *_DIFFERENCE,
    ("normal force more [N]", _against(lambda pair: interval(pair["normal_force"]))),
)
HANDS: Columns = (
    *_FIRST,
    ("torque margin, mean [N m]", lambda row: interval(row["torque_margin"])),
    ("least", lambda row: number(at(row, "least_margin"))),
    ("episodes with torques cut", lambda row: str(row["saturated"])),
    ("limited iterations", lambda row: interval(row["limited"])),
    ("why not started", lambda row: ", ".join(f"{count} {reason}" for reason, count in row["reasons"].items()) or "–"),
    *_DIFFERENCE,
)


def rates(rows: list[dict[str, Any]]) -> Figure:
    """Hold rates with intervals, a line for every scenario, a colour for every engine."""
    places = {name: k for k, name in enumerate(dict.fromkeys(row["scenario"] for row in rows))}
    labels = {row["scenario"]: f"{row['hand']}: {row['label']}" for row in rows}
    figure, axes = new_figure(9.6, 1.2 + 0.42 * len(places))
    for engine, colour in COLOURS.items():
        mine = [row for row in rows if row["engine"] == engine]
        if not mine:
            continue
        shift = 0.13 * (list(COLOURS).index(engine) - 1)
        rate = np.array([[row["rate"], row["rate_low"], row["rate_high"]] for row in mine]) * 100.0
        axes.errorbar(
            rate[:, 0], [places[row["scenario"]] + shift for row in mine],
            xerr=np.maximum([rate[:, 0] - rate[:, 1], rate[:, 2] - rate[:, 0]], 0.0), fmt="o", markersize=4, linewidth=1.0, color=colour,
            label=ENGINE_LABELS[engine],
        )  # fmt: skip
    axes.set(
        xlabel="episodes held [%]",
        xlim=(-3, 103),
        yticks=range(len(places)),
        yticklabels=[labels[name] for name in places],
    )
    axes.tick_params(axis="y", labelsize=7)
    axes.set_ylim(len(places) - 0.4, -0.6)
    axes.grid(axis="x", linewidth=0.4)
    figure.legend(fontsize=8, frameon=False, loc="outside upper center", ncols=3)
    return figure


def causes(rows: list[dict[str, Any]]) -> Figure:
    """Share of episodes that were not held, by cause, for every scenario and engine."""
    figure, axes = new_figure(9.6, 1.2 + 0.24 * len(rows))
    left = np.zeros(len(rows))
    for cause, colour in CAUSE_COLOURS.items():
        share = np.array([100 * row["failures"].get(cause, 0) / row["episodes"] for row in rows])
        if share.any():
            axes.barh(np.arange(len(rows)), share, left=left, color=colour, label=cause.replace("_", " "))
            left += share
    labels = [f"{row['hand']}: {row['label']}: {ENGINE_LABELS[row['engine']]}" for row in rows]
    axes.set(yticks=np.arange(len(rows)), yticklabels=labels, xlabel="episodes not held [%]", xlim=(0, 100))
    axes.tick_params(axis="y", labelsize=6)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if left.any():
        axes.legend(fontsize=8, frameon=False)
    return figure
