"""Grasp forces of a simulated four-finger hand: solve, fit, rl, evaluate, report, reproduce, bench, demo, warmup."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from grasp_env._files import shown_path
from grasp_env.errors import GraspError
from training.commands.bench import Bench
from training.commands.demo import Demo
from training.commands.evaluate import Evaluate
from training.commands.fit import Fit, spelled_out
from training.commands.report import Report
from training.commands.reproduce import Reproduce
from training.commands.rl import RL
from training.commands.solve import Solve
from training.commands.warmup import Warmup

Command = (
    Annotated[Solve, tyro.conf.subcommand("solve")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[RL, tyro.conf.subcommand("rl")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Warmup, tyro.conf.subcommand("warmup")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one sub-command.

    Returns:
        0; 2 after an error of the project, told in one line on stderr; 130 after an interrupt.
    """
    try:
        command: Any = tyro.cli(Command, prog="grasp", description=__doc__, args=spelled_out(arguments))  # type: ignore[arg-type]
        command.execute()
    except GraspError as error:
        sys.stderr.write(f"grasp: {error}\n")
        return 2
    except OSError as error:  # a disk that is full, a folder that is closed, a name too long: of whatever file
        sys.stderr.write(f"grasp: {shown_path(error.filename)}: {error.strerror or error}; choose another path\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("grasp: interrupted\n")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
