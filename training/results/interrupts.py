"""What ctrl-C and SIGTERM do to work that must end whole."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interruptible(*, orderly: bool = True) -> Iterator[Callable[[], bool]]:
    """SIGINT and SIGTERM within the block are one thing, and whoever had them before has them again afterwards.

    Args:
        orderly: the first is only noted, and yielded to whoever asks, so that a step can end; the next interrupts at once. Else the
            first one does.
    """
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if not orderly or len(came) > 1:
            raise KeyboardInterrupt

    kept = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            kept[number] = signal.signal(number, note)
    except ValueError:  # not the main thread: nobody interrupts it
        pass
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
