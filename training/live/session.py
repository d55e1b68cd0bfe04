"""A page from its first drawing to its end: the worker that draws, recordings, how long it lasts."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import viser

from grasp_env.errors import InvalidInputError
from training.live.newest import Newest
from training.live.page import address, close_server
from training.live.parts import MOST_RECORDED, Recorder, on_press

_PATIENCE = 5e-4
"""[s] that one of the threads, which draws or which listens, waits for the other: Python's own 5 ms is a quarter of what a redraw may take."""


class Page(Protocol):
    """What a session draws.

    Attributes:
        every: [s] after which it is drawn even if nothing happens; None: only then.
    """

    every: float | None

    def watch(self, wake: Callable[[], None]) -> None:
        """`wake` is to be called at every event."""
        ...

    def draw(self) -> None:
        """Draws what is now; called by one thread at a time."""
        ...


class Session:
    """Draws a page until its time is over or ctrl-C.

    Args:
        server: where it is shown; closed at the end.
        page: what is shown.
        name: of the recordings made by the button.
        record: a file that records all of it.
    """

    def __init__(self, server: viser.ViserServer, page: Page, name: str, record: Path | None = None) -> None:
        self._server, self._page, self._name = server, page, name
        self._whole = record
        self._recorders: list[Recorder] = []
        self._presses, self._over = deque[None](), threading.Event()
        self._button = server.gui.add_button("Record", color="gray", hint=f"up to {MOST_RECORDED:.0f} s, to one HTML file in this folder")  # fmt: skip
        self._note = server.gui.add_markdown("")
        self._wake: Callable[[], None] = lambda: None
        on_press(self._button, self._press)

    def stop(self) -> None:
        """Ends `run`, from another thread."""
        self._over.set()

    def run(self, seconds: float | None) -> None:
        """Shows it for so long; None: until ctrl-C."""
        patience = sys.getswitchinterval()
        sys.setswitchinterval(_PATIENCE)
        self._page.draw()
        worker = Newest(self._draw, self._page.every)
        try:
            if self._whole is not None:
                self._recorders.append(Recorder(self._server, self._whole, self._name))
            self._wake = worker.wake
            self._page.watch(worker.wake)
            worker.wake()  # for what somebody was quick to do
            sys.stdout.write(f"{address(self._server)}  (Ctrl-C ends it)\n")
            sys.stdout.flush()
            self._wait(worker, seconds)
        finally:
            worker.close()
            close_server(self._server)
            sys.setswitchinterval(patience)
            for recorder in self._recorders:
                self._save(recorder)
        if worker.fault is not None:
            raise worker.fault

    def _wait(self, worker: Newest, seconds: float | None) -> None:
        """Until the time is over, the worker ended by a fault, or `stop`."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while (
            time.monotonic() < end
            and worker.wait(0.0)
            and not self._over.wait(min(0.2, max(0.0, end - time.monotonic())))
        ):
            pass

    def _press(self) -> None:
        self._presses.append(None)
        self._wake()

    def _draw(self) -> None:
        full = [recorder for recorder in self._recorders if not recorder.frame()]
        self._page.draw()
        for recorder in full:
            self._end(recorder)
        while self._presses:
            self._presses.popleft()
            running = [recorder for recorder in self._recorders if recorder.path != self._whole]
            if running:
                self._end(running[0])
            else:
                self._recorders.append(Recorder(self._server, _unused(self._name), self._name))
                self._button.label, self._note.content = "Stop and save", "recording …"

    def _end(self, recorder: Recorder) -> None:
        self._recorders.remove(recorder)
        self._save(recorder)
        if recorder.path != self._whole:
            self._button.label, self._note.content = "Record", f"saved: {recorder.path.name}"

    def _save(self, recorder: Recorder) -> None:
        recorder.save()
        sys.stdout.write(f"{recorder.path}\n")
        sys.stdout.flush()


def checked_record(path: Path | None) -> Path | None:
    """A path that a recording can be written to.

    Raises:
        InvalidInputError: another suffix, or a folder that does not exist.
    """
    if path is not None and path.suffix != ".html":
        raise InvalidInputError(f"record must end in .html, got {path}")
    if path is not None and not path.absolute().parent.is_dir():
        raise InvalidInputError(f"the folder {path.absolute().parent} does not exist: make it first")
    return path


def _unused(name: str) -> Path:
    """A file of this folder that does not exist yet."""
    stem = name.replace(" ", "-")
    number = next(k for k in range(1, 10_000) if not Path(f"{stem}-{k}.html").exists())
    return Path(f"{stem}-{number}.html").absolute()
