"""The reports of engines and of hands side by side, from saved trials: metrics.json, figures, report.md, report.html."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.report.first import found_section
from training.report.glossary import HOLDS as GLOSSARY
from training.report.holds import NUMBERS, cause_bars, interval
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
_OBJECTS = (
    "The cube and the sphere weigh 0.15 kg and have a friction of 0.7; random objects measure 40 to 80 mm, weigh 0.05 to 0.3 kg and have a "
    "friction of 0.5 to 1. Gravity and the random wrench (0.6 N and 0.02 N m standard deviation per axis) act for 4 s, each of the six "
    "pushes of 10 N/kg for 2 s. Where nothing is random one episode says it all."
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
    run: Run, title: str, measure: Callable[..., dict[str, Any]], sections: Callable[..., list[Section | None]]
) -> dict[str, Any]:
    facts = run.read_json("run.json")
    trials = {scenario["name"]: run.read_arrays(f"trials/{scenario['name']}.npz") for scenario in facts["scenarios"]}
    metrics = {"run": facts, "claims": [], **measure(facts["scenarios"], trials)}
    run.write_json("metrics.json", metrics)
    rows = metrics["rows"]
    pictures = [
        png(run, "figures/rates.png", *(table_of_rates(rows) if _is_table(rows) else rates(rows))),
        png(run, "figures/causes.png", causes(rows), "Failures by cause", "Episodes that were not held, by cause."),
        png(run, "figures/margins.png", margins(rows), "Torque margins", "How near torques come to their limits."),
    ]
    write_page(run, f"{title}: {facts['config']['name']}", bool(facts["quick"]), sections(metrics, pictures))
    return metrics


def _transfer_sections(metrics: dict[str, Any], pictures: list[Picture]) -> list[Section | None]:
    return [
        found_section(metrics["found"], (), GLOSSARY),
        claims_section(metrics),
        Section(
            "findings",
            "What holds in one engine and falls in the other",
            (_CONTACTS,) if {"pyramidal", "soft"} <= {row["engine"] for row in metrics["rows"]} else (),
            (),
            metrics["findings"],
        ),
        Section("rates", "Hold rates side by side", (_PROTOCOL, _ENGINES), [_table(metrics, TRANSFER), *pictures]),
        Section("speed", "Speed", (), [_speeds(metrics)]),
        *_ends(metrics),
    ]


def _hand_sections(metrics: dict[str, Any], pictures: list[Picture]) -> list[Section | None]:
    causes = (
        "Causes: dropped or drifted; torque (lost within half a second after torques had to be cut while the object was in its place: no force within the limits balanced the wrench); closure lost; not placed; "
        "no start (the fingers did not close, or the grasp did not settle), with the reasons that showed; simulation diverged."
    )
    return [
        found_section(metrics["found"], pictures[:1], GLOSSARY),
        Section("rates", "Hold rates", (_PROTOCOL, _OBJECTS, causes), [_table(metrics, HANDS), *pictures[1:]]),
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


def _is_table(rows: list[dict[str, Any]]) -> bool:
    """Whether several hands met the same scenarios in one engine."""
    return len({row["hand"] for row in rows}) > 1 and len({row["engine"] for row in rows}) == 1


def table_of_rates(rows: list[dict[str, Any]]) -> tuple[Figure, str, str]:
    """Hold rates as a heat map: a line for every hand, a column for every scenario, the numbers in it; and what it is called."""
    hands, labels = (list(dict.fromkeys(row[key] for row in rows)) for key in ("hand", "label"))
    rate = np.full((len(hands), len(labels)), np.nan)
    figure, axes = new_figure(9.6, 1.9 + 0.36 * len(hands))
    for row in rows:
        place = hands.index(row["hand"]), labels.index(row["label"])
        rate[place] = row["rate"]
        dark = row["rate"] > 0.6
        axes.text(
            *place[::-1],
            f"{row['held']}/{row['episodes']}",
            ha="center",
            va="center",
            fontsize=8,
            color="white" if dark else "black",
        )
    axes.imshow(rate, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(labels)), [_broken(label) for label in labels], fontsize=7)
    axes.set_yticks(range(len(hands)), hands, fontsize=8)
    axes.tick_params(length=0, top=True, labeltop=True, bottom=False, labelbottom=False)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return (
        figure,
        "Hold rates",
        "Episodes held, of as many; the darker the more. Empty: not asked. The table has the intervals.",
    )


def _broken(label: str, wanted: int = 13) -> str:
    """A label over several lines."""
    return "\n".join(textwrap.wrap(label, wanted))


def rates(rows: list[dict[str, Any]]) -> tuple[Figure, str, str]:
    """Hold rates with intervals, a line for every scenario, a colour for every engine; and what it is called."""
    places = {name: k for k, name in enumerate(dict.fromkeys(row["scenario"] for row in rows))}
    labels = {row["scenario"]: f"{row['hand']}: {row['label']}" for row in rows}
    figure, axes = new_figure(9.6, 1.2 + 0.42 * len(places))
    for engine, colour in COLOURS.items():
        mine = [(place, row) for place, row in zip(_places(rows, places), rows, strict=True) if row["engine"] == engine]
        if mine:
            rate = np.array([[row["rate"], row["rate_low"], row["rate_high"]] for _, row in mine]) * 100.0
            bars = np.maximum([rate[:, 0] - rate[:, 1], rate[:, 2] - rate[:, 0]], 0.0)
            axes.errorbar(
                rate[:, 0], [place for place, _ in mine], xerr=bars, fmt="o", markersize=4, linewidth=1.0, color=colour,
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
    return figure, "Hold rates", "Episodes held, with 95 % intervals."


def margins(rows: list[dict[str, Any]]) -> Figure:
    """Mean over the episodes of the least torque margin, and the least of all, a line for every scenario and engine."""
    rows = [row for row in rows if row["least_margin"] is not None]
    places = np.arange(len(rows))
    figure, axes = new_figure(9.6, 1.2 + 0.24 * len(rows))
    axes.plot([row["torque_margin"]["mean"] for row in rows], places, "o", color="#1f5fa8", label="mean over episodes")
    axes.plot([row["least_margin"] for row in rows], places, "x", color="#b3261e", label="least of all")
    axes.set(
        xlabel="least distance of a torque from its limit in an episode [N m]",
        yticks=places,
        yticklabels=list(map(_label, rows)),
    )
    axes.tick_params(axis="y", labelsize=6)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(left=0.0)
    axes.legend(fontsize=8, frameon=False)
    return figure


def _places(rows: list[dict[str, Any]], places: dict[str, int]) -> Iterator[float]:
    """Where a row stands: its scenario's line, engines beside one another."""
    for row in rows:
        engines = [other["engine"] for other in rows if other["scenario"] == row["scenario"]]
        yield places[row["scenario"]] + 0.13 * (engines.index(row["engine"]) - 0.5 * (len(engines) - 1))


def _label(row: dict[str, Any]) -> str:
    return f"{row['hand']}: {row['label']}: {ENGINE_LABELS[row['engine']]}"


def causes(rows: list[dict[str, Any]]) -> Figure:
    """Share of episodes that were not held, by cause, for every scenario and engine."""
    return cause_bars(rows, list(map(_label, rows)), (9.6, 1.2), 6)
