"""Run folders: outputs of a command, with all that is needed to repeat it."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grasp_env.errors import GraspError, InvalidInputError
from grasp_env.inputs.arguments import AllFaults, whole
from grasp_env.inputs.files import file_fault, read_json, replacing

if TYPE_CHECKING:
    from training.evaluation.results.table import pd

ROWS = "rows.csv.xz"
"""Table of a run; pandas reads it as it is, and `xz -dk` unpacks it."""
MAX_COUNT = 1_000_000_000
"""Largest count in a setting."""
_PACKAGES = [
    "numpy",
    "scipy",
    "pandas",
    "torch",
    "gymnasium",
    "stable-baselines3",
    "pybullet",
    "mujoco",
    "ray",
    "clarabel",
    "qoco",
    "qocogen",
    "moreau",
    "ecos",
    "highspy",
    "piqp",
    "cvxpy",
]


class Run:
    """Folder `<out>/<name>` of outputs; a file gets its name only when it is complete."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def create(cls, out: str | Path, name: str) -> Run:
        """Make the folder and check, before any work, that it can be written.

        Raises:
            InvalidInputError: the folder cannot be made or written, or holds a finished run.
        """
        folder = Path(out) / name
        if (folder / "run.json").exists():
            raise InvalidInputError(
                f"{folder} holds a finished run: choose another name or remove it"
            )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / f".probe-{os.getpid()}"
            probe.write_bytes(b"")
            probe.unlink()
        except OSError as error:
            fault = file_fault(error, "--out")
            raise InvalidInputError(f"cannot write to {folder}: {fault}") from None
        return cls(folder)

    @classmethod
    def open(cls, folder: str | Path) -> Run:
        """Open a finished run.

        Raises:
            InvalidInputError: there is no such run.
        """
        folder = Path(folder)
        if not os.path.isfile(folder / "run.json"):
            raise InvalidInputError(
                f"{folder} is not a finished run: run.json is missing; run `grasp evaluate` first"
            )
        return cls(folder)

    @property
    def shards(self) -> Path:
        """Folder that keeps finished shards until all are."""
        return self.folder / "shards"

    def path(self, name: str) -> Path:
        """Return the path of a file of this run, and make its folder."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_text(self, name: str, text: str) -> Path:
        """Write a text file; an interrupted write leaves no partial file."""
        path = self.path(name)
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return path

    def write_json(self, name: str, value: Any) -> Path:
        """Write JSON; raise ValueError for NaN and infinity."""
        text = json.dumps(value, indent=2, allow_nan=False, default=_plain)
        return self.write_text(name, f"{text}\n")

    def read_json(self, name: str) -> Any:
        """Read JSON; raise `InvalidInputError` if the file is not JSON."""
        return read_json(self.path(name), InvalidInputError, "the run's file")

    def save(self, rows: pd.DataFrame, about: dict[str, Any]) -> None:
        """Write `ROWS`, then run.json, which marks the run as finished; remove the shards.

        To `about`, its kind and settings, machine, versions, commit and the meaning of the columns
        are added.
        """
        from training.evaluation.results import table  # importing this module needs no pandas

        table.write(self.path(ROWS), rows)
        facts = {"rows": len(rows), "columns": table.described(rows.columns)}
        self.write_json("run.json", {**about, **provenance(), **facts})
        shutil.rmtree(self.shards, ignore_errors=True)

    def load(self) -> tuple[pd.DataFrame, dict[str, Any]]:
        """Return the rows and the content of run.json.

        Raises:
            InvalidInputError: a file is missing or damaged.
        """
        from training.evaluation.results import table

        path = self.path(ROWS)
        rows = table.read(path)
        about = self.read_json("run.json")
        if len(rows) != (saved := about.get("rows", len(rows))):
            raise InvalidInputError(
                f"{path} has {len(rows)} of {saved} rows: copy the run again, or repeat it"
            )
        return rows, about

    def begin(self, plan: dict[str, Any]) -> None:
        """Save the settings in plan.json, or check that an interrupted run began with the same.

        Raises:
            InvalidInputError: it was begun with other settings.
        """
        if not self.path("plan.json").is_file():
            self.write_json("plan.json", plan)
            return
        before = self.read_json("plan.json")
        now = json.loads(json.dumps(plan, default=_plain))
        if before != now:
            other = [key for key in {**before, **now} if before.get(key) != now.get(key)]
            raise InvalidInputError(
                f"{self.folder} was begun with other settings ({', '.join(other)}): repeat its command to continue it, or choose "
                "another --name"
            )


@contextmanager
def understood(folder: Path, again: str = "repeat the command that made it") -> Iterator[None]:
    """Report any error in the block as files that were changed or made by another version.

    `again` is advice how to make such files again.

    Raises:
        InvalidInputError: any error other than the project's own, which pass through.
    """
    try:
        yield
    except GraspError:
        raise
    except Exception as error:
        raise InvalidInputError(
            f"{folder} lacks what is needed of it ({type(error).__name__}: {str(error)[:200]}): its files were changed, or another "
            f"version made them; {again}"
        ) from error


def check_counts(config: Any, least: dict[str, int]) -> None:
    """Check that settings of a record are integers between their least values and `MAX_COUNT`.

    Raises:
        InvalidInputError: it names every setting that is not.
    """
    with AllFaults() as check:
        for name, low in least.items():
            check(whole, getattr(config, name), name, low, MAX_COUNT)


def default_name(kind: str) -> str:
    """Return `<kind>-<date>-<time>`."""
    return f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}"


def provenance() -> dict[str, Any]:
    """Return machine, versions, commit and command of this process."""
    program = Path(sys.argv[0])
    spec = sys.modules["__main__"].__spec__
    name = f"python -m {spec.parent}" if spec and program.name == "__main__.py" else program.name
    return {
        "command": " ".join([name, *sys.argv[1:]]),
        "time": time.strftime("%Y-%m-%d %H:%M:%S %Z"),
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "system": f"{platform.system()} {platform.release()}",
            "python": platform.python_version(),
        },
        "versions": {name: _version(name) for name in _PACKAGES},
        "commit": commit(Path(__file__).parent),
    }


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def commit(folder: Path) -> str:
    """Return the commit of a checkout, with `-dirty` if files differ from it."""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=10)
        return run.stdout.strip() or "unknown"
    except (OSError, subprocess.SubprocessError):
        return "unknown"
