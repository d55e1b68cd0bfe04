"""Reading the files that users name, with limits on size and time, and writing files whole."""

from __future__ import annotations

import codecs
import errno
import hashlib
import io
import json
import os
import re
import select
import shutil
import stat
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
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
_IDLE = 86_400.0
"""Time without a write after which a hidden file of an unknown process is a leftover [s]."""
_NAME_BYTES = 200
"""Length up to which the end of a name is repeated in its hidden name; file systems allow 255 in all [bytes]."""
_UNKNOWN = "0" * 8
_HIDDEN = re.compile(r"\.(?P<place>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{8}\.(?P<end>.+)", re.DOTALL)
"""Hidden names of `replacing`: where its process numbers count, the process, a random part, and the end of the name."""
_WITHOUT_SYNC = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)
"""Errors of file systems that cannot wait for the disk."""
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


_STAND_INS = {
    "Git LFS pointer": (
        re.compile(rb"version https://git-lfs\.github\.com/spec/"),
        "run `git lfs pull` in its repository, or download the file itself",
    ),
    "web page": (
        re.compile(rb"(?:\xef\xbb\xbf)?\s*(?:<\?xml[^>]*>\s*|<!--(?:(?!-->).)*-->\s*)*<(?:!doctype\s+html|html)\b", re.I | re.S),
        "it was saved in place of the file, so download the file itself (on GitHub: the button Raw)",
    ),
    "gzip archive": (re.compile(rb"\x1f\x8b\x08"), "unpack it"),
}  # fmt: skip
"""First bytes of what people have in place of a file, and the remedy."""
HEAD = 4096
"""Number of bytes in which they are looked for."""


def stand_in(blob: bytes) -> tuple[str, str]:
    """Return what a user has in place of a file, such as "web page", and the remedy; "" and "" if it may be the file itself.

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
    other, remedy = stand_in(content) if isinstance(content, bytes) else ("", "")
    if other:
        raise error(f"{name} is a {other}: {remedy}")
    try:
        return read(content)
    except GraspError:
        raise
    except Exception as problem:  # each format's reader has its own
        said = "nested too deep" if isinstance(problem, RecursionError) else str(problem).strip()[:300]
        raise error(f"{name} is not {form}: {said}{hint}") from problem


def unpacked(blob: bytes, most: int = WEIGHTS) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz; a ValueError if it holds objects, or more than `most` bytes once unpacked."""
    with zipfile.ZipFile(io.BytesIO(blob)) as packed:
        if sum(entry.file_size for entry in packed.infolist()) > most:
            raise ValueError(f"its arrays have more than {most // MEGABYTE} MB")
    with np.load(io.BytesIO(blob), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@contextmanager
def replacing(path: Path, siblings: str = "") -> Iterator[Path]:
    """Give a hidden name beside `path` to write a file or a folder to, which becomes `path` at the end of the block.

    Readers find the old content or the new one, never a part: not after an interrupt, and not after a power cut, because the content is
    on the disk before it gets its name. Any number of processes and threads may write a file at the same time; the last one stays. A
    folder has one writer. The hidden name ends like `path`. If the block raises, it is removed and `path` is left as it was.

    A killed process leaves its hidden file. The next writer of `path` removes it if the process ran under the same boot and in the same
    namespace of process numbers, and no longer exists. Others, from another machine or container, from before a restart, or with a
    number that another process has now, are removed when nobody has written to them for a day.

    A device or a pipe, such as /dev/stdout, is written to directly. A symbolic link stays, and its target is replaced.

    Args:
        path: of the file or folder.
        siblings: pattern of other names in the same folder whose hidden files are removed in the same way, such as "step-*".

    Raises:
        OSError: the file cannot be written; its `filename` is `path`, not the hidden name.
    """
    direct = os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path)
    target = Path(os.path.realpath(path)) if os.path.islink(path) and not direct else path
    hidden = target if direct else _hidden(target)
    try:
        if not direct:
            _remove_leftovers(target, siblings)
        yield hidden
        if not direct:
            _sync(hidden)
            _rename(hidden, target)
    except OSError as error:
        if error.errno is not None and (error.filename is None or str(error.filename).startswith(str(hidden))):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        if not direct:
            _remove(hidden)


def file_fault(error: OSError, place: str = "path") -> str:
    """Return why a file cannot be read or written, and how to mend it; `place` says what else may be chosen.

    Example:
        >>> file_fault(OSError(28, "No space left on device"), "--out"), file_fault(OSError("the encoder failed"))
        ('No space left on device; free some space or choose another --out', 'the encoder failed; choose another path')
    """
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{os.strerror(error.errno)}; free some space or choose another {place}"
    return f"{error.strerror or error}; choose another {place}"


def _hidden(target: Path) -> Path:
    return target.with_name(f".{_place() or _UNKNOWN}-{os.getpid()}-{os.urandom(4).hex()}.{_end_of_name(target)}")


def _end_of_name(target: Path) -> str:
    return os.fsdecode(os.fsencode(target.name)[-_NAME_BYTES:])


def _place() -> str | None:
    """Return a digest of where numbers of processes mean those of this process; None if that is unknown."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_bytes()
        return digest(boot, os.readlink("/proc/self/ns/pid").encode())[:8]
    except OSError:  # not on Linux
        return None


def _remove_leftovers(target: Path, siblings: str) -> None:
    end, here = _end_of_name(target), _place()
    with suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            match = _HIDDEN.fullmatch(entry.name)
            if match is None or (match["end"] != end and not fnmatchcase(match["end"], siblings)):
                continue
            with suppress(OSError):  # another writer removes it, too
                dead = match["place"] == here and not _process_exists(int(match["process"]))
                if dead or time.time() - entry.stat(follow_symlinks=False).st_mtime > _IDLE:
                    _remove(Path(entry.path))


def _process_exists(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _sync(path: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk."""
    inner = path.rglob("*") if path.is_dir() else ()
    for each in (*inner, path):
        _sync_entry(each)


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
    if hidden.is_dir() and target.is_dir():
        aside = _hidden(target)
        os.replace(target, aside)
        try:
            os.replace(hidden, target)
        except OSError:
            os.replace(aside, target)
            raise
        _remove(aside)
    else:
        os.replace(hidden, target)
    with suppress(OSError):
        _sync_entry(target.parent)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with suppress(OSError):
        path.unlink(missing_ok=True)


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
