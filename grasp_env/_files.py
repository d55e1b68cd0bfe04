"""How a file that a user names is read (regular files and pipes only, up to a size, never waiting for ever) and written whole."""

from __future__ import annotations

import codecs
import hashlib
import io
import json
import math
import os
import select
import stat
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NoReturn
from xml.etree.ElementTree import Element, TreeBuilder, XMLParser

import numpy as np

from grasp_env._check import as_text, is_a
from grasp_env.errors import GraspError, shown

MEGABYTE = 1_000_000
TEXT = 20 * MEGABYTE
"""Most bytes of a file of numbers and names: JSON, URDF."""
WEIGHTS = 1000 * MEGABYTE
"""Most bytes of a file of arrays."""
PATIENCE = 10.0
"""[s] without a byte from a pipe, after which it counts as silent."""
LONGEST = 60.0
"""[s] that a pipe may take in all."""
_BLOCK = 1 << 16
_MOST_TAGS = 600_000  # and attributes of an XML file: 1 s, 200 MB


def read_bytes(path: str | os.PathLike[str], most: int = TEXT) -> bytes:
    """The bytes of a regular file, or of a pipe such as /dev/stdin.

    Args:
        path: of the file.
        most: bytes it may have.

    Raises:
        OSError: missing, not readable, a folder, a device, a silent pipe, larger than `most`, or no path; `strerror` says which.

    Example:
        >>> read_bytes("/dev/zero")
        Traceback (most recent call last):
        OSError: [Errno 22] it is a device, not a file: '/dev/zero'
    """
    try:
        name = os.fspath(path)
        handle = os.open(
            name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
        )  # opening a pipe must not wait for its writer
    except OSError:
        raise
    except Exception as error:  # no path, or one with a zero in it, or of somebody else's
        raise OSError(22, f"no path of a file ({error})", shown(path)) from None
    try:
        kind = os.fstat(handle)
        if stat.S_ISREG(kind.st_mode):
            # its size may be a lie, as under /proc: no more than `most` is read either way
            blob = b"" if kind.st_size > most else _read(handle, most, None)
        elif stat.S_ISFIFO(kind.st_mode):
            blob = _read(handle, most, select.poll())
        else:
            what = "a folder" if stat.S_ISDIR(kind.st_mode) else "a device"
            raise OSError(22, f"it is {what}, not a file", str(name))
    except TimeoutError as error:
        raise OSError(error.errno, error.strerror, str(name)) from None
    finally:
        os.close(handle)
    if max(len(blob), kind.st_size) > most:
        raise OSError(27, f"it is larger than {most // MEGABYTE} MB", str(name))
    return blob


def read_json(
    path: str | os.PathLike[str], error: type[GraspError], what: str, most: int = TEXT, **options: Any
) -> Any:
    """What a JSON file holds, in UTF-8 with or without a mark.

    Args:
        path: of the file.
        error: raised for whatever is wrong with it.
        what: the file is, for the message.
        most: bytes it may have.
        options: of `json.loads`.
    """

    def read(blob: bytes) -> Any:
        return json.loads(blob.decode("utf-8-sig"), **options)

    return parsed(path, read, error, f"{what} {shown_path(path)}", "a JSON object of this format", most=most)


class _Builder(TreeBuilder):
    """A tree of XML without entities of its own: a few lines of them can mean gigabytes."""

    def doctype(self, *_: Any) -> NoReturn:
        raise ValueError("it holds a DOCTYPE; leave it out")


def read_xml(blob: bytes) -> Element:
    """The first element of an XML file; comments before its declaration are left out.

    Raises:
        ValueError: it holds a DOCTYPE, or so many elements and attributes that they take seconds and gigabytes.
        ParseError: it is not XML.
    """
    if blob.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        blob = blob.decode("utf-16").encode()
    if (tags := blob.count(b"<") + blob.count(b"=")) > _MOST_TAGS:
        raise ValueError(f"it has {tags} tags and attributes, allowed are up to {_MOST_TAGS}")
    try:
        blob.decode()
        encoding = "utf-8"
    except UnicodeDecodeError:  # of names and comments only
        encoding = "iso-8859-1"
    # given here: in one that the file names "<" may be another byte, and is not counted
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
    """`read` of a file's bytes; whatever is wrong with file or content becomes an `error`.

    Args:
        path: of the file.
        read: what its bytes mean; what it raises becomes the `error`, its own errors of the project stay.
        error: raised.
        name: of the file, for the message.
        form: what the file has to be, for the message.
        hint: what to do where it is not.
        most: bytes it may have.
    """
    try:
        blob = read_bytes(path, most)
    except OSError as problem:
        raise error(f"cannot read {name}: {problem.strerror}; check the path") from problem
    return understood(blob, read, error, name, form, hint)


def understood(
    blob: bytes, read: Callable[[bytes], Any], error: type[GraspError], name: str, form: str, hint: str = ""
) -> Any:
    """`read` of bytes; the same of bytes that are read already."""
    try:
        return read(blob)
    except GraspError:
        raise
    except Exception as problem:  # every format's reader has its own, and nesting its own too
        said = "nested too deep" if isinstance(problem, RecursionError) else str(problem)[:300]
        raise error(f"{name} is not {form}: {said}{hint}") from problem


def unpacked(blob: bytes, most: int = WEIGHTS) -> dict[str, np.ndarray]:
    """The arrays of an .npz, of numbers and text only.

    Raises:
        ValueError: it holds objects, or more than `most` bytes once it is unpacked, or claims to.
    """
    with zipfile.ZipFile(io.BytesIO(blob)) as packed:
        if sum(entry.file_size for entry in packed.infolist()) > most:
            raise ValueError(f"its arrays have more than {most // MEGABYTE} MB")
        for entry in packed.infolist():  # what an entry says of its size it cannot exceed
            with packed.open(entry) as file:
                _check_length(file, entry)
    with np.load(io.BytesIO(blob), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _check_length(file: IO[bytes], entry: zipfile.ZipInfo) -> None:
    """Raises ValueError if an array's header claims more bytes than its entry has: numpy allocates them before it reads."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(
            f"its entry {entry.filename[:50]!r} is of version {version} of the format, read are 1.0 and 2.0"
        )
    shape, _, kind = read(file)
    claimed = math.prod(shape) * kind.itemsize
    if not kind.hasobject and claimed > entry.file_size:
        raise ValueError(f"its array {entry.filename[:50]!r} claims {claimed} bytes of {entry.file_size}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A hidden name beside `path` to write to: it becomes `path` where the block ends, and is removed where the block raises."""
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def digest(*parts: bytes) -> str:
    """The sha256 of bytes, one after another, in hexadecimal.

    Example:
        >>> digest(b"gra", b"sp") == digest(b"grasp")
        True
    """
    made = hashlib.sha256()
    for part in parts:
        made.update(part)
    return made.hexdigest()


def as_path(path: Any, error: type[GraspError], what: str) -> Path:
    """A path of text or of `pathlib`, or `error`."""
    try:
        text = as_text(os.fspath(path))
    except Exception:  # no path, or one of somebody else's
        text = None
    if not text or "\0" in text:
        raise error(f"{what} must be a path, got {shown(path)}")
    return Path(text)


def shown_path(path: object) -> str:
    """A path for a message."""
    return str(path) if is_a(path, Path) or type(path) is str else shown(path)


def _read(handle: int, most: int, poll: select.poll | None) -> bytes:
    """Up to `most` + 1 bytes; from a pipe with patience."""
    parts, size, end = list[bytes](), 0, time.monotonic() + LONGEST
    if poll is not None:
        poll.register(handle, select.POLLIN)
    while size <= most:
        try:
            part = os.read(handle, min(_BLOCK, most + 1 - size))
        except BlockingIOError:
            left = min(PATIENCE, end - time.monotonic())
            if poll is None or left <= 0.0 or not poll.poll(1e3 * left):
                raise TimeoutError(110, "nothing comes out of this pipe") from None
            continue
        if not part:
            break
        parts.append(part)
        size += len(part)
    return b"".join(parts)
