"""`grasp report`: rebuild a report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from grasp_env._extras import need
from training.commands.claims import print_claims


@dataclass(frozen=True)
class Report:
    """Rebuild a run's report from its saved trials; nothing is solved.

    Attributes:
        run: the run's folder.
    """

    run: tyro.conf.Positional[Path]

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need("report")
        from training.report.build import build_report, report_path
        from training.runs import Run, understood

        run = Run.open(self.run, "run.json")
        with understood(run.folder, "run `grasp evaluate` again"):
            print_claims(build_report(run))
        Console().print(str(report_path(run)), highlight=False)
