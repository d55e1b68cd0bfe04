"""Reading the files that users name, with limits on size and time, and writing files whole."""

from __future__ import annotations

import codecs
import hashlib
import io
import json
import os
import select
import stat
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, TypeVar
from xml.etree.ElementTree import Element, TreeBuilder, XMLParser

import numpy as np

from grasp_env._check import as_text
from grasp_env.errors import GraspError, shown

MEGABYTE = 1_000_000
TEXT = 20 * MEGABYTE
"""Largest file of numbers and names (JSON, URDF) [bytes]."""
WEIGHTS = 1000 * MEGABYTE
"""Largest file of arrays [bytes]."""
PATIENCE = 10.0
"""Time without a byte after which a pipe counts as silent [s]."""
LONGEST = 60.0
"""Longest time for reading a pipe [s]."""
_BLOCK = 1 << 16
T = TypeVar("T")


def read_bytes(path: str | os.PathLike[str], most: int = TEXT) -> bytes:
    """Read a regular file, or a pipe such as /dev/stdin, of up to `most` bytes.

    Raises:
        OSError: missing, not readable, a folder, a device, a silent pipe, larger than `most`, or no path; `strerror` tells which.
    """
    try:
        name = os.fspath(path)
        # opening a pipe must not wait for its writer
        file = open(name, "rb", buffering=0, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except IsADirectoryError:
        raise OSError(21, "it is a folder, not a file", str(path)) from None
    except (TypeError, ValueError) as error:  # no path, or one with a zero in it
        raise OSError(22, f"no path of a file ({error})", shown(path)) from None
    with file:
        kind = os.fstat(file.fileno())
        if not stat.S_ISREG(kind.st_mode) and not stat.S_ISFIFO(kind.st_mode):
            raise OSError(22, "it is a device, not a file", str(name))
        blob, end, poll = bytearray(), time.monotonic() + LONGEST, select.poll()
        poll.register(file, select.POLLIN)
        # files under /proc give a wrong size: no more than `most` is read either way
        while max(len(blob), kind.st_size) <= most:
            part = file.read(min(_BLOCK, most + 1 - len(blob)))
            left = max(0.0, min(PATIENCE, end - time.monotonic()))
            if part is None and not poll.poll(1e3 * left):
                raise OSError(110, "nothing comes out of this pipe", str(name))
            if part == b"":
                return bytes(blob)
            blob += part or b""
    raise OSError(27, f"it is larger than {most // MEGABYTE} MB", str(name))


def read_json(
    path: str | os.PathLike[str], error: type[GraspError], what: str, most: int = TEXT, **options: Any
) -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark; see `parsed`.

    Args:
        path, error, most: as in `parsed`.
        what: kind of file, for the message.
        options: of `json.loads`.
    """

    def read(blob: bytes) -> Any:
        return json.loads(blob.decode("utf-8-sig"), **options)

    return parsed(path, read, error, f"{what} {shown_path(path)}", "a JSON object of this format", most=most)


class _Builder(TreeBuilder):
    """Tree of an XML file without entities of its own, a few lines of which can expand to gigabytes."""

    def doctype(self, *_: Any) -> NoReturn:
        raise ValueError("it holds a DOCTYPE; leave it out")


def read_xml(blob: bytes) -> Element:
    """Return the first element of an XML file without a DOCTYPE; comments before its declaration are skipped."""
    if blob.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        blob = blob.decode("utf-16").encode()
    try:
        blob.decode()
        encoding = "utf-8"
    except UnicodeDecodeError:  # only names and comments have such letters
        encoding = "iso-8859-1"
    parser = XMLParser(target=_Builder(), encoding=encoding)
    parser.feed(blob[max(0, blob.find(b"<?xml")) :] if blob.lstrip().startswith((b"<?xml", b"<!--")) else blob)
    return parser.close()


def parsed(
    path: str | os.PathLike[str],
    read: Callable[[bytes], Any],
    error: type[GraspError],
    name: str,
    form: str,
    hint: str = "",
    most: int = TEXT,
) -> Any:
    """Return `read(bytes of a file)`; any failure becomes an `error`.

    Args:
        path: of the file, of up to `most` bytes.
        read: parses the bytes; its errors of this project stay as they are.
        error: class of the error.
        name, form, hint: of the file, its expected content, and the remedy, for the message.
    """
    try:
        blob = read_bytes(path, most)
    except OSError as problem:
        raise error(f"cannot read {name}: {problem.strerror}; check the path") from problem
    return understood(blob, read, error, name, form, hint)


def understood(
    content: T, read: Callable[[T], Any], error: type[GraspError], name: str, form: str, hint: str = ""
) -> Any:
    """Return `read(content)` with the errors of `parsed`."""
    try:
        return read(content)
    except GraspError:
        raise
    except Exception as problem:  # each format's reader has its own
        said = "nested too deep" if isinstance(problem, RecursionError) else str(problem)[:300]
        raise error(f"{name} is not {form}: {said}{hint}") from problem


def unpacked(blob: bytes, most: int = WEIGHTS) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz; a ValueError if it holds objects, or more than `most` bytes once unpacked."""
    with zipfile.ZipFile(io.BytesIO(blob)) as packed:
        if sum(entry.file_size for entry in packed.infolist()) > most:
            raise ValueError(f"its arrays have more than {most // MEGABYTE} MB")
    with np.load(io.BytesIO(blob), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a hidden name beside `path` to write to, which becomes `path` at the end of the block and is removed if the block raises."""
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def digest(*parts: bytes) -> str:
    """Return the sha256 of the joined bytes in hexadecimal."""
    return hashlib.sha256(b"".join(parts)).hexdigest()


def as_path(path: Any, error: type[GraspError], what: str) -> Path:
    """Return a path given as text or `pathlib`, or raise `error`."""
    try:
        text = as_text(os.fspath(path))
    except TypeError:
        text = None
    if not text or "\0" in text:
        raise error(f"{what} must be a path, got {shown(path)}")
    return Path(text)


def shown_path(path: object) -> str:
    """Return a path as text for a message."""
    return str(path) if isinstance(path, Path | str) else shown(path)
