"""The program `grasp`: runs one sub-command, tells errors in one line or as JSON, and says by its exit code how it went."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from functools import reduce
from importlib import import_module
from io import StringIO
from operator import or_
from typing import Annotated, Any

from grasp_env._extras import need
from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    NotConvergedError,
    UnknownNameError,
    alike,
)

COMMANDS = {
    "solve": ("Solve", "Optimise one grasp force and print it."),
    "hand": ("Hand", "Read a hand's URDF, and say what was repaired in it."),
    "object": ("Object", "Show what an object's mesh becomes, mend it, list what is kept."),
    "live": ("Live", "Show a grasp in the browser, to be pulled at."),
    "demo": ("Demo", "Save a picture or a video of the simulated hand."),
    "evaluate": ("Evaluate", "Compare starts, controllers, hands or engines."),
    "report": ("Report", "Make a run's page again, or compare two runs."),
    "fit": ("Fit", "Train a model of the initial force."),
    "rl": ("RL", "Train a reinforcement-learning agent, and score it."),
    "reproduce": ("Reproduce", "Study what the paper leaves open, and its claims."),
}
"""Each sub-command is the class of that name in `training.commands.<sub-command>`; the line is what `grasp --help` says of it."""
EXIT_CODES = {
    0: "done",
    1: "a fault of the program",
    2: "wrong usage: an option, name, file or path, or a missing extra",
    3: "infeasible: no force within cones and limits balances the wrench",
    4: "no certified optimum: iteration limit, stalled, or without a start",
    130: "interrupted",
}
"""How `grasp` ends, for scripts."""
_CODES: dict[type[GraspError], int] = {InfeasibleWrenchError: 3, NotConvergedError: 4, InfeasibleStartError: 4}
"""Errors that are no wrong usage."""
HELP = """usage: grasp COMMAND [OPTIONS]

Grasp forces: solve, simulate, learn, report.

{}

grasp COMMAND --help lists the options of a command.
grasp --version prints versions.
grasp --tyro-print-completion bash (or zsh, fish) prints a completion.

Exit codes:
{}
""".format(
    "\n".join(f"  {name:<10} {line}" for name, (_, line) in COMMANDS.items()),
    "\n".join(f"  {code:<10} {meaning}" for code, meaning in EXIT_CODES.items()),
)
_FRAME = str.maketrans("╭╮╰╯│─", "      ")


class UsageError(InvalidInputError):
    """Options that a sub-command does not have.

    Attributes:
        page: the message as the option parser printed it, and a question where a name is almost right.
    """

    def __init__(self, page: str, words: Sequence[str]) -> None:
        from rich.text import Text

        text = " ".join(Text.from_ansi(page).plain.translate(_FRAME).split())
        super().__init__(text)
        named = {name.strip("'(),.") for name in text.split()}  # what was given, and what is allowed
        meant = [alike(word, named - {word}) for word in words if word in named and not word.startswith("-")]
        self.page = page + "".join(f"grasp:{question}\n" for question in meant if question)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one sub-command. Errors are printed on stderr and, with --json among the arguments, as JSON on stdout.

    Args:
        arguments: words of the command line; None: those of this process.

    Returns:
        One of `EXIT_CODES`.

    Raises:
        SystemExit: help, the version or a shell's completion was asked for and is printed.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _parse(words).execute()
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read our output has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (Exception, KeyboardInterrupt) as error:
        return _fail(error, "--json" in words)
    return 0


def _parse(words: list[str]) -> Any:
    """The sub-command that the words ask for, with its options; only that one is imported.

    Raises:
        UnknownNameError: no sub-command has this name.
        UsageError: it has no such options.
        SystemExit: help, the version or a completion was asked for.
    """
    name, rest = (words or ["--help"])[0], words[1:]
    if name in ("--help", "-h", "--version"):
        sys.stdout.write(f"{_version()}\n" if name == "--version" else HELP)
        raise SystemExit(0)
    if name not in COMMANDS and not name.startswith("--tyro-"):
        raise UnknownNameError("sub-command", name, COMMANDS, "; grasp --help tells what each does")
    need("cli")
    import tyro

    told = StringIO()
    try:
        with redirect_stderr(told):
            if name in COMMANDS:
                return tyro.cli(_load(name), prog=f"grasp {name}", args=rest)
            every: Any = reduce(or_, (Annotated[_load(each), tyro.conf.subcommand(each)] for each in COMMANDS))
            return tyro.cli(every, prog="grasp", args=words)  # a completion knows all options
    except SystemExit as stop:
        if stop.code:
            raise UsageError(told.getvalue(), rest) from None
        raise


def _load(name: str) -> Any:
    """The class of a sub-command."""
    return getattr(import_module(f"training.commands.{name}"), COMMANDS[name][0])


def _version() -> str:
    """Versions of the package, of the core's build and of Python, in one line."""
    import platform

    from grasp_env import __version__
    from grasp_env.core import build_info

    built = build_info()
    core = " ".join(built[part] for part in ("version", "compiler", "instruction_set", "build_type", "arch"))
    return f"grasp {__version__}, core {core}, Python {platform.python_version()}"


def _fail(error: BaseException, as_json: bool) -> int:
    """Tells an error to people on stderr, and to machines on stdout where they ask; returns the exit code."""
    code, message, page = 2, str(error), getattr(error, "page", "")
    if isinstance(error, GraspError):
        code = next((code for kind, code in _CODES.items() if isinstance(error, kind)), 2)
    elif isinstance(error, KeyboardInterrupt):
        code, message = 130, "interrupted"
    elif isinstance(error, OSError):  # a disk that is full, a folder that is closed, a name too long: of whatever file
        from grasp_env._files import shown_path

        message = f"{shown_path(error.filename)}: {error.strerror or error}; choose another path"
    else:
        from traceback import format_exc

        code, page = 1, f"{format_exc()}grasp: this is a fault of the program; please report it with the lines above\n"
    sys.stderr.write(page or f"grasp: {message}\n")
    if as_json:
        from training.commands.answers import write_json

        described = {"kind": type(error).__name__, "message": message, "exit_code": code}
        if isinstance(error, UnknownNameError):
            described["allowed"] = list(error.allowed)
        # a command that has numbers for machines in spite of its error hands them on with it
        write_json({"error": described} | getattr(error, "numbers", {}))
    return code


if __name__ == "__main__":
    sys.exit(main())
