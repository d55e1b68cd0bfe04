"""Which starts stand for what in a comparison, and which of them needs the fewest iterations."""

from __future__ import annotations

from typing import Any

from training.cases.start_table import given_in
from training.trials.arrays import LIMIT

FLOW = "reduced_flow"
BASIS, PREVIOUS = "linear_combination", "previous_tangent"
NETWORK = "network"
MEMORYLESS = ("learned_fixed",)
"""The shipped model."""
SMALLEST_SHARE = 0.5
"""Of a set's cases that a start must apply to, to speak for the set."""
Metrics = dict[str, Any]


def wins(metrics: Metrics) -> list[dict[str, Any]]:
    """Per set, which of previous solution, learned (without memory), 12-basis and given starts needs the fewest iterations, each at its best.

    The 12-basis' best is mostly the control: followed by Newton steps, which are not counted.

    "winner" is None where only one of them applies. One beats another by a median at least 1.5 lower, or by a p99 more than a tenth (and more than 1) lower at the same median.
    """
    out = []
    for name, about in metrics["sets"].items():
        rows = metrics["starts"][FLOW][name]
        entries = {
            "previous": (PREVIOUS, "previous_pseudoinverse"),
            "learned": MEMORYLESS,
            "basis": (BASIS, "basis_tangent", "basis_newton"),
            **({"given": own} if (own := given_in(rows)) else {}),
        }
        known = {kind: [numbers(rows, key) for key in keys if applies(rows, key)] for kind, keys in entries.items()}
        found = {kind: min(rows, key=lambda row: (row["median"], row["p99"])) for kind, rows in known.items() if rows}
        unbeaten = [kind for kind, own in found.items() if not any(_beats(other, own) for other in found.values())]
        winner = None if len(found) < 2 else unbeaten[0] if len(unbeaten) == 1 else "tie"
        out.append({"set": name, "label": about["label"], **dict.fromkeys(entries), **found, "winner": winner})
    return out


def applies(rows: dict[str, Any], key: str) -> bool:
    """Whether a start has enough of a set's cases to speak for the set."""
    row = rows.get(key)
    return (
        row is not None and row["cases"] > 0 and row["cases"] >= SMALLEST_SHARE * (row["cases"] + row["not_applicable"])
    )


def numbers(rows: dict[str, Any], key: str) -> dict[str, Any]:
    """Median and p99 of the iterations; cases without a start rank last, as never ending, and are counted beside."""
    row, never = rows[key], float(LIMIT + 1)
    missing = row["no_start"] / row["cases"]
    median = never if missing >= 0.5 else row["iterations"]["median"]
    p99 = never if missing >= 0.01 else row["iterations"]["p99"]
    return {"start": key, "median": median, "p99": p99, "cases": row["cases"], "no_start": row["no_start"]}


def lacking(row: dict[str, Any] | None) -> str:
    """In words, on how many of its cases a start gave none; empty where it always did.

    Example:
        >>> lacking({"cases": 30, "no_start": 7}), lacking({"cases": 30, "no_start": 0}), lacking(None)
        ('no start on 7 of 30', '', '')
    """
    return f"no start on {row['no_start']} of {row['cases']}" if row and row.get("no_start") else ""


def _beats(one: dict[str, Any], other: dict[str, Any]) -> bool:
    if abs(one["median"] - other["median"]) >= 1.5:
        return one["median"] < other["median"]
    return other["p99"] - one["p99"] > max(1.0, 0.1 * other["p99"])
