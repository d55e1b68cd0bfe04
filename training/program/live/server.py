"""Local viser server: it listens on 127.0.0.1 and answers only its own page."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from io import StringIO
from typing import Any

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers

from grasp_env.errors import InvalidInputError

_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d+)?")


class LocalServer(viser.ViserServer):
    """Viser server on 127.0.0.1 that refuses pages of other sites and is never shared.

    Args:
        port: port to listen on; if it is taken, the next free one, with a note on stderr; 0: any
            free port.
        label: title of the panel.

    Raises:
        InvalidInputError: a port outside the range.
    """

    def __init__(self, port: int, label: str) -> None:
        # viser tries up to 1000 ports, and hangs if none is free
        if port and not 1024 <= port <= 65000:
            raise InvalidInputError(f"port must be 0 (any free one) or 1024 to 65000, got {port}")
        with _guarded() as guards, redirect_stdout(StringIO()):  # viser prints a banner
            super().__init__("127.0.0.1", port, label, verbose=False)
        if not guards:
            self.stop()
            raise RuntimeError(
                "this version of viser starts its server in another way, so requests would not be checked"
            )
        if port and self.get_port() != port:
            sys.stderr.write(f"grasp: port {port} is taken: port {self.get_port()} instead\n")
        self.gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(150, 30, 140)
        )
        self.gui.main_panel.dock_right()

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Do nothing: viser would open a tunnel to the internet."""

    def stop(self) -> None:
        """Stop the server, its threads and its connections."""
        with redirect_stdout(StringIO()):
            super().stop()


def is_own_page(headers: Headers) -> bool:
    """Return True if a request comes from the page of this server, or opens it.

    Browsers send an Origin with every websocket; a page of another site sends its own. If the name
    of that site resolves to 127.0.0.1 (DNS rebinding), Host is that name.
    """
    host = ",".join(headers.get_all("Host"))
    origins = headers.get_all("Origin")
    own_origin = origins == [f"http://{host}"] or (not origins and "Upgrade" not in headers)
    return own_origin and _OWN_HOST.fullmatch(host) is not None


@contextmanager
def _guarded() -> Iterator[list[Any]]:
    """Make any server that viser starts in the block check every request; list these guards."""
    module: Any = websockets.asyncio.server
    serve = module.serve
    guards = []

    def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def guard(connection: Any, request: Any) -> Any:
            if not is_own_page(request.headers):
                return connection.respond(
                    HTTPStatus.FORBIDDEN, "Only the page of grasp live may connect.\n"
                )
            response = process_request(connection, request)
            if response is not None:
                response.headers["X-Frame-Options"] = "DENY"  # no other page may frame this one
            return response

        guards.append(guard)
        return serve(*arguments, process_request=guard, **options)

    module.serve = guarded
    try:
        yield guards
    finally:
        module.serve = serve
