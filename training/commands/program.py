"""Which sub-commands `grasp` has, and which one the arguments ask for; only that one is imported."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import make_dataclass
from functools import reduce
from importlib import import_module
from operator import or_
from typing import Annotated, Any

import tyro

from grasp_env.errors import UnknownNameError

COMMANDS: dict[str, tuple[str, str]] = {
    "solve": ("Solve", "Optimise one grasp force and print it."),
    "hand": ("Hand", "Read a hand's URDF, and say what was repaired in it."),
    "live": ("Live", "Show a grasp in the browser, to be pulled at."),
    "demo": ("Demo", "Save a picture or a video of the simulated hand."),
    "evaluate": ("Evaluate", "Compare starts, hands or engines, and write a report."),
    "report": ("Report", "Rebuild a run's report from its saved trials."),
    "fit": ("Fit", "Train a model of the initial force."),
    "rl": ("RL", "Train a reinforcement-learning agent, and score it."),
    "reproduce": ("Reproduce", "Study what the paper leaves open, and its claims."),
    "bench": ("Bench", "Time the solvers or the environment."),
}
"""The sub-commands: each the class of that name in the module `training.commands.<sub-command>`, and its line in `grasp --help`."""
DESCRIPTION = "Grasp forces: solve, simulate, learn, report. Each sub-command tells its options: grasp solve --help."


def parsed(arguments: Sequence[str] | None) -> Any:
    """The sub-command that `arguments` (None: those of this process) ask for, with its options.

    Raises:
        UnknownNameError: no sub-command has this name.
        SystemExit: help was asked for (0), or the options are no options of it (2).
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words:
        with redirect_stdout(sys.stderr):
            _overview(["--help"], 2)
    name = words[0]
    if name in COMMANDS:
        kind = command(name)
        words = getattr(kind, "spelled_out", list)(words[1:])
        return tyro.cli(kind, prog=f"grasp {name}", args=words)
    if name.startswith("--tyro-"):  # the completion of a shell knows all options
        return tyro.cli(_union({name: command(name) for name in COMMANDS}), prog="grasp", args=words)
    if name.startswith("-"):
        _overview(words)
    raise UnknownNameError("sub-command", name, COMMANDS, "; grasp --help tells what each does")


def command(name: str) -> Any:
    """The class of a sub-command, imported."""
    return getattr(import_module(f"training.commands.{name}"), COMMANDS[name][0])


def _overview(words: Sequence[str], code: int = 0) -> None:
    """`grasp --help`, of sub-commands that nobody imports; ends the process."""
    kinds = {name: make_dataclass(name, [], namespace={"__doc__": line}) for name, (_, line) in COMMANDS.items()}
    try:
        tyro.cli(_union(kinds), prog="grasp", description=DESCRIPTION, args=words)
    except SystemExit as stop:
        raise SystemExit(stop.code or code) from None


def _union(kinds: dict[str, Any]) -> Any:
    """One of several sub-commands, as tyro takes it."""
    return reduce(or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items()))
