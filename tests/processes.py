"""Processes started by tests."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Sequence
from typing import Any


class _Process(subprocess.Popen[Any]):
    """Process that is killed at the end of its `with` block, or after some seconds."""

    def __init__(self, command: Sequence[str], seconds: float, **options: Any) -> None:
        super().__init__(command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **options)
        self._watch = threading.Timer(seconds, self.kill)
        self._watch.daemon = True
        self._watch.start()

    def __exit__(self, *raised: Any) -> None:
        self._watch.cancel()
        self.kill()
        super().__exit__(*raised)


def start(command: Sequence[str], seconds: float = 300.0, **options: Any) -> subprocess.Popen[Any]:
    """Start a process that ctrl-C ends, even if the tests ignore SIGINT, as in `nohup make test &`; it is killed after some seconds."""
    return _Process(command, seconds, **options)
