"""`grasp report`: the page of a run, or two runs side by side."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.extras import need
from training.program.commands.answers import write_report


@dataclass(frozen=True)
class Report:
    """Make a run's page again from its table, or compare two runs.

    Nothing is solved.

    Attributes:
        run: folder of the run.
        compare: two run folders A B. The differences, with 95 % intervals, go to compare.html in B
            and to the terminal.
    """

    run: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")] = None
    compare: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="A B")] = None

    def execute(self) -> None:
        """Run the command."""
        if (self.run is None) == (self.compare is None):
            raise InvalidInputError(
                "name one run's folder, `grasp report runs/NAME`, or two to compare, `grasp report --compare runs/A runs/B`"
            )
        need("report")
        from training.evaluation.results.run import Run

        if self.compare is not None:
            from training.evaluation.report.side_by_side import write as compare

            a, b = (Run.open(folder) for folder in self.compare)
            table = compare(a, b, b)
            sys.stdout.write(f"{table.head(40).to_string(index=False, na_rep='')}\n")
            sys.stderr.write(f"report: {b.folder / 'compare.html'}\n")
            return
        write_report(Run.open(self.run or ""))
