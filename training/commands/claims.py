"""What an evaluation prints at its end."""

from __future__ import annotations

import sys
from typing import Any


def print_claims(metrics: dict[str, Any]) -> None:
    """The claims of a report, missed ones first."""
    if metrics["run"]["quick"]:
        sys.stdout.write("QUICK RUN: few trials, a network fitted for seconds; its claims may well be missed.\n")
    for row in sorted(metrics["claims"], key=lambda row: row["met"]):
        verdict = "met   " if row["met"] else "MISSED"
        sys.stdout.write(f"{verdict}  {row['claim']}\n        asked {row['asked']}; measured {row['measured']}\n")
