"""Processes that tests start."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Sequence
from typing import Any


class _Process(subprocess.Popen[Any]):
    """A process that ends with its `with` block, and is killed after some seconds, so that nobody waits for its pipes for ever."""

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
    """Starts a process that ctrl-C ends, also where the tests ignore SIGINT, as in `nohup make test &`.

    Args:
        command: the program and its words.
        seconds: after which it is killed.
        options: of `subprocess.Popen`.
    """
    return _Process(command, seconds, **options)
