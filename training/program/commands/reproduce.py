"""`grasp reproduce`: study of what the paper leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from grasp_env.inputs.extras import need


@dataclass(frozen=True)
class Reproduce:
    """Study what the paper leaves open, and its Table I.

    Weights, step rules, rates and costs: a table of rows and a page.

    Attributes:
        out: folder of runs.
        quick: few wrenches, for a first look.
    """

    out: Path = Path("runs")
    quick: bool = False

    def execute(self) -> None:
        """Run the command."""
        need("report")
        from training.evaluation.report.page import write
        from training.evaluation.reproduce.experiments import run
        from training.evaluation.results import Run, default_name

        folder = Run.create(self.out, default_name("reproduce"))
        folder.save(run(self.quick), {"kind": "reproduce", "quick": self.quick})
        print(write(folder)[0])
