"""`grasp fit`: train an initial force."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from grasp_env.grasp.presets import PRESETS
from training.commands.options import one_of
from training.fit.settings import AnyFitConfig, FitConfig
from training.runs.interrupts import interruptible

if TYPE_CHECKING:
    from policies.checkpoint import Checkpoint


@dataclass(frozen=True)
class FourFinger(FitConfig):
    """Train a network for one grasp: wrench and friction to the initial force.

    Two files are saved.

    Attributes:
        preset: the named grasp to learn.
        out: their common stem.
        resume: go on with the interrupted training that lies beside it, same settings.
    """

    preset: Annotated[str, one_of(PRESETS)] = "paper_cuboid"
    out: Path = Path("runs/fit/four_finger")
    resume: bool = False

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        from training.fit.four_finger import fit

        settings = FitConfig(**{name: getattr(self, name) for name in FitConfig.__dataclass_fields__})
        checkpoint = fit(settings, True, _command(), self.out, self.resume).checkpoint
        ball, flow = (checkpoint.card["held_out_gap"][name] for name in ("ball", "ball, friction of the grasp"))
        path = _save(checkpoint, self.out)
        most = 100 * sum(ball["newton steps"][steps] for steps in ("0", "1"))
        _print(
            f"{path}{_quick(self.quick)}: on the standard ball a gap of {ball['gap']['median']:.1e} median, {ball['gap']['p99']:.1e} p99, "
            f"{most:.0f} % certified within one Newton step; alone {flow['flow iterations']['median']:g} iterations of the flow median, "
            f"{flow['flow iterations']['p99']:g} p99"
        )


@dataclass(frozen=True)
class AnyGrasp(AnyFitConfig):
    """Train the layers that start any grasp of 3 to 5 contacts, on random grasps.

    Two files are saved.

    Attributes:
        out: their common stem.
        resume: go on with the interrupted training that lies beside it, same settings.
    """

    out: Path = Path("runs/fit/any_grasp")
    resume: bool = False

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        from training.fit.any_grasp import fit_any

        settings = AnyFitConfig(**{name: getattr(self, name) for name in AnyFitConfig.__dataclass_fields__})
        checkpoint = fit_any(settings, True, _command(), self.out, self.resume)
        told = []
        for start, gaps in checkpoint.card["held_out_gap"].items():
            median, _, p99 = gaps["after each layer"][-1]
            told.append(f"{start} start {median:.1e} median, {p99:.1e} p99")
        path = _save(checkpoint, self.out)
        _print(f"{path}{_quick(self.quick)}: held-out gap: {'; '.join(told)}")


@tyro.conf.configure(tyro.conf.CascadeSubcommandArgs)  # `grasp fit --seed 1` is `grasp fit four_finger --seed 1`
@dataclass(frozen=True)
class Fit:
    """Train a model of the initial force, and save it with its model card.

    Attributes:
        model: `grasp fit` alone is `grasp fit four_finger`.
    """

    model: Annotated[
        Annotated[FourFinger, tyro.conf.subcommand("four_finger")]
        | Annotated[AnyGrasp, tyro.conf.subcommand("any_grasp")],
        tyro.conf.arg(name=""),
    ] = field(default_factory=FourFinger)

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        with interruptible(orderly=False):  # until the training itself takes them
            self.model.execute()


def _command() -> str:
    return " ".join(["grasp", *sys.argv[1:]])


def _print(text: str) -> None:
    """One line, which a terminal shows in as many as it needs, broken between words."""
    console = Console(highlight=False)
    console.print(text, soft_wrap=not console.is_terminal)


def _quick(quick: bool) -> str:
    return " (quick: a rough model)" if quick else ""


def _save(checkpoint: Checkpoint, out: Path) -> Path:
    """Saves the finished model; the state of its training is no longer needed."""
    from training.fit.state import StateFile

    path = checkpoint.save(out)
    StateFile(out, {}).remove()
    return path
