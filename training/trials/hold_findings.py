"""What hold rates, hands and engines show, in up to three sentences each, from the run's own numbers."""

from __future__ import annotations

from collections import Counter
from typing import Any

from training.runs.words import number
from training.trials.hand_plan import ENGINE_LABELS
from training.trials.hold_plan import CONTROLLER_LABELS, CONTROLLERS, SCENARIO_LABELS

PAPER = "paper"
Row = dict[str, Any]


def holds_found(metrics: dict[str, Any]) -> list[str]:
    """Who holds random objects, at which squeeze, and what errors change; what a run lacks is left out."""
    named = {row["name"]: row for row in metrics["cells"]}
    out = []
    for scenario, about in (("objects", "Held"), ("six_directions", "Pushed")):
        cells = {key: named[f"{scenario}/{key}"] for key in CONTROLLERS if f"{scenario}/{key}" in named}
        if cells:
            out.append(f"{about}: {SCENARIO_LABELS[scenario]}. {_beside(cells)}.")
    chosen = {name: {key: named[cell] for key, cell in keys.items()} for name, keys in metrics["chosen"].items()}
    hardest = min(
        (name for name in chosen if PAPER in chosen[name]), key=lambda name: chosen[name][PAPER]["rate"], default=None
    )
    if hardest is not None:
        out.append(
            f"With errors: {SCENARIO_LABELS[hardest]}, each at the best of its own settings. {_beside(chosen[hardest])}."
        )
    return out


def _beside(cells: dict[str, Row]) -> str:
    """The controllers beside one another, the paper's first."""
    return "; ".join(f"“{CONTROLLER_LABELS[key]}” holds {_with_force(row)}" for key, row in cells.items())


def _with_force(row: Row) -> str:
    force = row["normal_force"]["mean"]
    return _held(row) + ("" if force is None else f" at a squeeze of {number(force)} N")


def _held(row: Row) -> str:
    return f"{row['held']} of {row['episodes']}"


def hands_found(rows: list[Row]) -> list[str]:
    """Which hands hold most and least, on what, and why what falls does."""
    sums = _summed(rows, "hand")
    best, least = (kind(row["rate"] for row in sums.values()) for kind in (max, min))
    first = [hand for hand, row in sums.items() if row["rate"] == best]
    last = [hand for hand, row in sums.items() if row["rate"] == least]
    out = [
        f"Held: of {len(sums)} hands most by {_names(first)}, {_each(sums, first)}"
        + (f"; least by {_names(last)}, {_each(sums, last)}." if least < best else ".")
    ]
    if len(sums) == 1:
        out = [f"Held: {first[0]}, {_held(sums[first[0]])} episodes."]
    scenes = _summed(rows, "label")
    hard = min(scenes, key=lambda label: scenes[label]["rate"])
    easy = max(scenes, key=lambda label: scenes[label]["rate"])
    if scenes[hard]["rate"] < scenes[easy]["rate"]:
        out.append(f"Hardest: {hard}, {_held(scenes[hard])}; easiest: {easy}, {_held(scenes[easy])}.")
    return [*out, *_falls(rows)]


def transfer_found(rows: list[Row]) -> list[str]:
    """Whether one engine holds what another does, where they differ most, and why what falls does."""
    sums = _summed(rows, "engine")
    told = [f"{ENGINE_LABELS[engine]} {_held(row)} ({100 * row['rate']:.3g} %)" for engine, row in sums.items()]
    out = [f"Held: {'; '.join(told)}."]
    pairs = [row for row in rows if row["against"] is not None]
    apart = [row for row in pairs if row["against"]["chance"] < 0.05]
    if pairs:
        worst = min(apart, key=lambda row: row["against"]["chance"], default=None)
        where = (
            ""
            if worst is None
            else f", most in {worst['hand']}, {worst['label']}, {ENGINE_LABELS[worst['engine']]} ({_held(worst)})"
        )
        out.append(
            f"Differences: {len(apart)} of {len(pairs)} comparisons with the first engine differ beyond chance (5 %){where}."
        )
    return [*out, *_falls(rows)]


def _falls(rows: list[Row]) -> list[str]:
    causes = Counter[str]()
    for row in rows:
        causes.update(row["failures"])
    lost, episodes = sum(row["episodes"] - row["held"] for row in rows), sum(row["episodes"] for row in rows)
    if not lost:
        return [f"What falls: none of {episodes} episodes."]
    told = ", ".join(f"{count} {cause.replace('_', ' ')}" for cause, count in causes.most_common(4))
    return [f"What falls: {lost} of {episodes} episodes: {told}."]


def _summed(rows: list[Row], by: str) -> dict[str, Row]:
    out: dict[str, Row] = {}
    for row in rows:
        entry = out.setdefault(row[by], {"held": 0, "episodes": 0})
        entry["held"] += row["held"]
        entry["episodes"] += row["episodes"]
    for entry in out.values():
        entry["rate"] = entry["held"] / max(1, entry["episodes"])
    return out


def _each(sums: dict[str, Row], names: list[str]) -> str:
    told = dict.fromkeys(_held(sums[name]) for name in names)
    return next(iter(told)) + " each" * (len(names) > 1) if len(told) == 1 else "; ".join(told)


def _names(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{', '.join(names[:5])} and {len(names) - 5} others"
