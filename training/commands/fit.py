"""`grasp fit`: train an initial force."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console

from grasp_env.grasp.presets import PRESETS
from training.commands.options import left_out, one_of
from training.fit.settings import FitConfig
from training.results.interrupts import interruptible


@dataclass(frozen=True)
class Fit(FitConfig):
    """Train a network for one grasp: wrench and friction to the initial force.

    Two files are saved, one of them with the model card.

    To learn your own contacts, write a file to start from:
    `grasp solve --save-grasp mine.json`

    Change positions [m], normals (INTO the object) and friction in it. Then:
    `grasp fit --grasp mine.json --out runs/fit/mine`

    Attributes:
        preset: the named grasp to learn.
        grasp: a grasp's JSON file instead: three and more hard contacts, round or elliptic.
        out: their common stem.
        resume: go on with the interrupted training that lies beside it, same settings.
    """

    preset: Annotated[str, one_of(PRESETS)] = "paper_cuboid"
    grasp: Annotated[str | None, left_out("the preset", "FILE")] = None
    out: Path = Path("runs/fit/four_finger")
    resume: bool = False

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        with interruptible(orderly=False):  # until the training itself takes them
            from training.fit.one_grasp import fit
            from training.fit.state import StateFile

            settings = FitConfig(**{name: getattr(self, name) for name in FitConfig.__dataclass_fields__})
            checkpoint = fit(settings, True, " ".join(["grasp", *sys.argv[1:]]), self.out, self.resume).checkpoint
            path = checkpoint.save(self.out)
            StateFile(self.out, {}).remove()
        ball, flow = (checkpoint.card["held_out_gap"][name] for name in ("ball", "ball, friction of the grasp"))
        most = 100 * sum(ball["newton steps"][steps] for steps in ("0", "1"))
        console = Console(highlight=False)
        # one line, which a terminal shows in as many as it needs, broken between words
        console.print(
            f"{path}{' (quick: a rough model)' if self.quick else ''}: on the standard ball a gap of {ball['gap']['median']:.1e} median, "
            f"{ball['gap']['p99']:.1e} p99, {most:.0f} % certified within one Newton step; alone {flow['flow iterations']['median']:g} "
            f"iterations of the flow median, {flow['flow iterations']['p99']:g} p99",
            soft_wrap=not console.is_terminal,
        )
