"""Third-party algorithms in a process of their own, as some files make them crash or never end."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.sim.progress import ProgressLine

try:
    import resource
except ImportError:  # not on Windows
    resource = None

# number of the signal that ends a process at its limit of processor time; 0 on Windows
_OVERTIME = int(getattr(signal, "SIGXCPU", 0))
_IDLE = 10.0  # longest time of a run over its processor time, as on a busy machine
# variables without which some Pythons do not start
_NEEDED = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "PYTHONHOME")


def apart(
    task: str,
    text: str,
    seconds: float,
    *,
    memory: int = 0,
    variables: Mapping[str, str] | None = None,
    **arrays: Array,
) -> dict[str, Array]:
    """Run a function in a process of its own; Ctrl-C ends both processes.

    Args:
        task: The function, as "module:function"; it takes and returns arrays by name.
        text: Description of the task on the progress line.
        seconds: Most processor time, of all threads together [s]. The run ends after ten times as
            long in any case. Where processor time cannot be limited, `seconds` limits the time of
            the run.
        memory: Largest memory that the function may take [bytes]; 0: any.
        variables: The environment of the process, besides what Python needs to start; None: that of
            this process.
        arrays: Arguments of the function.

    Raises:
        TimeoutError: It exceeded the time limit.
        ChildProcessError: It crashed or raised; the message is the end of its output.
    """
    paths = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    if variables is None:
        variables = os.environ
    needed = {name: os.environ[name] for name in _NEEDED if name in os.environ}
    environment = {**needed, **variables, "PYTHONPATH": paths}
    code = f"from {__name__} import work; work()"
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder, "input.npz"), **arrays)  # pyright: ignore[reportArgumentType]
        command = [sys.executable, "-c", code, task, folder, str(seconds), str(memory)]
        with open(Path(folder, "output"), "w+b") as output:
            # not in the user's folder, from which modules would be imported
            child = subprocess.Popen(
                command,
                env=environment,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
            try:
                _wait(child, text, seconds)
            finally:
                child.kill()
                child.wait()
            if _OVERTIME and child.returncode == -_OVERTIME:
                raise TimeoutError(_too_long(seconds))
            if child.returncode != 0:
                output.seek(0)
                text = output.read()[-500:].decode(errors="replace")
                raise ChildProcessError(text or f"exit code {child.returncode}")
        return _load_arrays(folder, "output.npz")


def _load_arrays(folder: str, name: str) -> dict[str, Any]:
    with np.load(Path(folder, name), allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


def _wait(child: subprocess.Popen[bytes], text: str, seconds: float) -> None:
    """Wait until the process ends, with a progress line."""
    end = time.monotonic() + _longest_run(seconds)
    with ProgressLine() as line:
        while True:
            try:
                child.wait(0.1)
                return
            except subprocess.TimeoutExpired:
                line.write(text)
            if time.monotonic() > end:
                raise TimeoutError(_too_long(seconds))


def _too_long(seconds: float) -> str:
    return f"it took more than {seconds:.3g} s"


def _longest_run(seconds: float) -> float:
    """Return the longest time of a run [s]."""
    return seconds if resource is None else _IDLE * seconds


def work() -> None:
    """Run the task in the child process.

    Ctrl-C and the limits of time and memory end it even within third-party code.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    task, folder, seconds, memory = sys.argv[1:]
    if hasattr(signal, "alarm"):  # not on Windows
        signal.alarm(int(_longest_run(float(seconds))) + 1)
    module, _, function = task.partition(":")
    run = getattr(import_module(module), function)
    arrays = _load_arrays(folder, "input.npz")
    _limit_memory(int(memory))
    _limit_time(float(seconds))
    np.savez(Path(folder, "output.npz"), **run(**arrays))


def _limit_memory(more: int) -> None:
    """Let this process take `more` memory than it has now [bytes]; 0: no limit."""
    if more == 0 or resource is None:
        return
    with suppress(ValueError, OSError):  # not on macOS
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + more
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _limit_time(more: float) -> None:
    """Let this process take `more` processor time than it has taken [s], in whole seconds."""
    if resource is None:
        return
    limit = math.ceil(time.process_time() + more)
    with suppress(ValueError, OSError):  # a lower limit holds already
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
