"""Output of sub-commands: JSON and tables."""

from __future__ import annotations

import json
import math
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

    from training.evaluation.results import Run


def write_json(answer: dict[str, Any]) -> None:
    """Print one object on a line of stdout.

    Arrays become lists; NaN and infinity, which JSON lacks, become null.
    """
    sys.stdout.write(json.dumps(_plain(answer), allow_nan=False, default=str) + "\n")


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def make_table(title: str, *columns: str) -> Table:
    """Return an empty table, first column left; without `columns` two columns and no header."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=bool(columns))
    for index, column in enumerate(columns or ("", "")):
        table.add_column(column, justify="left" if index == 0 else "right", overflow="fold")
    return table


def write_report(run: Run, quick: bool = False) -> None:
    """Write the page of a run and print its claims."""
    from training.evaluation.report.page import write
    from training.evaluation.results.claims import lines

    path, claims = write(run)
    sys.stderr.write(f"report: {path}\n")
    if quick:
        sys.stdout.write("QUICK RUN: few trials; do not quote.\n")
    sys.stdout.writelines(f"{line}\n" for line in lines(claims))
