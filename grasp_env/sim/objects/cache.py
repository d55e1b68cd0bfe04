"""Cache of meshes and grasps in the user's cache folder, keyed by content, safe for processes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from grasp_env.inputs.files import replacing, unpacked

LONGEST_WAIT = 150.0  # longest wait for another process that makes the same entry [s]
_ENTRIES = "[!.]*.npz"  # not the temporary files that other processes are writing

try:
    import fcntl
except ImportError:  # not on Windows: two processes may make the same entry, and the later stays
    fcntl = None


class Entry(NamedTuple):
    """An entry of the cache."""

    path: Path
    name: str  # of the mesh, or what holds what
    use: str  # "object", "hand" or "grasp"
    size: int  # [bytes]
    time: float  # of creation [s]


def folder() -> Path:
    """Return the cache folder."""
    from platformdirs import user_cache_path

    return user_cache_path("grasp-force", appauthor=False) / "objects"


def cached(
    key: str,
    name: str,
    make: Callable[[], dict[str, Any]],
    use: str = "object",
    keep: Callable[[dict[str, Any]], bool] = lambda _: True,
) -> dict[str, Any]:
    """Return the arrays that `make` returns, from the cache if it has them.

    The key, of letters and digits, identifies the content. Name and use ("object", "hand" or
    "grasp") are for the list of entries. `keep` decides if what was made is kept. A folder that
    cannot be written or an entry that cannot be read only costs time.
    """
    if arrays := lookup(key):
        return arrays
    path = folder() / f"{key}.npz"
    with _locked(path):
        if arrays := lookup(key):  # made by the process that was waited for
            return arrays
        arrays = make()
        if not keep(arrays):
            return arrays
        with suppress(OSError), replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **{**arrays, "name": np.array(name), "use": np.array(use)})
    return arrays


def entries() -> list[Entry]:
    """Return the entries of the cache, newest first."""
    out = list[Entry]()
    for path in folder().glob(_ENTRIES):
        with suppress(OSError):
            status = path.stat()
            name = "(not readable)"
            use = "object"
            with (
                suppress(Exception),
                open(path, "rb") as file,
                np.load(file, allow_pickle=False) as arrays,
            ):
                name = str(arrays["name"])
                use = str(arrays["use"])
            out.append(Entry(path, name, use, status.st_size, status.st_mtime))
    return sorted(out, key=lambda entry: -entry.time)


def clear() -> int:
    """Remove all entries; return their number."""
    count = 0
    for path in [*folder().glob(_ENTRIES), *folder().glob("*.lock")]:
        with suppress(OSError):
            path.unlink()
            count += path.suffix == ".npz"
    return count


def lookup(key: str) -> dict[str, Any]:
    """Return the arrays of an entry; {} if there is none that can be read."""
    try:
        return unpacked((folder() / f"{key}.npz").read_bytes())
    except Exception:  # missing, cut short or not one of ours
        return {}


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keep other processes from making the entry, for at most `LONGEST_WAIT`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(
            path.with_suffix(".lock"), os.O_CREAT | os.O_RDWR | getattr(os, "O_CLOEXEC", 0), 0o600
        )
    except OSError:
        yield
        return
    try:
        end = time.monotonic() + LONGEST_WAIT
        while fcntl is not None and time.monotonic() < end:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.05)
            except OSError:  # the file system has no locks
                break
        yield
    finally:
        os.close(handle)
