"""What an evaluation prints at its end."""

from __future__ import annotations

import sys
from typing import Any


def print_claims(metrics: dict[str, Any]) -> None:
    """The claims of a report, missed ones first, those that this run did not measure next."""
    if metrics["run"]["quick"]:
        sys.stdout.write("QUICK RUN: few trials; do not quote.\n")
    for row in sorted(metrics["claims"], key=lambda row: _VERDICTS.index(row["met"])):
        verdict = ("MISSED", "      ", "met   ")[_VERDICTS.index(row["met"])]
        sys.stdout.write(f"{verdict}  {row['claim']}\n        asked {row['asked']}; measured {row['measured']}\n")


_VERDICTS = (False, None, True)
"""Missed, not measured, met."""
