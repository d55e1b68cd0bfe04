"""`grasp reproduce`: what the paper leaves open."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from grasp_env._extras import need


@dataclass(frozen=True)
class Reproduce:
    """Study what the paper leaves open, its reduction and its claims.

    Writes tables and figures of weights, step rules and claims.

    Attributes:
        out: the folder that gets a run.
        quick: few wrenches, for a first look.
    """

    out: Path = Path("runs")
    quick: bool = False

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need("report")
        from training.study.reproduce import reproduce

        metrics = reproduce(self.out, self.quick, sys.stderr.isatty())
        Console().print(str(Path(metrics["folder"]) / "report.md"), highlight=False)
