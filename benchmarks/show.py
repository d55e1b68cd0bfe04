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
    """Return the summary of an earlier run, or raise an `InvalidInputError` if the folder holds
    none of this kind.
    """
    if not os.path.isfile(folder / "run.json"):
        raise InvalidInputError(
            f"{folder} holds no run: give the folder of an earlier run of kind {kind}"
        )
    with understood(folder, "run the benchmark again"):
        found = Run(folder).read_json("run.json")["kind"]
        if found != kind:
            raise InvalidInputError(
                f"{folder} is a run of kind {shown(found)}: give one of kind {kind}"
            )
        return summarised(Run(folder).load()[0])


def beside(now: pd.DataFrame, before: pd.DataFrame, columns: tuple[str, ...]) -> pd.DataFrame:
    """The times and rates of two summaries, joined by their keys: `before`, `now` and `ratio`, now
    over before.
    """
    keys = [name for name in KEYS if name in now.columns and name in before.columns]
    timed = [name for name in columns if _split(name)[0] in {*TIMES} - {"ratio"}]
    known = [name for name in timed if name in now.columns and name in before.columns]
    parts = [
        made.melt(keys, known, "measure", what) for made, what in ((before, "before"), (now, "now"))
    ]
    joined = parts[0].merge(parts[1], on=[*keys, "measure"]).dropna(subset=["before", "now"])
    return joined.assign(ratio=joined["now"] / joined["before"])


def as_json(
    benchmark: Benchmark, rows: pd.DataFrame, about: dict[str, Any], before: pd.DataFrame | None
) -> str:
    """Return one object with the description of the run, its summary and claims."""
    found = summarised(rows)
    claims = [
        {"claim": row.claim.name, "target": row.target, "measured": row.measured, "met": row.met}
        for row in judge(benchmark.claims, found)
    ]
    tables = {"rows": found} | (
        {} if before is None else {"compared": beside(found, before, benchmark.shown)}
    )
    parts = {
        name: made.astype(object).where(made.notna(), None).to_dict("records")
        for name, made in tables.items()
    }
    return json.dumps({**about, **parts, "claims": claims}) + "\n"


def as_text(
    benchmark: Benchmark, rows: pd.DataFrame, about: dict[str, Any], before: pd.DataFrame | None
) -> str:
    """Yield a table for each case, then notes and claims."""
    return "".join(f"{line}\n" for line in _lines(benchmark, summarised(rows), about, before))


def _lines(
    benchmark: Benchmark, found: pd.DataFrame, about: dict[str, Any], before: Any
) -> Iterator[str]:
    if about["quick"]:
        yield "QUICK: a small version, whose numbers are rough"
    for case, part in (
        found.groupby("case", sort=False) if "case" in found.columns else [("", found)]
    ):
        yield f"{case}\n{_table(part, [name for name in KEYS if name != 'case'], ['n', *benchmark.shown])}\n"
    yield from (
        f"{name}: {benchmark.words[name]}"
        for name in found["method"].dropna().unique()
        if name in benchmark.words
    )
    yield from (f"{name} was not measured: {reason}" for name, reason in about["missing"].items())
    yield from benchmark.notes(found)
    yield from lines([row for row in judge(benchmark.claims, found) if row.met is not None])
    if before is not None:
        yield f"\nbeside the earlier run\n{_table(beside(found, before, benchmark.shown), [*KEYS, 'measure'], ['before', 'now', 'ratio'])}\n"
    machine = about["machine"]
    yield f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}; warm-up excluded: compare rows of one run"


def _table(rows: pd.DataFrame, keys: list[str], values: list[str]) -> str:
    names = [name for name in (*keys, *values) if name in rows.columns and rows[name].notna().any()]
    dashed = rows[names].astype(object).where(rows[names].notna(), "–")
    header = pd.MultiIndex.from_tuples([_split(name) for name in names])
    return dashed.set_axis(header, axis=1).to_string(index=False, float_format=number)


def _split(name: str) -> tuple[str, str]:
    """A column of a summary as column and statistic."""
    base, _, statistic = name.rpartition("_")
    return (base, statistic) if base in COLUMNS else (name, "")
