"""Benchmark results as tables for people, and saved as JSON with their figure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from training.bench.scaling import scaling_figure
from training.figures import close
from training.runs import Run


def show(result: dict[str, Any], console: Console) -> None:
    """Prints a result."""
    {"solver": _solver, "scaling": _scaling, "batch": _batch}[result["kind"]](result, console)
    machine = result["provenance"]["machine"]
    console.print(
        f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}; best pass per problem, warm-up "
        "excluded: compare rows of one run",
        style="dim",
        highlight=False,
    )


def save(result: dict[str, Any], out: Path) -> Path:
    """Writes <kind>.json (and a figure) into `out`, whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    run = Run(out)
    path = run.write_json(f"{result['kind']}.json", result)
    if result["kind"] == "scaling":
        figure = scaling_figure(result)
        run.write("scaling.png", lambda target: figure.savefig(target, format="png"))
        close(figure)
    return path


def compare(result: dict[str, Any], earlier: Path, console: Console) -> None:
    """Prints p50 of every row beside that of an earlier run of the same kind."""
    before = json.loads(earlier.read_text())
    keys = ("solver", "method", "contacts", "workers")
    value = "per_second" if result["kind"] == "batch" else "p50_us"
    known = {tuple(row.get(key) for key in keys): row[value] for row in before["rows"]}
    table = Table("row", "before", "now", "now / before", title=f"against {earlier}")
    for row in result["rows"]:
        key = tuple(row.get(name) for name in keys)
        if key in known:
            name = " ".join(str(part) for part in key if part is not None)
            table.add_row(name, f"{known[key]:.2f}", f"{row[value]:.2f}", f"{row[value] / known[key]:.2f}")
    console.print(table)


def _solver(result: dict[str, Any], console: Console) -> None:
    for count in dict.fromkeys(row["contacts"] for row in result["rows"]):
        table = Table("solver", "p50 us", "p99 us", "failed", "gap", "balance", "violation", title=f"{count} contacts")
        for row in sorted((r for r in result["rows"] if r["contacts"] == count), key=lambda r: r["p50_us"]):
            table.add_row(
                row["solver"], f"{row['p50_us']:.1f}", f"{row['p99_us']:.1f}", f"{row['failed']} of {row['problems']}",
                f"{row['gap_max']:.0e}", f"{row['balance_max']:.0e}", f"{row['violation_max']:.0e}",
            )  # fmt: skip
        console.print(table)
    for key, label in {row["solver"]: row["label"] for row in result["rows"]}.items():
        console.print(f"{key}: {label}", style="dim", highlight=False)
    if result["ratios"]:
        table = Table("comparison", "contacts", "times faster", "our p99 / their p50", title="ratios of medians")
        for row in result["ratios"]:
            table.add_row(
                row["comparison"],
                str(row["contacts"]),
                f"{row['ratio_p50']:.1f}",
                f"{row['our_p99_over_their_p50']:.2f}",
            )
        console.print(table)
    for name, reason in result["missing"].items():
        console.print(f"{name} did not run: {reason}", style="dim", highlight=False)


def _scaling(result: dict[str, Any], console: Console) -> None:
    table = Table("method", "contacts", "p50 us", "iterations", "us per iteration", title="cost against contacts")
    for row in sorted(result["rows"], key=lambda row: row["method"]):
        table.add_row(
            row["method"], str(row["contacts"]), f"{row['p50_us']:.1f}", f"{row['iterations']:.1f}",
            f"{row['us_per_iteration']:.2f}",
        )  # fmt: skip
    console.print(table)
    for method, fit in result["fits"].items():
        power = "" if fit["exponent"] is None else f", log-log slope {fit['exponent']:.2f} from 16 contacts on"
        console.print(
            f"{method}: {fit['offset_us']:.2f} + {fit['slope_us']:.3f} N us per iteration, r2 {fit['r2']:.3f}{power}",
            highlight=False,
        )


def _batch(result: dict[str, Any], console: Console) -> None:
    table = Table(
        "method", "workers", "solves per second", "optimal", title=f"{result['wrenches']} wrenches, 4 contacts"
    )
    for row in result["rows"]:
        table.add_row(row["method"], str(row["workers"]), f"{row['per_second']:,.0f}", str(row["optimal"]))
    console.print(table)
    for method, times in result["speedup"].items():
        console.print(f"{method}: all cores {times:.2f} times one", highlight=False)
    console.print(f"peak memory of the process {result['peak_gib']:.2f} GiB", highlight=False)
