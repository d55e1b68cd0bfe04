"""Other people's algorithms in a process of their own: some meshes make them crash, or run for ever."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.progress import Line


def apart(task: str, text: str, seconds: float, **given: Array) -> dict[str, Array]:
    """The arrays that a function returns in a process of its own; Ctrl-C ends both.

    Args:
        task: Its name, module:function; it takes arrays by name and returns a dict of arrays.
        text: What is done, for the line on a terminal.
        seconds: That it may take.
        given: The arrays that it takes.

    Raises:
        TimeoutError: It took longer.
        ChildProcessError: It crashed or raised; the message is the end of what it said.
    """
    paths = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder, "given.npz"), allow_pickle=False, **given)
        command = [sys.executable, "-c", f"from {__name__} import work; work()", task, folder, str(seconds)]
        with open(Path(folder, "said"), "w+b") as said:
            child = subprocess.Popen(
                command,
                env={**os.environ, "PYTHONPATH": paths},
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
            )  # not in the user's folder, whose files would be imported
            try:
                _wait(child, text, seconds)
            finally:
                if child.poll() is None:
                    child.kill()
                    child.wait()
            if child.returncode != 0:
                said.seek(0)
                raise ChildProcessError(said.read()[-500:].decode(errors="replace") or f"exit code {child.returncode}")
        with np.load(Path(folder, "made.npz"), allow_pickle=False) as made:
            return {name: made[name] for name in made.files}


def _wait(child: subprocess.Popen[bytes], text: str, seconds: float) -> None:
    """Until it ends, with a line on a terminal that counts its seconds."""
    end = time.monotonic() + seconds
    with Line() as line:
        while True:
            try:
                child.wait(0.1)
                return
            except subprocess.TimeoutExpired:
                line.write(text)
            if time.monotonic() > end:
                raise TimeoutError(f"it took more than {seconds:.0f} s")


def work() -> None:
    """Runs the task in the child process; Ctrl-C and the clock end it even within other people's code."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    (module, _, function), folder = sys.argv[1].partition(":"), Path(sys.argv[2])
    if hasattr(signal, "alarm"):  # not on Windows
        signal.alarm(int(float(sys.argv[3])) + 1)
    with np.load(folder / "given.npz", allow_pickle=False) as given:
        arrays: dict[str, Any] = getattr(import_module(module), function)(**{name: given[name] for name in given.files})
    np.savez(folder / "made.npz", allow_pickle=False, **arrays)
