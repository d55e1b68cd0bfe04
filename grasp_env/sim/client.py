"""The only import of PyBullet, its connections, and the suppression of its output.

PyBullet prints from C when it is imported and when it connects. The rest of the package uses the
raw module with an explicit client number: PyBullet's wrapper class costs three times as much per
call.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from grasp_env.errors import MissingExtraError, SimulationError
from grasp_env.sim.simulator import CLOSED


@contextmanager
def silenced() -> Iterator[None]:
    """Discard all output to the standard streams while the block runs, also that of C code."""
    _flush()
    sink = os.open(os.devnull, os.O_WRONLY)
    copies = {}
    try:
        for stream in (1, 2):
            with suppress(OSError):  # a process may have no standard streams
                copies[stream] = os.dup(stream)
                os.dup2(sink, stream)
        yield
    finally:
        _flush()
        for stream, copy in copies.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(sink)


def _flush() -> None:
    """Empty the output buffers of Python and of C."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)


try:
    with silenced():
        import pybullet as bullet  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingExtraError(
        f"engine 'bullet' needs pybullet, which has wheels for CPython 3.10 and 3.11 only, and this is {platform.python_version()}: "
        "use engine='mujoco', or an environment of one of those"
    ) from error


def _has_display() -> bool:
    """True if a window can be opened. PyBullet ends the whole process if it cannot."""
    if not sys.platform.startswith("linux"):
        return True
    display = os.environ.get("DISPLAY", "")
    if not display.startswith(":"):
        return bool(display)
    number = display[1:].split(".")[0]
    return os.path.exists(f"/tmp/.X11-unix/X{number}")


def _disconnect(number: int) -> None:
    """Close a connection, unless it was closed with its window."""
    if bullet.isConnected(number):
        bullet.disconnect(number)


class Client:
    """A connection to a PyBullet server inside this process.

    Raises:
        SimulationError: There is no display for a window, or no connection is left.
    """

    def __init__(self, gui: bool = False) -> None:
        if gui and not _has_display():
            raise SimulationError(
                f"a window was requested but there is no display (DISPLAY={os.environ.get('DISPLAY')!r}); use render_mode='rgb_array' or "
                "gui=False, or run under a display such as xvfb-run"
            )
        with silenced():
            number = bullet.connect(bullet.GUI if gui else bullet.DIRECT)
        if number < 0:
            raise SimulationError(
                "PyBullet gave no connection; it allows 1024 in one process: close scenes that are no longer used"
            )
        self._number: int | None = number
        self._finalizer = weakref.finalize(self, _disconnect, number)

    def __repr__(self) -> str:
        return f"Client({'closed' if self._number is None else self._number})"

    @property
    def number(self) -> int:
        """Number of the connection, `physicsClientId` of PyBullet's functions.

        Raises:
            SimulationError: The client is closed.
        """
        if self._number is None:
            raise SimulationError(CLOSED)
        return self._number

    def close(self) -> None:
        """Disconnect; calling it again does nothing."""
        self._number = None
        self._finalizer()
