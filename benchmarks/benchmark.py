"""Parts of a benchmark, and common settings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from shutil import get_terminal_size
from typing import Annotated, Any, Generic, TypeVar

import tyro
from matplotlib.figure import Figure

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs import ranges
from training.evaluation.results.claims import Claim
from training.evaluation.results.table import pd

RANGES = {
    "contacts": (3, ranges.CONTACTS),
    "wrenches": (8, 10_000_000),
    "seed": (0, ranges.SEED),
    "seeds": (0, 1000),
    "start": (0, 1000),
    "ticks": (1, 10_000_000),
}
"""Allowed values of settings that are whole numbers; the others take 1 to 100,000."""


def tick(text: str) -> None:
    """Print the current case on a line of a terminal that the next one overwrites."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{text[: get_terminal_size().columns - 1]}\r")


@dataclass(frozen=True)
class TimingSettings:
    """Settings of a benchmark.

    Attributes:
        contacts: numbers of contacts.
        wrenches: problems for each number of contacts, divided among four grasps.
        rounds: rounds in which the contestants take turns, so that a busy moment affects all alike.
        passes: passes in a round; the time of a problem is the best of rounds * passes calls.
        seed: seed of the problems.
    """

    contacts: tuple[int, ...]
    wrenches: int
    rounds: int
    passes: int
    seed: int = 0


@dataclass(frozen=True)
class Benchmark:
    """A benchmark, by name in `benchmarks.__main__.BENCHMARKS`.

    Attributes:
        run: maps settings to rows with columns of `training.evaluation.results.columns`. A row with
            a `reason` was not measured.
        settings: default settings, a dataclass whose fields are the options.
        quick: changes to them for a small version with rough numbers.
        shown: printed columns of the summary, in addition to its keys.
        claims: claims about the summary.
        words: meaning of values of the column `method`.
        notes: maps the summary to lines to print below it.
        draw: maps the rows and `words` to a figure that is saved as picture.svg; None: no picture.
    """

    run: Callable[[Any], pd.DataFrame]
    settings: Any
    quick: Mapping[str, Any]
    shown: tuple[str, ...]
    claims: tuple[Claim, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)
    notes: Callable[[pd.DataFrame], Iterable[str]] = lambda summary: ()
    draw: Callable[[pd.DataFrame, Mapping[str, str]], Figure] | None = None


SettingsT = TypeVar("SettingsT")


@dataclass(frozen=True)
class RunOptions(Generic[SettingsT]):
    """Options of a run.

    Attributes:
        settings: settings of the benchmark.
        quick: run a small version with rough numbers.
        out: folder of runs.
        name: name of this run's folder; empty: kind and time.
        compare: folder of an earlier run of the same kind for comparison.
        json: print one JSON object, also for errors.
    """

    settings: tyro.conf.OmitArgPrefixes[SettingsT]
    quick: bool = False
    out: Path = Path("runs")
    name: str = ""
    compare: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    json: bool = False


def checked(settings: Any) -> None:
    """Raise an `InvalidInputError` if a whole number of the settings is out of its range."""
    for name, value in vars(settings).items():
        least, most = RANGES.get(name, (1, 100_000))
        for number in value if isinstance(value, tuple) else (value,):
            if type(number) is int and not least <= number <= most:
                raise InvalidInputError(
                    f"{name} must be at least {least}, at most {most}, got {shown(number)}"
                )
