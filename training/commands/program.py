"""Which sub-commands `grasp` has, and which one the arguments ask for; only that one is imported."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import make_dataclass
from functools import reduce
from importlib import import_module
from io import StringIO
from operator import or_
from shutil import get_terminal_size
from textwrap import fill
from typing import Annotated, Any

import tyro

from grasp_env.errors import InvalidInputError, UnknownNameError, alike
from training.commands.exits import EXIT_CODES

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
DESCRIPTION = f"""Grasp forces: solve, simulate, learn, report. Each sub-command tells its options: grasp solve --help.

grasp --version tells versions, grasp --tyro-print-completion bash (or zsh, fish) prints a completion for that shell.

Exit codes: {"; ".join(f"{code} {meaning}" for code, meaning in EXIT_CODES.items())}."""


class UsageError(InvalidInputError):
    """Options that a sub-command does not have.

    Attributes:
        page: the same for people, in a frame.
    """

    def __init__(self, page: str) -> None:
        # the frame's first row is its title, its last part points to --help
        rows = [re.sub(r"^[│|] ?| *[│|]$", "", row) for row in page.splitlines()[1:]]
        text = " ".join(" ".join(row for row in rows if re.search(r"\w", row)).split()).partition(" For full helptext")[
            0
        ]
        super().__init__(text)
        # a list of what is allowed says what was meant only to those who read it
        found = re.search(r"(?:choice '|options: )([^',\s]+).*(?:one of \(|subcommands: )([^)]*)", text)
        meant = alike(found[1], re.findall(r"[\w./-]+", found[2])) if found else ""
        self.page = f"{page}grasp:{meant}\n" if meant else page


def parsed(arguments: Sequence[str]) -> Any:
    """The sub-command that `arguments` ask for, with its options.

    Raises:
        UnknownNameError: no sub-command has this name.
        UsageError: the options are none of it.
        SystemExit: help, the version or a completion was asked for and is printed.
    """
    words = list(arguments)
    name = words[0] if words else ""
    if name in COMMANDS:
        kind = command(name)
        return _read(kind, f"grasp {name}", getattr(kind, "spelled_out", list)(words[1:]))
    if name == "--version":
        sys.stdout.write(f"{version()}\n")
        raise SystemExit(0)
    if name.startswith("--tyro-"):  # the completion of a shell knows all options
        return _read(_union({name: command(name) for name in COMMANDS}), "grasp", words)
    # nobody imports the sub-commands to list them
    kinds = {name: make_dataclass(name, [], namespace={"__doc__": line}) for name, (_, line) in COMMANDS.items()}
    if not words or name.startswith("-"):
        return _read(_union(kinds), "grasp", words or ["--help"], DESCRIPTION)
    raise UnknownNameError("sub-command", name, COMMANDS, "; grasp --help tells what each does")


def _read(kind: Any, program: str, words: Sequence[str], description: str | None = None) -> Any:
    """What tyro makes of the options."""
    page, told = _Page(), StringIO()
    with redirect_stderr(told):
        try:
            with redirect_stdout(page):
                return tyro.cli(kind, prog=program, description=description, args=words)
        except SystemExit as stop:
            if stop.code:
                raise UsageError(told.getvalue()) from None
            wide = min(80, get_terminal_size().columns)
            for line in page.getvalue().splitlines():  # tyro wraps the options only
                sys.stdout.write(f"{fill(line, wide) if line[:1].isalpha() else line}\n")
            raise


class _Page(StringIO):
    """Help on its way to stdout: coloured where that is a terminal, framed where it knows the letters."""

    encoding = property(lambda self: getattr(sys.__stdout__, "encoding", "ascii"))  # type: ignore[assignment]

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


def version() -> str:
    """Versions of the package, of the core's build and of Python, in one line."""
    import platform

    from grasp_env import __version__
    from grasp_env.core import build_info

    built = build_info()
    core = " ".join(built[part] for part in ("version", "compiler", "instruction_set", "build_type", "arch"))
    return f"grasp {__version__}, core {core}, Python {platform.python_version()}"


def command(name: str) -> Any:
    """The class of a sub-command, imported."""
    return getattr(import_module(f"training.commands.{name}"), COMMANDS[name][0])


def _union(kinds: dict[str, Any]) -> Any:
    """One of several sub-commands, as tyro takes it."""
    return reduce(or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items()))
