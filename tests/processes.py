"""Processes that tests start."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Sequence
from typing import Any


class _Process(subprocess.Popen[Any]):
    """A process that does not outlive its `with` block: where a test gave up on it, the block would wait without an end."""

    def __exit__(self, *raised: Any) -> None:
        self.kill()
        super().__exit__(*raised)


def start(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Starts a process that ctrl-C ends, also where the tests ignore SIGINT, as in `nohup make test &`.

    Args:
        command: the program and its words.
        options: of `subprocess.Popen`.
    """
    return _Process(command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **options)
