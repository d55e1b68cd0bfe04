"""Tables of results: rows with typed columns, written as CSV, and their summaries."""

from __future__ import annotations

import io
import lzma
import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import MEGABYTE, WEIGHTS, parsed, replacing
from training.evaluation.results.columns import COLUMNS, KEYS
from training.evaluation.results.statistics import (
    iqm,
    iqm_interval,
    mean_interval,
    median_interval,
    wilson,
)

with need("report"):
    import pandas as pd

Rows: TypeAlias = Any
"""Type of a `pandas.DataFrame` where its stubs are not precise enough."""
DTYPES = {"text": "string", "whole": "Int64", "real": "float64", "flag": "boolean"}
KINDS = {name: DTYPES[column.kind] for name, column in COLUMNS.items()}
"""Type of every column in a table."""
_PERCENTILES = {"p90": 90.0, "p95": 95.0, "p99": 99.0, "p999": 99.9}
_INTERVALS: dict[str, tuple[str, Callable[[NDArray[np.float64]], tuple[float, float]]]] = {
    "": ("95 % interval of the median", median_interval),
    "mean_": ("95 % bootstrap interval of the mean", mean_interval),
    "rate_": ("95 % Wilson interval of the rate", lambda x: wilson(int(x.sum()), len(x))),
    "iqm_": ("95 % bootstrap interval of the interquartile mean", iqm_interval),
}
STATISTICS: dict[str, tuple[str, Callable[[NDArray[np.float64]], float]]] = {
    "median": ("median", np.median),
    "min": ("least", np.min),
    "max": ("largest", np.max),
    "sum": ("sum", np.sum),
    "mean": ("mean", np.mean),
    "iqm": ("interquartile mean", iqm),
    **{
        name: (f"{rank:g}th percentile", partial(np.percentile, q=rank))
        for name, rank in _PERCENTILES.items()
    },
    **{
        f"{prefix}{end}": (f"{side} end of the {words}", lambda x, f=interval, k=k: f(x)[k])
        for prefix, (words, interval) in _INTERVALS.items()
        for k, (end, side) in enumerate((("low", "lower"), ("high", "upper")))
    },
}
"""Statistics of finite values (n,), n > 0; `summary` adds "missing", the rows without a value."""


def table(rows: Iterable[Mapping[str, Any]] | pd.DataFrame) -> pd.DataFrame:
    """Make a table of rows, with the order and types of `COLUMNS`, without empty columns.

    Raises:
        InvalidInputError: a column is not in `COLUMNS`, or a value does not fit its kind.

    Example:
        >>> table([{"iterations": 3, "case": "ball"}, {"case": "smooth"}])
             case  iterations
        0    ball           3
        1  smooth        <NA>
    """
    frame = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
    if unknown := [name for name in frame.columns if name not in COLUMNS]:
        raise InvalidInputError(
            f"unknown columns {', '.join(map(str, unknown))}: add them to COLUMNS in training/evaluation/results/columns.py"
        )
    ordered = frame[[name for name in COLUMNS if name in frame.columns]].dropna(axis=1, how="all")
    try:
        typed = {name: ordered[name].astype(KINDS[name]) for name in ordered.columns}
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"a value does not fit the kind of its column: {error}") from error
    return pd.DataFrame(typed, index=ordered.index).reset_index(drop=True)


def join(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Concatenate tables."""
    # a table may lack a column, so values are concatenated as objects; `table` restores the type
    untyped = [rows.astype(object) for rows in tables]
    return table(pd.concat(untyped, ignore_index=True) if untyped else [])


def write(path: Path, rows: pd.DataFrame, number: str | None = None) -> None:
    """Write a CSV file, compressed if its name ends in .xz; equal tables give equal bytes.

    Missing values and empty texts are empty. `number` is the format of real numbers; None: digits
    that restore the same number.
    """
    # the preset is ten times as fast as the usual one, for files half as large again
    packed: Any = {"method": "xz", "preset": 1} if path.suffix == ".xz" else None
    with replacing(path) as temporary:
        rows.to_csv(temporary, index=False, float_format=number, compression=packed)


def write_summary(path: Path, means: pd.DataFrame) -> None:
    """Write a summary as `write` does, its real numbers with seven significant digits."""
    write(path, means, "%.7g")


def read(path: Path) -> pd.DataFrame:
    """Read a table or a summary that `write` made; the columns have the types of `COLUMNS`.

    Raises:
        InvalidInputError: the file is missing or not a table of results.
    """

    def columns(blob: bytes) -> pd.DataFrame:
        if path.suffix == ".xz":
            unpacker = lzma.LZMADecompressor()
            blob = unpacker.decompress(blob, WEIGHTS)
            if not unpacker.eof:
                raise ValueError(
                    f"it is cut off, or has more than {WEIGHTS // MEGABYTE} MB when unpacked"
                )
        if not blob.endswith(b"\n"):
            raise ValueError("its last line is cut off")
        # as text first: not every version of pandas reads the same real number from it
        read_as = {name: "str" if kind == "float64" else kind for name, kind in KINDS.items()}
        empty: dict[str, Any] = {"keep_default_na": False, "na_values": [""]}
        rows = pd.read_csv(io.BytesIO(blob), dtype=read_as, lineterminator="\n", **empty)
        if unknown := [name for name, text in described(rows.columns).items() if not text]:
            raise ValueError(f"it has the unknown column {unknown[0][:100]!r}")
        return rows.astype({name: KINDS[name] for name in rows.columns if name in KINDS})

    words = {
        "name": f"the table {path}",
        "form": "a table of results",
        "hint": "; give a run's rows.csv.xz",
    }
    return parsed(path, read=columns, error=InvalidInputError, most=WEIGHTS, **words)


def numbers(rows: pd.DataFrame, name: str) -> NDArray[np.float64]:
    """Return the values (n,) of a column of numbers or flags, with nan for missing ones."""
    series: Any = rows[name]
    return series.to_numpy(np.float64, na_value=np.nan)


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Summarise a table: one row for each combination of keys, with the statistics of every column.

    Returns:
        The keys that the table has, the number of rows `n`, and `<column>_<statistic>` for each
        statistic of the column in `COLUMNS`. Rows are in the order in which their keys first
        appear. Of a group without finite values, all statistics except `missing` are NaN. Columns
        without any value are left out.

    Example:
        >>> rows = table([{"case": "ball", "held": True}, {"case": "ball", "held": False}, {"case": "jump", "held": True}])
        >>> summary(rows)[["case", "n", "held_sum", "held_mean"]]
           case  n  held_sum  held_mean
        0  ball  2       1.0        0.5
        1  jump  1       1.0        1.0
    """
    keys = [name for name in KEYS if name in rows.columns]
    values = {name: numbers(rows, name) for name in rows.columns if COLUMNS[name].statistics}
    groups = {(): np.arange(len(rows))}
    if keys:
        groups = rows.groupby(keys, sort=False, dropna=False).indices
    out = []
    for indices in groups.values():
        row: dict[str, Any] = {name: rows[name].iloc[indices[0]] for name in keys}
        row["n"] = len(indices)
        for name, column in values.items():
            group = column[indices]
            finite = group[np.isfinite(group)]
            for statistic in COLUMNS[name].statistics:
                if statistic == "missing":
                    value = int(np.isnan(group).sum())
                else:
                    value = float(STATISTICS[statistic][1](finite)) if len(finite) else np.nan
                row[f"{name}_{statistic}"] = value
        out.append(row)
    means = pd.DataFrame(out).dropna(axis=1, how="all")
    return means.astype({name: KINDS[name] for name in keys if name in means.columns})


def described(columns: Iterable[str]) -> dict[str, str]:
    """Return unit and meaning of the columns of a table or of its summary.

    Example:
        >>> described(["drift_mean"])
        {'drift_mean': '[mm] mean over rows of: largest distance of the object from where it was
        grasped, if it was held'}
    """
    out = {}
    for name in columns:
        base, statistic = name, ""
        while base not in COLUMNS and "_" in base:
            base, _, last = base.rpartition("_")
            statistic = f"{last}_{statistic}".strip("_")
        if base not in COLUMNS:
            out[name] = {"n": "number of rows"}.get(name, "")
            continue
        column = COLUMNS[base]
        label = "rows without a value: " if statistic == "missing" else ""
        if statistic in STATISTICS:
            label = f"{STATISTICS[statistic][0]} over rows of: "
        unit = f"[{column.unit}] " if column.unit else ""
        out[name] = f"{unit}{label}{column.text}"
    return out


def chosen(rows: pd.DataFrame, query: str) -> pd.DataFrame:
    """Return the rows that a query of `DataFrame.query` selects; none if a column is missing."""
    names = set(re.findall(r"[A-Za-z_]\w*", re.sub(r"'[^']*'|\"[^\"]*\"", "", query)))
    if (names & {*COLUMNS}) - {*rows.columns}:
        return rows.iloc[:0]
    # of the named columns alone, since `query` reads all
    return rows.loc[rows[[*names.intersection(rows.columns)]].eval(query)]
