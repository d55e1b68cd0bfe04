"""The program `grasp`: runs one sub-command, tells errors in one line or as JSON, and says by its exit code how it went."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

from grasp_env._extras import need
from grasp_env.errors import GraspError, UnknownNameError
from training.commands.exits import exit_code


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one sub-command; what goes wrong is told on stderr and, with --json among the arguments, as JSON on stdout.

    Args:
        arguments: words of the command line; None: those of this process.

    Returns:
        One of `training.commands.exits.EXIT_CODES`.

    Raises:
        SystemExit: help, version or a shell's completion was asked for.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        need("cli")
        from training.commands.program import parsed

        parsed(words).execute()
        sys.stdout.flush()
        return 0
    except GraspError as error:
        return _ended(exit_code(error), error, getattr(error, "page", f"grasp: {error}\n"), words)
    except BrokenPipeError:  # whoever read our output has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a disk that is full, a folder that is closed, a name too long: of whatever file
        from grasp_env._files import shown_path

        told = f"{shown_path(error.filename)}: {error.strerror or error}; choose another path"
        return _ended(2, error, f"grasp: {told}\n", words, told)
    except KeyboardInterrupt as error:
        return _ended(130, error, "grasp: interrupted\n", words, "interrupted")
    except Exception as error:
        from traceback import format_exc

        told = f"{format_exc()}grasp: this is a fault of the program; please report it with the lines above\n"
        return _ended(1, error, told, words)


def _ended(code: int, error: BaseException, told: str, words: Sequence[str], message: str = "") -> int:
    """Tells people on stderr and, where they ask, machines on stdout; returns the exit code."""
    sys.stderr.write(told)
    if "--json" in words:
        described: dict[str, Any] = {"kind": type(error).__name__, "message": message or str(error), "exit_code": code}
        if isinstance(error, UnknownNameError):
            described["allowed"] = list(error.allowed)
        # a command that has numbers for machines in spite of its error hands them on with it
        from training.commands.answers import write_json

        write_json({"error": described} | getattr(error, "numbers", {}))
    return code


if __name__ == "__main__":
    sys.exit(main())
