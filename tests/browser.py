"""Headless Chromium, driven over a pipe by its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")


def find_browser() -> str | None:
    """Return the browser's path; None if there is none."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


class Browser:
    """One tab.

    `requests` lists all that it asks the network for, `errors` its warnings and errors.
    """

    def __init__(self, write: int, read: int, seconds: float = 30.0) -> None:
        self._write = write
        self._read = read
        self._seconds = seconds
        self._buffer, self._number, self._session = b"", 0, ""
        self._seen: set[str] = set()
        self.requests: list[str] = []
        self.errors: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and wait for its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def show(self, path: Path | str, width: int, height: int, **features: str) -> None:
        """Open a file, or an address, in a window of that size, with media features (prefers_...)."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1.0, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        wanted = [
            {"name": name.replace("_", "-"), "value": value} for name, value in features.items()
        ]
        self.call("Emulation.setEmulatedMedia", features=wanted)
        self._seen.discard("Page.loadEventFired")
        self.call("Page.navigate", url=path if isinstance(path, str) else path.absolute().as_uri())
        while "Page.loadEventFired" not in self._seen:
            self._next()

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page; a promise is awaited."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def picture(self, out: Path) -> None:
        """Save the window as PNG."""
        shot = self.call("Page.captureScreenshot", format="png")
        out.write_bytes(base64.b64decode(shot["data"]))

    def _next(self) -> dict[str, Any]:
        """Return the next message, and record events."""
        end = time.monotonic() + self._seconds
        while b"\0" not in self._buffer:
            if not select.select([self._read], [], [], max(0.0, end - time.monotonic()))[0]:
                raise TimeoutError(f"the browser did not answer for {self._seconds} s")
            part = os.read(self._read, 1 << 20)
            if not part:
                raise RuntimeError("the browser has ended")
            self._buffer += part
        line, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(line)
        self._note(message.get("method", ""), message.get("params", {}))
        return message

    def _note(self, event: str, params: dict[str, Any]) -> None:
        self._seen.add(event)
        if event == "Network.requestWillBeSent" and not params["request"]["url"].startswith(
            "data:"
        ):
            self.requests.append(params["request"]["url"])
        elif event == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"]["text"])
        elif event == "Log.entryAdded" and params["entry"]["level"] in ("warning", "error"):
            self.errors.append(params["entry"]["text"])
        elif event == "Runtime.consoleAPICalled" and params["type"] in (
            "warning",
            "error",
            "assert",
        ):
            self.errors.append(str(params["args"]))


@contextmanager
def browser(executable: str, *, local: bool = False) -> Iterator[Browser]:
    """Start a browser without network, with a temporary profile; end it afterwards.

    Args:
        executable: path of the browser.
        local: allow servers on 127.0.0.1, and draw WebGL in software.
    """
    rules = "MAP * ~NOTFOUND"
    graphics = ["--disable-gpu"]
    if local:
        rules = f"{rules}, EXCLUDE 127.0.0.1"
        graphics = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    (child_read, write), (read, child_write) = os.pipe(), os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            executable,
            "--headless",
            *graphics,
            "--no-first-run",
            "--remote-debugging-pipe",
            "--hide-scrollbars",
            f"--host-resolver-rules={rules}",
            "--disable-background-networking",
            "--disable-dev-shm-usage",
            f"--user-data-dir={profile}",
            *(["--no-sandbox"] if os.geteuid() == 0 else []),
            "about:blank",
        ]
        # the protocol uses descriptors 3 and 4; a small process sets them and then becomes the
        # browser
        become = "import fcntl, os, sys; a, b = (fcntl.fcntl(int(n), fcntl.F_DUPFD, 10) for n in sys.argv[1:3]); "
        become += "os.dup2(a, 3); os.dup2(b, 4); os.execv(sys.argv[3], sys.argv[3:])"
        python = [
            sys.executable,
            "-S",
            "-E",
            "-c",
            become,
            str(child_read),
            str(child_write),
            *command,
        ]
        quiet = {
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
        }
        with subprocess.Popen(python, pass_fds=(child_read, child_write), **quiet) as process:
            os.close(child_read)
            os.close(child_write)
            try:
                yield Browser(write, read)
            finally:
                os.close(write)  # the browser ends when its pipe closes
                os.close(read)
                try:
                    process.wait(timeout=10)
                except subprocess.TimeoutExpired:
                    process.kill()
