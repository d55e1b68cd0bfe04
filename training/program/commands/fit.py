"""`grasp fit`: train an initial force."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console

from grasp_env.grasp.presets import PRESETS
from grasp_env.inputs.extras import need
from training.evaluation.results.interrupts import interruptible
from training.fit.fit_config import FitConfig
from training.program.commands.options import left_out, one_of


@dataclass(frozen=True)
class Fit(FitConfig):
    """Train a network for one grasp: wrench and friction to the initial force.

    It saves the weights, and a JSON file with the model card.

    To train for your own contacts, write a file to start from:
    `grasp solve --save-grasp mine.json`

    Change positions [m], normals (INTO the object) and friction in it. Then:
    `grasp fit --grasp mine.json --out runs/fit/mine`

    To train for the contacts, wrenches and frictions of a simulated hand:
    `grasp fit --env '{"hand": "allegro"}' --out runs/fit/mine`

    It prints the iterations there. `gym.make` takes the path as `initial_force`.

    Attributes:
        preset: name of the grasp.
        grasp: JSON file of a grasp instead: at least three hard contacts, round or elliptic.
        env: an environment instead: UncertainGrasp or another one with a name, or JSON of settings
            as keywords of `gym.make`. The default is the cuboid under a random wrench.
        out: path of both files, without suffix.
        resume: continue the interrupted training kept beside `out`, with the same settings.
    """

    preset: Annotated[str, one_of(PRESETS)] = "paper_cuboid"
    grasp: Annotated[str | None, left_out("the preset", "FILE")] = None
    env: Annotated[str | None, left_out("the preset", "ENV")] = None
    out: Path = Path("runs/fit/four_finger")
    resume: bool = False

    def execute(self) -> None:
        """Run the command."""
        with interruptible(orderly=False):  # until the training handles interrupts itself
            if self.env is not None:
                need("sim", "train")
            from training.fit.one_grasp import fit
            from training.fit.state import StateFile

            names = FitConfig.__dataclass_fields__
            settings = FitConfig(**{name: getattr(self, name) for name in names})
            command = " ".join(["grasp", *sys.argv[1:]])
            checkpoint = fit(settings, True, command, self.out, self.resume)
            path = checkpoint.save(self.out)
            StateFile(self.out, {}).remove()
            if self.env is not None:  # the model is saved, whatever comes
                from policies import LearnedInitialForce
                from training.data.environment import environment
                from training.fit.in_environment import scores_in

                model = LearnedInitialForce(checkpoint)
                checkpoint.card["iterations"] = scores_in(environment(self.env), model)
                checkpoint.save(self.out)
        gaps = checkpoint.card["held_out_gap"]
        ball = gaps["ball"]
        flow = gaps["ball, friction of the grasp"]["flow iterations"]
        share = 100 * (ball["newton steps"]["0"] + ball["newton steps"]["1"])
        usual = "the standard ball" if self.env is None else "wrenches like the environment's"
        console = Console(highlight=False)
        # one line; a terminal wraps it between words
        console.print(
            f"{path}{' (quick: a rough model)' if self.quick else ''}: on {usual} a gap of {ball['gap']['median']:.1e} median, "
            f"{ball['gap']['p99']:.1e} p99, {share:.0f} % certified within one Newton step; alone {flow['median']:g} "
            f"iterations of the flow median, {flow['p99']:g} p99",
            soft_wrap=not console.is_terminal,
        )
        for case, starts in checkpoint.card.get("iterations", {}).items():
            counts = ", ".join(
                f"{start} {found['median']:g} / {found['p99']:g}" for start, found in starts.items()
            )
            console.print(
                f"contacts {case}: iterations of the flow in the environment, median / p99: {counts}",
                soft_wrap=not console.is_terminal,
            )
