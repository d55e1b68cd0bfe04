"""Grasp forces of a simulated four-finger hand: solve, fit, rl, evaluate, report, reproduce, bench, demo, hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from training.commands.bench import Bench
from training.commands.demo import Demo
from training.commands.evaluate import Evaluate
from training.commands.fit import Fit, spelled_out
from training.commands.hand import Hand
from training.commands.report import Report
from training.commands.reproduce import Reproduce
from training.commands.rl import RL
from training.commands.solve import Solve

Command = (
    Annotated[Solve, tyro.conf.subcommand("solve")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[RL, tyro.conf.subcommand("rl")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Hand, tyro.conf.subcommand("hand")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


def parsed(arguments: Sequence[str] | None) -> Any:
    """The sub-command that `arguments` (None: those of this process) ask for, with its options."""
    return tyro.cli(Command, prog="grasp", description=__doc__, args=spelled_out(arguments))  # type: ignore[arg-type]
