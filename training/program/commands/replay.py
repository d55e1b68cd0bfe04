"""`grasp replay`: a recording of a hand's controller, run again and drawn."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.extras import need
from training.program.commands.answers import make_table
from training.program.commands.options import left_out

if TYPE_CHECKING:
    from grasp_env.control import Recording
    from grasp_env.control.recording import Differences
    from grasp_env.inputs.arguments import Array

_UNITS = {
    "status": "in status",
    "torques": "N m in torques",
    "commands": "device units in commands",
    "force": "N in forces",
    "friction_used": "in the share of friction",
}


@dataclass(frozen=True)
class Replay:
    """Run a recording of a hand's controller again, compare, and draw it.

    Exit code 0: all that the controller did comes out bit for bit; 1: not.

    Attributes:
        recording: a .csv file of HandController.record.
        save: .png for the picture of the recording.
        output: .csv for what the controller does now.
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    save: Annotated[Path | None, left_out("FILE with .png", "PICTURE.png")] = None
    output: Annotated[Path | None, left_out("none", "AGAIN.csv")] = None

    def execute(self) -> int:
        """Run the command; return the exit code."""
        need("sim", "report")
        from rich.console import Console

        from grasp_env.control import Recording, differences, replay
        from training.program.commands.replay_picture import write_picture

        picture = self.save or self.recording.with_suffix(".png")
        if picture.suffix.lower() != ".png":
            raise InvalidInputError(f"--save must end with .png, got {str(picture)!r}")
        if self.output is not None and os.path.realpath(self.output) == os.path.realpath(
            self.recording
        ):
            raise InvalidInputError("--output must be another file than the recording")
        recording = Recording.load(self.recording)
        again = replay(recording)
        found = differences(recording, again)
        console = Console(highlight=False)
        table = make_table(str(self.recording))
        for row in _facts(recording, again, found):
            table.add_row(*row)
        console.print(table)
        if found.rows:
            console.print(
                "The controller here differs from the one that recorded: it is another build, or another kind of processor rounds "
                "differently (last digits), or the rows were changed."
            )
        if self.output is not None:
            console.print(f"again: {again.save(self.output)}", soft_wrap=True)
        write_picture(recording, picture)
        console.print(f"picture: {picture}", soft_wrap=True)
        return int(found.rows > 0)


def _facts(recording: Recording, again: Recording, found: Differences) -> list[tuple[str, str]]:
    from grasp_env.control.recording import FOREIGN, STATUSES, UPDATE
    from training.program.commands.replay_picture import torque_shares

    updates = np.isin(recording["event"], (UPDATE, FOREIGN))
    times = recording.times
    counts = np.bincount(recording["status"][updates].astype(int), minlength=len(STATUSES))
    facts = [
        ("updates", f"{updates.sum():,}"),
        ("time", f"{times[-1]:.3f} s"),
        *(
            (f"  {name}", f"{count:,} ({count / updates.sum():.1%})")
            for name, count in zip(STATUSES, counts.tolist(), strict=True)
            if count
        ),
    ]
    if found.first is None:
        facts.append(("rows that differ", "none: bit for bit"))
    else:
        largest = (f"{found.largest[name]:.3g} {unit}" for name, unit in _UNITS.items())
        facts += [
            ("rows that differ", f"{found.rows:,} of {len(recording):,}"),
            ("first of them", f"row {found.first}, at {times[found.first]:.3f} s"),
            ("largest differences", "\n".join(largest)),
        ]
    shares = np.abs(torque_shares(recording))
    durations = [1e6 * each["duration"][updates] for each in (recording, again)]
    facts += [
        ("largest share of friction", _largest(recording["friction_used"], times, "finger")),
        ("largest share of a torque limit", _largest(shares, times, "joint")),
        (
            "longest update",
            " us, here ".join(f"{each.max(initial=0.0):.1f}" for each in durations) + " us",
        ),
    ]
    return facts


def _largest(values: Array, times: Array, what: str) -> str:
    """Return the largest finite number of (K, n), where and when it is."""
    finite = np.where(np.isfinite(values), values, -np.inf)
    row, column = np.unravel_index(finite.argmax(), finite.shape)
    return f"{max(finite[row, column], 0.0):.3f}, {what} {column} at {times[row]:.3f} s"
