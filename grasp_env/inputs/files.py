"""Reading the files that users name, and writing files whole."""

from __future__ import annotations

import errno
import hashlib
import importlib.util
import io
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from grasp_env.errors import GraspError, shown

MEGABYTE = 1_000_000
TEXT = 20 * MEGABYTE
"""Largest file of numbers and names (JSON, URDF) [bytes]."""
WEIGHTS = 1000 * MEGABYTE
"""Largest file of arrays [bytes]."""
_MARK = ".grasp-"
"""Beginning of the hidden names of `replacing`."""
_IDLE = 86_400.0
"""Time without a write after which a hidden file is a leftover of a killed process [s]."""
_WITHOUT_SYNC = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)
"""Errors of file systems that cannot wait for the disk."""


def read_bytes(path: str | os.PathLike[str], most: int = TEXT) -> bytes:
    """Read a file, or a pipe such as /dev/stdin, of up to `most` bytes.

    Raises:
        OSError: missing, not readable, a folder, too large, or not a path; `strerror` says which.
    """
    try:
        with open(os.fspath(path), "rb") as file:
            chunks = list[bytes]()
            left = most + 1
            # pipes do not tell their size
            while chunk := file.read(min(left, MEGABYTE)):
                chunks.append(chunk)
                left -= len(chunk)
    except (TypeError, ValueError) as error:
        raise OSError(errno.EINVAL, f"not a path of a file ({error})", shown(path)) from None
    if left == 0:
        raise OSError(errno.EFBIG, f"it is larger than {most // MEGABYTE} MB", str(path))
    return b"".join(chunks)


def read_json(
    path: Path, error: type[GraspError], what: str, most: int = TEXT, **options: Any
) -> Any:
    """Read a JSON file in UTF-8 with the `options` of `json.loads`; see `parsed`."""

    def read(blob: bytes) -> Any:
        return json.loads(blob.decode("utf-8-sig"), **options)

    return parsed(path, read, error, f"{what} {path}", "a JSON object of this format", most=most)


_STAND_INS = {
    "Git LFS pointer": (
        re.compile(rb"version https://git-lfs\.github\.com/spec/"),
        "run `git lfs pull` in its repository, or download the file itself",
    ),
    "web page": (
        re.compile(
            rb"(?:\xef\xbb\xbf)?\s*(?:<\?xml[^>]*>\s*|<!--(?:(?!-->).)*-->\s*)*<(?:!doctype\s+html|html)\b",
            re.I | re.S,
        ),
        "it was saved in place of the file, so download the file itself (on GitHub: the button Raw)",
    ),
    "gzip archive": (re.compile(rb"\x1f\x8b\x08"), "unpack it"),
}
"""First bytes of what people have in place of a file, and the remedy."""
HEAD = 4096
"""Number of bytes in which they are looked for."""


def stand_in(blob: bytes) -> tuple[str, str]:
    """Return what a user has in place of a file, such as "web page", and the remedy, or "" twice.

    Example:
        >>> stand_in(b"<!DOCTYPE html>")[0], stand_in(b"<robot/>")[0]
        ('web page', '')
    """
    for name, (pattern, remedy) in _STAND_INS.items():
        if pattern.match(blob[:HEAD]):
            return name, remedy
    return "", ""


def parsed(
    path: str | os.PathLike[str],
    read: Callable[[bytes], Any],
    error: type[GraspError],
    name: str,
    form: str,
    hint: str = "",
    most: int = TEXT,
) -> Any:
    """Return `read(bytes of a file)`; any failure but a `GraspError` becomes an `error`.

    Its message has the file's `name`, the expected `form` and the remedy, `hint`.
    """
    try:
        blob = read_bytes(path, most)
    except OSError as problem:
        raise error(f"cannot read {name}: {problem.strerror}; check the path") from problem
    return understood(blob, read, error, name, form, hint)


def understood(
    blob: Any,
    read: Callable[[Any], Any],
    error: type[GraspError],
    name: str,
    form: str,
    hint: str = "",
) -> Any:
    """Return `read(blob)` with the errors of `parsed`."""
    other, remedy = stand_in(blob) if isinstance(blob, bytes) else ("", "")
    if other:
        raise error(f"{name} is a {other}: {remedy}")
    try:
        return read(blob)
    except GraspError:
        raise
    except Exception as problem:  # each format's reader has its own
        raise error(f"{name} is not {form}: {str(problem).strip()[:300]}{hint}") from problem


def unpacked(blob: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz; a ValueError if it holds objects."""
    with np.lib.npyio.NpzFile(io.BytesIO(blob)) as file:
        return {name: file[name] for name in file.files}


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a hidden name beside `path`; what is written there becomes `path` after the block.

    Readers find the old content or the new one, never a part, also after an interrupt or a power
    cut. Of several writers of a file at the same time the last one stays; a folder has one writer.
    The hidden name ends like `path`. If the block raises, it is removed. What a killed process
    leaves is removed by a later writer in the folder, a day after the last write.

    A device or a pipe, such as /dev/stdout, is written to directly. A symbolic link stays, and its
    target is replaced.

    Raises:
        OSError: the file cannot be written; its `filename` is `path`, not the hidden name.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    hidden = _hidden(target)
    try:
        for left in target.parent.glob(f"{_MARK}*"):
            with suppress(OSError):  # another writer removes it, too
                if time.time() - left.lstat().st_mtime > _IDLE:
                    _remove(left)
        yield hidden
        _sync(hidden)
        _rename(hidden, target)
    except OSError as error:
        if error.errno is not None and (
            error.filename is None or str(error.filename).startswith(str(hidden))
        ):
            error.filename = str(path)
            error.filename2 = None
        raise
    finally:
        _remove(hidden)


def _hidden(target: Path) -> Path:
    # names have at most 255 bytes
    return target.with_name(f"{_MARK}{os.urandom(4).hex()}.{target.name[-50:]}")


def _sync(path: Path) -> None:
    """Wait until a file, or a folder with its contents, is on the disk."""
    for entry in (*path.rglob("*"), path):
        _sync_entry(entry)


def _sync_entry(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _WITHOUT_SYNC:
            raise
    finally:
        os.close(handle)


def _rename(hidden: Path, target: Path) -> None:
    aside = _hidden(target)
    if hidden.is_dir() and target.is_dir():
        os.replace(target, aside)
    os.replace(hidden, target)
    _remove(aside)
    with suppress(OSError):
        _sync_entry(target.parent)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with suppress(OSError):
        path.unlink(missing_ok=True)


def file_fault(error: OSError, place: str = "path") -> str:
    """Return why a file cannot be read or written, and the remedy: another `place`.

    Example:
        >>> file_fault(OSError(28, "No space left on device"), "--out"), file_fault(OSError("the encoder failed"))
        ('No space left on device; free some space or choose another --out', 'the encoder failed;
        choose another path')
    """
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{os.strerror(error.errno)}; free some space or choose another {place}"
    return f"{error.strerror or error}; choose another {place}"


def digest(*parts: bytes) -> str:
    """Return the sha256 of the joined bytes in hexadecimal."""
    return hashlib.sha256(b"".join(parts)).hexdigest()


def as_path(path: Any, error: type[GraspError], what: str) -> Path:
    """Return a path from text or `pathlib`, or raise `error`."""
    if not isinstance(path, str | os.PathLike) or not os.fspath(path):
        raise error(f"{what} must be a path, got {shown(path)}")
    return Path(path)


def import_file(file: str | Path, name: str) -> ModuleType:
    """Import a Python file as the module `name`."""
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    # dataclasses look up their module there
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
