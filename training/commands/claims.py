"""What an evaluation prints at its end."""

from __future__ import annotations

import sys
from typing import Any

from training.runs.claims import told


def print_claims(metrics: dict[str, Any]) -> None:
    """The claims of a report, missed ones first, those that this run did not measure next."""
    if metrics["run"]["quick"]:
        sys.stdout.write("QUICK RUN: few trials; do not quote.\n")
    sys.stdout.writelines(f"{line}\n" for line in told(metrics["claims"]))
