"""Benchmark results as tables for people, and saved as JSON with their figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from grasp_env._check import number
from grasp_env._files import read_json
from grasp_env.errors import InvalidInputError, shown
from training.bench.core import ROWS
from training.bench.scaling import scaling_figure
from training.report.style import close
from training.runs import Run
from training.runs.claims import told


def show(result: dict[str, Any], console: Console) -> None:
    """Prints a result."""
    {"solver": _solver, "scaling": _scaling, "batch": _batch, "env": _env, "core": _core}[result["kind"]](
        result, console
    )
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
    """Prints p50 (or the rate) of every row beside that of an earlier run of the same kind.

    Raises:
        InvalidInputError: there is no such file, or it is of another kind.
    """
    before = read_json(earlier, InvalidInputError, "the benchmark")
    kind = before.get("kind") if isinstance(before, dict) else None
    if kind != result["kind"]:
        raise InvalidInputError(f"{earlier} is a benchmark of {shown(kind)}, not of {result['kind']}")
    keys = ("solver", "method", "contacts", "workers")
    value = "per_second" if result["kind"] in ("batch", "env") else "p50_us"
    try:
        known = {tuple(row.get(key) for key in keys): number(row[value], value) for row in before["rows"]}
    except (KeyError, TypeError, AttributeError) as error:
        raise InvalidInputError(f"{earlier} lacks rows to compare with: {error!r}; run the benchmark again") from None
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
    if result["batches"]:
        table = Table(
            "contacts", "solver", "solves per second", "batch", "failed", title="batches, one call, all cores"
        )
        for row in result["batches"]:
            table.add_row(
                str(row["contacts"]), row["solver"], f"{row['per_second']:,.0f}", str(row["batch"]), str(row["failed"])
            )
        console.print(table)
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


def _env(result: dict[str, Any], console: Console) -> None:
    if result["quick"]:
        console.print("QUICK: few rounds and resets; rough", style="bold")
    table = Table(
        "episode", "steps/s", "us", "median", "bare us", "ratio", "median", title="agent steps, best and median"
    )
    for row in result["rows"]:
        table.add_row(
            row["method"], f"{row['per_second']:.0f}", f"{row['us']:.0f}", f"{row['us_median']:.0f}", f"{row['bare_us']:.0f}",
            f"{row['ratio']:.2f}", f"{row['ratio_median']:.2f}",
        )  # fmt: skip
    console.print(table)
    table = Table("part of a step (50 Hz agent, 250 Hz control)", "us", "share", "calls", title="where the time goes")
    for row in result["parts"]:
        table.add_row(row["what"], f"{row['us']:.1f}", f"{100 * row['share']:.1f} %", f"{row['calls']:g}")
    console.print(table)
    table = Table("reset", "median ms", "p99 ms", "max ms", "resets")
    for row in result["resets"]:
        table.add_row(
            row["reset"], f"{row['median_ms']:.2f}", f"{row['p99_ms']:.2f}", f"{row['max_ms']:.2f}", str(row["resets"])
        )
    console.print(table)
    for row in result["memory"]:
        console.print(
            f"{row['resets']}: {row['per_env_mib']:.1f} MiB per environment, growth {row['growth_mib']:.2f} MiB over "
            f"{row['count']} resets; the process {row['resident_mib']:.0f} MiB",
            highlight=False,
        )
    for row in result["vector"]:
        console.print(
            f"{row['envs']} environments, {row['vector']}: {row['per_second']:.0f} steps per second", highlight=False
        )
    _claims(result, console)


def _core(result: dict[str, Any], console: Console) -> None:
    """Prints medians and p99 of both sides with their ratios, first solves, claims, and what could not be timed."""
    two = result["baseline"] is not None
    for count in dict.fromkeys(row["contacts"] for row in result["rows"]):
        columns = ("old us", "new us", "new / old") if two else ("us",)
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
    _claims(result, console)
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
    return [before, now, f"{row['ratio_p50']:.3f} / {row['ratio_p99']:.3f}"]


def _claims(result: dict[str, Any], console: Console) -> None:
    for line in told(result["claims"]):
        console.print(line, highlight=False, soft_wrap=True)
