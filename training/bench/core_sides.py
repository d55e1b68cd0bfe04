"""The two checkouts of `grasp bench core`, and processes in them: one living worker each, or a new one for a first solve."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grasp_env.errors import GraspError, InvalidInputError

_HERE = Path(__file__)


@dataclass(frozen=True)
class Checkout:
    """A folder that holds grasp_env and training, and the interpreter that has what they need."""

    root: Path
    python: Path

    @classmethod
    def here(cls) -> Checkout:
        """This one."""
        return cls(_HERE.parents[2], Path(sys.executable))

    @classmethod
    def at(cls, path: Path) -> Checkout:
        """Another, with a `.venv` of its own.

        Raises:
            InvalidInputError: it is not there, no checkout, or not installed.
        """
        root = path.absolute()
        python = root / ".venv/bin/python"
        for needed, what in ((root, "a folder"), (root / "training/bench", "a checkout"), (python, "installed")):
            if not needed.exists():
                mend = ": run make install there" if needed == python else ""
                raise InvalidInputError(f"baseline {path} is not {what}, there is no {needed}{mend}")
        return cls(root, python)

    def start(self, script: str, *arguments: str, stderr: Any) -> subprocess.Popen[str]:
        """A process on this benchmark's core with the root as working directory and `script`'s source as its program."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        source = _HERE.with_name(script).read_text(encoding="utf-8")
        with _pinned():
            return subprocess.Popen(
                [str(self.python), "-c", source, *arguments],
                cwd=self.root,
                env=kept,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
            )


@contextmanager
def _pinned() -> Iterator[None]:
    """Processes started meanwhile run on one core, the same every time, where the system can say so."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


class Side:
    """The living worker of a checkout, answering one request at a time; between them it waits and costs nothing.

    Attributes:
        about: its commit and versions.
    """

    def __init__(self, checkout: Checkout) -> None:
        self._checkout = checkout
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115  closed by `close`
        self._process = checkout.start("core_worker.py", stderr=self._said)
        try:
            self.about = self._read()
            if not os.path.samefile(self.about["root"], checkout.root):
                raise InvalidInputError(f"{checkout.python} imports grasp_env from elsewhere: {self.about['root']}")
        except BaseException:
            self.close()
            raise

    def ask(self, **request: Any) -> dict[str, Any]:
        """The answer to one request, see `core_worker`.

        Raises:
            GraspError: the worker ended.
        """
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the reading says why
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        return self._read()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._said.seek(0)
            raise _ended(self._checkout, self._said.read())
        return json.loads(line)

    def close(self) -> None:
        """Ends the worker."""
        self._process.kill()  # it holds nothing
        self._process.communicate()
        self._said.close()


def first_solve(checkout: Checkout, method: str) -> dict[str, Any]:
    """{"seconds" from the process's start to the force, "import_seconds" of them, "loaded"}.

    Raises:
        GraspError: the process ended otherwise.
    """
    begin = time.monotonic()  # of one clock with the child's
    with checkout.start("core_start.py", method, stderr=subprocess.PIPE) as process:
        out, said = process.communicate()
    if process.returncode:
        raise _ended(checkout, said)
    found = json.loads(out)
    if found["status"] != "OPTIMAL":
        raise GraspError(f"the first solve of {method} in {checkout.root} ended as {found['status']}")
    return {
        "seconds": found["solved"] - begin, "import_seconds": found["imported"] - begin, "loaded": found["loaded"],
    }  # fmt: skip


def _ended(checkout: Checkout, said: str) -> GraspError:
    last = (said.strip().splitlines() or ["nothing said"])[-1]
    return GraspError(f"the process in {checkout.root} ended: {last}")
