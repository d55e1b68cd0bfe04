"""Orderly handling of ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interruptible(*, orderly: bool = True) -> Iterator[Callable[[], bool]]:
    """Treat SIGINT and SIGTERM alike in the block, and restore the previous handlers afterwards.

    Yields:
        A function that returns True once a signal has come.

    Args:
        orderly: the first signal only sets that flag, so that a step can end, and the next raises
            KeyboardInterrupt. Otherwise the first one raises.
    """
    signals: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        if not orderly or len(signals) > 1:
            raise KeyboardInterrupt

    previous = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, note)
    except ValueError:  # not the main thread, which signals do not interrupt
        pass
    try:
        yield lambda: bool(signals)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
