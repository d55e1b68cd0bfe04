"""A cache of processed meshes, of objects and of hands, in the user's cache folder, keyed by content and safe between processes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from grasp_env._files import WEIGHTS as MOST_BYTES
from grasp_env._files import read_bytes, replacing, unpacked

LONGEST_WAIT = 150.0
"""[s] that a process waits for another that makes the same entry, before it makes the entry itself."""
_NAME, _USE = "name", "use"  # of an entry, among its arrays
_ENTRIES = "[!.]*.npz"  # not those that another process is writing

try:
    import fcntl
except ImportError:  # not on Windows: two processes may make the same entry, and the later one stays
    fcntl = None


class Entry(NamedTuple):
    """An entry of the cache: its file, its mesh's name and use ("object" or "hand"), its size in bytes, and when it was made [s]."""

    path: Path
    name: str
    use: str
    size: int
    time: float


def folder() -> Path:
    """The cache folder."""
    from platformdirs import user_cache_path

    return user_cache_path("grasp-force", appauthor=False) / "objects"


def kept(
    key: str, name: str, arrays: Set[str], make: Callable[[], dict[str, Any]], use: str = "object"
) -> dict[str, Any]:
    """The arrays that `make` returns: from the cache, or made and kept there.

    A folder that cannot be written, and an entry that cannot be read, only cost time.

    Args:
        key: Of the content, letters and digits.
        name: Of the mesh, for the list of entries.
        arrays: Names of all that `make` returns; an entry without one of them is made anew.
        make: Makes the arrays.
        use: What the mesh is, for the list of entries: "object" or "hand".
    """
    path = folder() / f"{key}.npz"
    if (found := _read(path)).keys() >= arrays:
        return found
    with _alone(path):
        if (found := _read(path)).keys() >= arrays:  # made by the process that was waited for
            return found
        made = make()
        with suppress(OSError), replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **made, **{_NAME: np.array(name), _USE: np.array(use)})
    return made


def entries() -> list[Entry]:
    """The entries of the cache, the newest first."""
    out: list[Entry] = []
    for path in folder().glob(_ENTRIES):
        with suppress(OSError):
            status, name, use = path.stat(), "(not readable)", "object"
            with suppress(Exception), open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
                name = str(arrays[_NAME])
                use = str(arrays[_USE]) if _USE in arrays else use  # entries of earlier versions do not say
            out.append(Entry(path, name, use, status.st_size, status.st_mtime))
    return sorted(out, key=lambda entry: -entry.time)


def clear() -> int:
    """Removes all that is kept; the number of meshes."""
    count = 0
    for path in [*folder().glob(_ENTRIES), *folder().glob("*.lock")]:
        with suppress(OSError):
            path.unlink()
            count += path.suffix == ".npz"
    return count


def _read(path: Path) -> dict[str, Any]:
    try:
        return unpacked(read_bytes(path, MOST_BYTES), MOST_BYTES)
    except Exception:  # not there, cut short, or somebody else's
        return {}


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """No other process makes the entry meanwhile, unless that takes too long."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path.with_suffix(".lock"), os.O_CREAT | os.O_RDWR | getattr(os, "O_CLOEXEC", 0), 0o600)
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
            except OSError:  # a file system without locks
                break
        yield
    finally:
        os.close(handle)
