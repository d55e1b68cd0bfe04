"""The tables of `grasp bench core`."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from training.bench.core import ROWS


def show_core(result: dict[str, Any], console: Console) -> None:
    """Prints medians and p99 of both sides with their ratios, first solves, claims, and what could not be timed."""
    two = result["baseline"] is not None
    for count in dict.fromkeys(row["contacts"] for row in result["rows"]):
        columns = ("old us", "new us", "new / old", "asked") if two else ("us",)
        table = Table("row", *columns, title=f"{count} contacts, median / p99")
        for row in (row for row in result["rows"] if row["contacts"] == count):
            table.add_row(row["method"], *_cells(row, two))
        console.print(table)
    for key in dict.fromkeys(row["method"] for row in result["rows"]):
        console.print(f"{key}: {ROWS[key]}", style="dim", highlight=False)
    if result["starts"]:
        table = Table(
            "first solve of a process", "side", "median s", "least", "most", "of it imports", "imported by then"
        )
        for row in result["starts"]:
            table.add_row(
                row["method"], row["side"], f"{row['median_s']:.2f}", f"{row['min_s']:.2f}", f"{row['max_s']:.2f}",
                f"{row['import_median_s']:.2f}", ", ".join(row["loaded"]) or "neither scipy nor torch",
            )  # fmt: skip
        console.print(table)
    for row in result["rows"]:
        if row["failed"] or row.get("baseline_failed"):
            before = f", of the baseline's {row['baseline_failed']}" if two else ""
            failed = f"{row['failed']} of {row['problems']} not optimal{before}"
            console.print(f"{row['method']}, {row['contacts']} contacts: {failed}", style="bold", highlight=False)
    for name, reason in result["missing"].items():
        console.print(f"{name} is left out: {reason}", style="dim", highlight=False)
    for row in sorted(result["claims"], key=lambda row: row["met"]):
        verdict = "met   " if row["met"] else "MISSED"
        console.print(
            f"{verdict}  {row['claim']}: {row['kind']} {row['asked']}, measured {row['measured']}", highlight=False
        )
    if two:
        apart = max((row["apart_max"] for row in result["rows"]), default=0.0)
        console.print(
            f"old: {result['baseline']['commit']}, new: {result['provenance']['commit']}, on one core, taking turns; their "
            f"objectives differ by {apart:.0e} at most",
            style="dim",
            highlight=False,
        )


def _cells(row: dict[str, Any], two: bool) -> list[str]:
    now = f"{row['p50_us']:.4g} / {row['p99_us']:.4g}"
    if not two:
        return [now]
    before = f"{row['baseline_p50_us']:.4g} / {row['baseline_p99_us']:.4g}"
    asked = "" if row["asked"] is None else f"<= {row['asked']:g}"
    return [before, now, f"{row['ratio_p50']:.3f} / {row['ratio_p99']:.3f}", asked]
