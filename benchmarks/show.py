"""Summary of a benchmark, alone or compared with an earlier run, as text and as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.benchmark import Benchmark
from grasp_env.errors import InvalidInputError, shown
from training.evaluation.results import Run, understood
from training.evaluation.results.claims import judge, lines
from training.evaluation.results.columns import COLUMNS, KEYS, TIMES
from training.evaluation.results.table import pd, summary
from training.evaluation.results.words import number


def lacking(rows: pd.DataFrame) -> dict[str, str]:
    """Return the rows that were not measured, with reasons."""
    return dict(rows[["method", "reason"]].dropna().to_numpy().tolist()) if "reason" in rows else {}


def summarised(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the summary of the measured rows."""
    return summary(
        rows.loc[rows["reason"].isna()].dropna(axis=1, how="all") if "reason" in rows else rows
    )


def earlier(folder: Path, kind: str) -> pd.DataFrame:
    """Return the summary of an earlier run of this kind, or raise an `InvalidInputError`."""
    if not os.path.isfile(folder / "run.json"):
        raise InvalidInputError(
            f"{folder} holds no run: give the folder of an earlier run of kind {kind}"
        )
    with understood(folder, "run the benchmark again"):
        stored = Run(folder).read_json("run.json")["kind"]
        if stored != kind:
            raise InvalidInputError(
                f"{folder} is a run of kind {shown(stored)}: give one of kind {kind}"
            )
        return summarised(Run(folder).load()[0])


def beside(now: pd.DataFrame, before: pd.DataFrame, columns: tuple[str, ...]) -> pd.DataFrame:
    """Return times and rates of two summaries: `before`, `now` and `ratio`, now over before."""
    keys = [name for name in KEYS if name in now.columns and name in before.columns]
    timed = [name for name in columns if _split(name)[0] in {*TIMES} - {"ratio"}]
    both = [name for name in timed if name in now.columns and name in before.columns]
    left = before.melt(keys, both, "measure", "before")
    right = now.melt(keys, both, "measure", "now")
    joined = left.merge(right, on=[*keys, "measure"]).dropna(subset=["before", "now"])
    return joined.assign(ratio=joined["now"] / joined["before"])


def as_json(
    benchmark: Benchmark, rows: pd.DataFrame, about: dict[str, Any], before: pd.DataFrame | None
) -> str:
    """Return one object with the run's description, summary and claims."""
    now = summarised(rows)
    claims = [
        {"claim": row.claim.name, "target": row.target, "measured": row.measured, "met": row.met}
        for row in judge(benchmark.claims, now)
    ]
    tables = {"rows": now}
    if before is not None:
        tables["compared"] = beside(now, before, benchmark.shown)
    records = {
        name: table.astype(object).where(table.notna(), None).to_dict("records")
        for name, table in tables.items()
    }
    return json.dumps({**about, **records, "claims": claims}) + "\n"


def as_text(
    benchmark: Benchmark, rows: pd.DataFrame, about: dict[str, Any], before: pd.DataFrame | None
) -> str:
    """Return a table for each case, then notes and claims."""
    return "".join(f"{line}\n" for line in _lines(benchmark, summarised(rows), about, before))


def _lines(
    benchmark: Benchmark, now: pd.DataFrame, about: dict[str, Any], before: Any
) -> Iterator[str]:
    if about["quick"]:
        yield "QUICK: a small version, whose numbers are rough"
    keys = [name for name in KEYS if name != "case"]
    cases = now.groupby("case", sort=False) if "case" in now.columns else [("", now)]
    for case, rows in cases:
        yield f"{case}\n{_table(rows, keys, ['n', *benchmark.shown])}\n"
    yield from (
        f"{name}: {benchmark.words[name]}"
        for name in (now["method"].dropna().unique() if "method" in now.columns else ())
        if name in benchmark.words
    )
    yield from (f"{name} was not measured: {reason}" for name, reason in about["missing"].items())
    yield from benchmark.notes(now)
    yield from lines([row for row in judge(benchmark.claims, now) if row.met is not None])
    if before is not None:
        compared = beside(now, before, benchmark.shown)
        table = _table(compared, [*KEYS, "measure"], ["before", "now", "ratio"])
        yield f"\nbeside the earlier run\n{table}\n"
    machine = about["machine"]
    yield f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}; warm-up excluded: compare rows of one run"


def _table(rows: pd.DataFrame, keys: list[str], values: list[str]) -> str:
    names = [name for name in (*keys, *values) if name in rows.columns and rows[name].notna().any()]
    dashed = rows[names].astype(object).where(rows[names].notna(), "–")
    header = pd.MultiIndex.from_tuples([_split(name) for name in names])
    return dashed.set_axis(header, axis=1).to_string(index=False, float_format=number)


def _split(name: str) -> tuple[str, str]:
    """Split a column of a summary into column and statistic."""
    base, _, statistic = name.rpartition("_")
    return (base, statistic) if base in COLUMNS else (name, "")
