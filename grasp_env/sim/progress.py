"""Progress line on a terminal for long work."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

Item = TypeVar("Item")

PATIENCE = 1.0  # time after which long work is reported [s]
_WIDTH = 24  # characters of the bar


class ProgressLine:
    """A line on stderr that is overwritten; only on a terminal, and after `PATIENCE`."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._length = 0
        self._terminal = sys.stderr is not None and sys.stderr.isatty()

    def __enter__(self) -> ProgressLine:
        return self

    def write(self, text: str) -> None:
        """Show a text and the elapsed seconds."""
        passed = time.monotonic() - self._begun
        if self._terminal and passed > PATIENCE:
            text = f"{text}, {passed:.0f} s"[: shutil.get_terminal_size().columns - 1]
            print(f"\r{text:{self._length}}", end="", file=sys.stderr, flush=True)
            self._length = len(text)

    def __exit__(self, *error: object) -> None:
        if self._length:
            print(file=sys.stderr)


def progress_bar(items: Sequence[Item], text: str) -> Iterator[Item]:
    """Yield the items, with a progress bar on a terminal."""
    with ProgressLine() as line:
        for done, item in enumerate(items):
            line.write(
                f"[{'#' * (_WIDTH * done // len(items)):{_WIDTH}}] {done} of {len(items)} {text}"
            )
            yield item
        line.write(f"[{'#' * _WIDTH}] {len(items)} of {len(items)} {text}")
