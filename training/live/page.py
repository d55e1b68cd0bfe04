"""The page itself: a server on this machine only, its theme and camera, recordings, and how it ends."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import rich
import viser
from viser import _messages as messages

from grasp_env.errors import InvalidInputError

HOST = "127.0.0.1"
"""Nobody but this machine is listened to."""


@contextmanager
def _silent() -> Iterator[None]:
    """Viser's own notes are left out: the command says in one line where the page is."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def open_server(port: int, label: str) -> viser.ViserServer:
    """A server on 127.0.0.1 at `port`, or at the next free one, said on stderr; 0: any free one.

    Raises:
        InvalidInputError: no such port, or none free.
    """
    if not 0 <= port <= 65535:
        raise InvalidInputError(f"port must be 0 (any free one) to 65535, got {port}")
    free = _free(port)
    if free is None:
        raise InvalidInputError(
            f"no port from {port} on can be opened on {HOST}: choose another one with --port, above 1023"
        )
    if port and free != port:
        sys.stderr.write(f"grasp: port {port} is taken or closed to you: port {free} instead\n")
    with _silent():
        server = viser.ViserServer(host=HOST, port=free, label=label, verbose=False)
    # viser can lend a page to the world through a tunnel of its makers: not this one
    for kind in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(kind)
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(150, 30, 140))
    server.gui.main_panel.dock_right()
    return server


def close_server(server: viser.ViserServer) -> None:
    """Ends it, its threads and its connections."""
    with _silent():
        server.stop()


def _free(port: int) -> int | None:
    for candidate in range(port, min(port + 20, 65536)) if port else (0,):
        with socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind((HOST, candidate))
            except OSError:
                continue
            return candidate
    return None


def address(server: viser.ViserServer) -> str:
    """Where the page is."""
    return f"http://{HOST}:{server.get_port()}"
