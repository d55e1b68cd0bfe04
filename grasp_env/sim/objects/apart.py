"""Third-party algorithms in a process of their own, as some meshes make them crash or never end."""

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
from grasp_env.sim.progress import ProgressLine


def apart(task: str, text: str, seconds: float, **given: Array) -> dict[str, Array]:
    """Run a function (module:function), which takes and returns arrays by name, in a process of its own; Ctrl-C ends both processes.

    The text describes the task on the progress line.

    Raises:
        TimeoutError: It exceeded the time limit.
        ChildProcessError: It crashed or raised; the message is the end of its output.
    """
    paths = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    environment = {**os.environ, "PYTHONPATH": paths}
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder, "given.npz"), allow_pickle=False, **given)
        command = [sys.executable, "-c", f"from {__name__} import work; work()", task, folder, str(seconds)]
        with open(Path(folder, "output"), "w+b") as output:
            # not in the user's folder, from which modules would be imported
            child = subprocess.Popen(
                command, env=environment, cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )
            try:
                _wait(child, text, seconds)
            finally:
                child.kill()
                child.wait()
            if child.returncode != 0:
                output.seek(0)
                said = output.read()[-500:].decode(errors="replace")
                raise ChildProcessError(said or f"exit code {child.returncode}")
        with np.load(Path(folder, "made.npz"), allow_pickle=False) as made:
            return {name: made[name] for name in made.files}


def _wait(child: subprocess.Popen[bytes], text: str, seconds: float) -> None:
    """Wait until it ends, with a progress line."""
    end = time.monotonic() + seconds
    with ProgressLine() as line:
        while True:
            try:
                child.wait(0.1)
                return
            except subprocess.TimeoutExpired:
                line.write(text)
            if time.monotonic() > end:
                raise TimeoutError(f"it took more than {seconds:.0f} s")


def work() -> None:
    """Run the task in the child process; Ctrl-C and the time limit end it even within third-party code."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    (module, _, function), folder = sys.argv[1].partition(":"), Path(sys.argv[2])
    if hasattr(signal, "alarm"):  # not on Windows
        signal.alarm(int(float(sys.argv[3])) + 1)
    with np.load(folder / "given.npz", allow_pickle=False) as given:
        arrays: dict[str, Any] = getattr(import_module(module), function)(**{name: given[name] for name in given.files})
    np.savez(folder / "made.npz", allow_pickle=False, **arrays)
