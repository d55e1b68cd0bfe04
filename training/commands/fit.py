"""`grasp fit`: train an initial force."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from training.settings import FitConfig


@dataclass(frozen=True)
class Fit(FitConfig):
    """Train a network that predicts the initial force, and save it as two files.

    Attributes:
        out: their common stem.
    """

    out: Path = Path("runs/fit/four_finger")

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        from training.fit import fit
        from training.runs import Run

        Run.create(self.out.parent, "")
        settings = FitConfig(**{name: getattr(self, name) for name in FitConfig.__dataclass_fields__})
        result = fit(settings, progress=sys.stderr.isatty(), command=" ".join(["grasp", *sys.argv[1:]]))
        path = result.checkpoint.save(self.out)
        gap = result.checkpoint.card["held_out_gap_second_order"]
        Console().print(f"{path}: held-out gap {gap['median']:.1e} median, {gap['p99']:.1e} p99", highlight=False)
