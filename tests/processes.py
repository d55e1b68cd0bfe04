"""Processes started by tests."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Any

import pytest


class _Process(subprocess.Popen[Any]):
    """Process that is killed at the end of its `with` block, or after some seconds."""

    def __init__(self, command: Sequence[str], seconds: float, **options: Any) -> None:
        super().__init__(
            command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **options
        )
        self._watch = threading.Timer(seconds, self.kill)
        self._watch.daemon = True
        self._watch.start()

    def __exit__(self, *raised: Any) -> None:
        self._watch.cancel()
        self.kill()
        super().__exit__(*raised)


def start(command: Sequence[str], seconds: float = 300.0, **options: Any) -> subprocess.Popen[Any]:
    """Start a process that ctrl-C ends, even if the tests ignore SIGINT, as in `nohup make test &`;
    it is killed after some seconds."""
    return _Process(command, seconds, **options)


def cpython(*minors: int) -> str:
    """Return the first interpreter, CPython 3.minor, that this one or the PATH has; skip the test
    if there is none."""
    for minor in minors:
        if minor == sys.version_info.minor:
            return sys.executable
        found = shutil.which(f"python3.{minor}")
        if (
            found
            and subprocess.run([found, "-V"], capture_output=True, check=False).returncode == 0
        ):
            return found
    pytest.skip(f"no CPython 3.{minors[0]}{' or later' if len(minors) > 1 else ''} on the PATH")
