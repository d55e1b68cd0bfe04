"""Benchmark results as tables for people, and saved as JSON with their figure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
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

Column = str | Callable[[dict[str, Any]], str]


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


def _table(console: Console, rows: Iterable[dict[str, Any]], title: str | None, columns: dict[str, Column]) -> None:
    """A line per row; a column is how a value of a row is written, {key:form}, or what is said of the row."""
    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(
            *(column.format_map(row) if isinstance(column, str) else column(row) for column in columns.values())
        )
    console.print(table)


def _solver(result: dict[str, Any], console: Console) -> None:
    for count in dict.fromkeys(row["contacts"] for row in result["rows"]):
        rows = sorted((row for row in result["rows"] if row["contacts"] == count), key=lambda row: row["p50_us"])
        _table(console, rows, f"{count} contacts", {
            "solver": "{solver}", "p50 us": "{p50_us:.1f}", "p99 us": "{p99_us:.1f}", "failed": "{failed} of {problems}",
            "gap": "{gap_max:.0e}", "balance": "{balance_max:.0e}", "violation": "{violation_max:.0e}",
        })  # fmt: skip
    _aside(
        console, *(f"{key}: {label}" for key, label in {row["solver"]: row["label"] for row in result["rows"]}.items())
    )
    if result["batches"]:
        _table(console, result["batches"], "batches, one call, all cores", {
            "contacts": "{contacts}", "solver": "{solver}", "solves per second": "{per_second:,.0f}", "batch": "{batch}",
            "failed": "{failed}",
        })  # fmt: skip
    if result["ratios"]:
        _table(console, result["ratios"], "ratios of medians", {
            "comparison": "{comparison}", "contacts": "{contacts}", "times faster": "{ratio_p50:.1f}",
            "our p99 / their p50": "{our_p99_over_their_p50:.2f}",
        })  # fmt: skip
    _aside(console, *(f"{name} did not run: {reason}" for name, reason in result["missing"].items()))


def _scaling(result: dict[str, Any], console: Console) -> None:
    _table(console, sorted(result["rows"], key=lambda row: row["method"]), "cost against contacts", {
        "method": "{method}", "contacts": "{contacts}", "p50 us": "{p50_us:.1f}", "iterations": "{iterations:.1f}",
        "us per iteration": "{us_per_iteration:.2f}",
    })  # fmt: skip
    for method, fit in result["fits"].items():
        power = "" if fit["exponent"] is None else f", log-log slope {fit['exponent']:.2f} from 16 contacts on"
        line = f"{method}: {fit['offset_us']:.2f} + {fit['slope_us']:.3f} N us per iteration, r2 {fit['r2']:.3f}{power}"
        console.print(line, highlight=False)


def _batch(result: dict[str, Any], console: Console) -> None:
    _table(console, result["rows"], f"{result['wrenches']} wrenches, 4 contacts", {
        "method": "{method}", "workers": "{workers}", "solves per second": "{per_second:,.0f}", "optimal": "{optimal}",
    })  # fmt: skip
    for method, times in result["speedup"].items():
        console.print(f"{method}: all cores {times:.2f} times one", highlight=False)
    console.print(f"peak memory of the process {result['peak_gib']:.2f} GiB", highlight=False)


def _env(result: dict[str, Any], console: Console) -> None:
    if result["quick"]:
        console.print("QUICK: few rounds and resets; rough", style="bold")
    _table(console, result["rows"], "agent steps, best and median of the episodes", {
        "episode": "{method}", "steps/s": "{per_second:.0f}", "us": "{us:.0f}", "median us": "{us_median:.0f}",
        "bare us": "{bare_us:.0f}", "ratio": "{ratio:.2f}", "median ratio": "{ratio_median:.2f}",
    })  # fmt: skip
    agent, control = result["rates"]
    _table(console, result["parts"], "where the time goes", {
        f"part of a step ({agent} Hz agent, {control} Hz control)": "{what}", "us": "{us:.1f}", "share": lambda row: f"{100 * row['share']:.1f} %",
        "calls": "{calls:g}",
    })  # fmt: skip
    _table(console, result["resets"], None, {
        "reset": "{reset}", "median ms": "{median_ms:.2f}", "p99 ms": "{p99_ms:.2f}", "max ms": "{max_ms:.2f}", "resets": "{resets}",
    })  # fmt: skip
    for row in result["memory"]:
        console.print(
            f"{row['resets']}: {row['per_env_mib']:.1f} MiB per environment, growth {row['growth_mib']:.2f} MiB over "
            f"{row['count']} resets; the process {row['resident_mib']:.0f} MiB",
            highlight=False,
        )
    for row in result["vector"]:
        line = f"{row['envs']} environments, {row['vector']}: {row['per_second']:.0f} steps per second"
        console.print(line, highlight=False)
    _claims(result, console)


def _core(result: dict[str, Any], console: Console) -> None:
    """Medians and p99 of both sides with their ratios, first solves, claims, and what could not be timed."""
    two, ours = result["baseline"] is not None, "{p50_us:.4g} / {p99_us:.4g}"
    theirs: dict[str, Column] = {
        "old us": "{baseline_p50_us:.4g} / {baseline_p99_us:.4g}", "new us": ours, "new / old": "{ratio_p50:.3f} / {ratio_p99:.3f}",
    }  # fmt: skip
    for count in dict.fromkeys(row["contacts"] for row in result["rows"]):
        rows = [row for row in result["rows"] if row["contacts"] == count]
        _table(
            console, rows, f"{count} contacts, median / p99", {"row": "{method}", **(theirs if two else {"us": ours})}
        )
    _aside(console, *(f"{key}: {ROWS[key]}" for key in dict.fromkeys(row["method"] for row in result["rows"])))
    if result["starts"]:
        _table(console, result["starts"], None, {
            "first solve of a process": "{method}", "side": "{side}", "median s": "{median_s:.2f}", "least": "{min_s:.2f}",
            "most": "{max_s:.2f}", "of it imports": "{import_median_s:.2f}",
            "imported by then": lambda row: ", ".join(row["loaded"]) or "neither scipy nor torch",
        })  # fmt: skip
    for row in result["rows"]:
        if row["failed"] or row.get("baseline_failed"):
            before = f", of the baseline's {row['baseline_failed']}" if two else ""
            failed = f"{row['failed']} of {row['problems']} not optimal{before}"
            console.print(f"{row['method']}, {row['contacts']} contacts: {failed}", style="bold", highlight=False)
    _aside(console, *(f"{name} is left out: {reason}" for name, reason in result["missing"].items()))
    _claims(result, console)
    if two:
        apart = max((row["apart_max"] for row in result["rows"]), default=0.0)
        _aside(
            console,
            f"old: {result['baseline']['commit']}, new: {result['provenance']['commit']}, on one core, taking turns; their "
            f"objectives differ by {apart:.0e} at most",
        )


def _aside(console: Console, *lines: str) -> None:
    for line in lines:
        console.print(line, style="dim", highlight=False)


def _claims(result: dict[str, Any], console: Console) -> None:
    for line in told(result["claims"]):
        console.print(line, highlight=False, soft_wrap=True)
