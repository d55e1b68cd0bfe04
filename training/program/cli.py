"""Program `grasp`: run a sub-command, report errors, and return an exit code."""

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

from grasp_env.errors import (
    GraspError,
    InfeasibleStartError,
    InfeasibleWrenchError,
    InvalidInputError,
    NotConvergedError,
    UnknownNameError,
    alike,
)
from grasp_env.inputs.extras import need

COMMANDS = {
    "solve": ("Solve", "Optimise one grasp force and print it."),
    "hand": ("Hand", "Read a hand's file, and list what was repaired in it."),
    "object": ("Object", "Show how a mesh is read, repair it, or list the cache."),
    "replay": ("Replay", "Run a recording of a hand's controller again."),
    "live": ("Live", "Open a grasp in the browser and pull on the object."),
    "demo": ("Demo", "Save a picture or a video of the simulated hand."),
    "evaluate": ("Evaluate", "Compare starts, controllers, hands or engines."),
    "report": ("Report", "Make a run's page again, or compare two runs."),
    "fit": ("Fit", "Train a model that predicts the initial force."),
    "rl": ("RL", "Train a reinforcement-learning agent, and score it."),
    "reproduce": ("Reproduce", "Study what the paper leaves open, and its claims."),
}
"""Class in `training.program.commands.<sub-command>`, and line in `grasp --help`."""
EXIT_CODES = {
    0: "done",
    1: "a fault of the program; of replay: a difference",
    2: "wrong usage: an option, name, file or path, or a missing extra",
    3: "infeasible: no force within cones and limits balances the wrench",
    4: "no certified optimum: iteration limit, stalled, or without a start",
    130: "interrupted",
}
"""Exit codes of `grasp` and their meaning."""
_CODES: dict[type[GraspError], int] = {
    InfeasibleWrenchError: 3,
    NotConvergedError: 4,
    InfeasibleStartError: 4,
}
"""Exit codes of errors other than wrong usage."""
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
        page: the message as the option parser printed it, with a "did you mean" line if a name is
            misspelt.
    """

    def __init__(self, page: str, words: Sequence[str]) -> None:
        from rich.text import Text

        text = " ".join(Text.from_ansi(page).plain.translate(_FRAME).split())
        super().__init__(text)
        names = {name.strip("'(),.") for name in text.split()}  # the given and the allowed ones
        # a wrong name stands in quotes; other words of the command may occur in the help
        misspelt = [word for word in words if f"'{word}'" in text and not word.startswith("-")]
        questions = [alike(word, names - {word}) for word in misspelt]
        self.page = page + "".join(f"grasp:{question}\n" for question in questions if question)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one sub-command.

    Errors are printed on stderr and, with --json among the arguments, as JSON on stdout.

    Args:
        arguments: words of the command line; None: those of this process.

    Returns:
        One of `EXIT_CODES`.

    Raises:
        SystemExit: after printing help, the version or a shell completion.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = _parse(words).execute()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader closed the pipe
        _drop_output()
        return 0
    except (Exception, KeyboardInterrupt) as error:
        return _fail(error, "--json" in words)
    return code or 0


def _parse(words: list[str]) -> Any:
    """Parse the words into a sub-command with its options. Only that sub-command is imported.

    Raises:
        UnknownNameError: no sub-command has this name.
        UsageError: the sub-command has no such options.
        SystemExit: after printing help, the version or a completion.
    """
    name = (words or ["--help"])[0]
    rest = words[1:]
    if name in ("--help", "-h", "--version"):
        sys.stdout.write(f"{_version()}\n" if name == "--version" else HELP)
        raise SystemExit(0)
    if name not in COMMANDS and not name.startswith("--tyro-"):
        raise UnknownNameError("sub-command", name, COMMANDS, "; grasp --help describes each")
    need("cli")
    import tyro

    printed = StringIO()
    try:
        with redirect_stderr(printed):
            if name in COMMANDS:
                return tyro.cli(_load(name), prog=f"grasp {name}", args=rest)
            commands = (Annotated[_load(name), tyro.conf.subcommand(name)] for name in COMMANDS)
            union: Any = reduce(or_, commands)
            return tyro.cli(union, prog="grasp", args=words)  # a completion lists all options
    except SystemExit as stop:
        if stop.code:
            raise UsageError(printed.getvalue(), rest) from None
        raise


def _load(name: str) -> Any:
    return getattr(import_module(f"training.program.commands.{name}"), COMMANDS[name][0])


def _version() -> str:
    import platform

    from grasp_env import __version__
    from grasp_env.core import build_info

    build = build_info()
    names = ("version", "compiler", "instruction_set", "build_type", "arch")
    core = " ".join(build[name] for name in names)
    return f"grasp {__version__}, core {core}, Python {platform.python_version()}"


def _fail(error: BaseException, as_json: bool) -> int:
    """Print an error on stderr, and as JSON on stdout if `as_json`; return the exit code."""
    code = 2
    message = str(error)
    page = getattr(error, "page", "")
    if isinstance(error, GraspError):
        code = next((code for kind, code in _CODES.items() if isinstance(error, kind)), 2)
    elif isinstance(error, KeyboardInterrupt):
        code, message = 130, "interrupted"
    elif isinstance(error, OSError):  # a full disk, no permission, a name that is too long
        from grasp_env.inputs.files import file_fault

        message = ("" if error.filename is None else f"{error.filename}: ") + file_fault(error)
    else:
        from traceback import format_exc

        code = 1
        page = f"{format_exc()}grasp: this is a fault of the program; please report it with the lines above\n"
    sys.stderr.write(page or f"grasp: {message}\n")
    if as_json:
        from training.program.commands.answers import write_json

        facts = {"kind": type(error).__name__, "message": message, "exit_code": code}
        if isinstance(error, UnknownNameError):
            facts["allowed"] = list(error.allowed)
        # some commands attach numbers to their error
        try:
            write_json({"error": facts} | getattr(error, "numbers", {}))
            sys.stdout.flush()
        except OSError:  # a full disk, or the reader closed the pipe
            _drop_output()
    return code


def _drop_output() -> None:
    """Discard all further output, also at the end of the process."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
