"""Expand a xacro file in a process of its own, with guarded expressions and files.

Two barriers stand one behind the other. `_guard` replaces the functions of xacro that evaluate,
open, list and find. `_Watch` stops any other action that leaves the interpreter, such as opening a
file, importing a module or starting a program.
"""

from __future__ import annotations

import glob
import io
import json
import math
import os
import re
import sys
import unicodedata  # noqa: F401 - Python's parser needs it for names with other letters, and `_Watch` refuses the import
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.dom import minidom

import numpy as np

from grasp_env.errors import GraspError, InvalidInputError, alike
from grasp_env.inputs.files import MEGABYTE, TEXT, parsed, read_bytes, understood
from grasp_env.sim.hand.files.expressions import RefusedError, evaluate
from grasp_env.sim.hand.files.meshes import PARENTS
from grasp_env.sim.xml_files import read_xml

# Python's names that expressions may use; xacro also offers `vars` and `type`, which give access to
# everything else
_PYTHON = [
    "list",
    "dict",
    "map",
    "len",
    "str",
    "float",
    "int",
    "bool",
    "True",
    "False",
    "min",
    "max",
    "round",
    "abs",
    "all",
    "any",
    "complex",
    "divmod",
    "enumerate",
    "filter",
    "frozenset",
    "hash",
    "isinstance",
    "issubclass",
    "ord",
    "range",
    "repr",
    "reversed",
    "slice",
    "set",
    "sorted",
    "sum",
    "tuple",
    "zip",
]
_XACRO = [
    "load_yaml",
    "abs_filename",
    "dotify",
    "arg",
    "message",
    "warning",
    "error",
    "print_location",
    "fatal",
    "tokenize",
]
# events of the interpreter that xacro needs; `compile` only parses
_HARMLESS = ("builtins.id", "compile")
_WILD = re.compile(r"[*\[?]")


def expand(request: Any) -> dict[str, Any]:
    """Return the "text" of an expanded file, its bytes as uint8, or the "error".

    `apart` runs this function. The request is JSON: "file", an absolute path; "arguments", texts by
    name; "shares", folders in which ROS keeps packages.
    """
    os.environ.clear()  # $(optenv) reads it
    job = json.loads(str(request))
    arguments = _Arguments(job["arguments"])
    files = _Files(Path(job["file"]), job["shares"])
    try:
        text = _expanded(job["file"], arguments, files)
        arguments.check()
    except Exception as error:  # xacro does not catch errors of expressions
        return {"error": np.array(_message(error))}
    return {"text": np.frombuffer(text, np.uint8)}


def _expanded(file: str, arguments: _Arguments, files: _Files) -> bytes:
    import xacro
    from xacro import substitution_args

    _guard(xacro, substitution_args, arguments, files)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), warnings.catch_warnings():
        # of expressions; they would read the file of the expression
        warnings.simplefilter("ignore")
        with files.watch.set(True):
            document: Any = xacro.process_file(file, mappings=arguments)
        text = document.toxml().encode()
    if len(text) > TEXT:
        raise RefusedError(f"it becomes more than {TEXT // MEGABYTE} MB")
    return text


def _guard(xacro: Any, substitution_args: Any, arguments: _Arguments, files: _Files) -> None:
    """Replace the functions of xacro that evaluate, open, list and find, and remove others."""
    symbols = getattr(xacro, "_global_symbols", {})
    required = (
        (dir(xacro), ("safe_eval", "parse", "glob", "load_yaml")),
        (dir(substitution_args), ("_eval", "_eval_env", "_eval_find")),
        (symbols, ("math", "python", "xacro")),
    )
    if missing := [name for table, names in required for name in names if name not in table]:
        raise RefusedError(
            f"{xacro.__file__} is a version without {missing[0]}, which is not guarded: pip install xacro==2.1.1"
        )
    python = symbols["python"]
    everything = [*_PYTHON, *_XACRO, *vars(math), "math", "python", "xacro"]
    for table, allowed in ((symbols, everything), (python, _PYTHON), (symbols["xacro"], _XACRO)):
        for name in set(table).difference(allowed):
            dict.pop(table, name)

    def convert(value: str) -> Any:
        return substitution_args.convert_value(value, "auto")

    def extension(text: str, context: Any) -> str:
        """Return the value of $(eval ...), which has variables and functions of its own."""
        values = {name: convert(value) for name, value in arguments.items()}
        functions = {
            "arg": lambda name: convert(arguments[name]),
            "find": files.find,
            "env": variable,
            "optenv": substitution_args._eval_optenv,
            "true": True,
            "false": False,
        }
        return str(evaluate(text, {**python, **symbols["math"], **values, **functions}))

    def variable(name: str) -> str:
        raise RefusedError(f"it reads the environment variable {name!r}, which is not allowed")

    def parse(_: Any, name: str) -> Any:
        try:
            document: Any = files.parse(name)
        except OSError as error:
            xacro.filestack.pop()
            raise xacro.XacroException(f"{error.strerror}: {name}", exc=error) from error
        for element in document.getElementsByTagName("xacro:arg"):
            # xacro would refuse it even if the argument is given
            if not element.hasAttribute("default"):
                arguments.requested[element.getAttribute("name")] = None
                element.parentNode.removeChild(element)
        return document

    xacro.safe_eval = lambda text, names, _=None: evaluate(text, names)
    xacro.parse, xacro.open = parse, files.open
    xacro.glob = SimpleNamespace(glob=files.glob)
    substitution_args._eval = extension
    substitution_args._eval_env = variable
    substitution_args._eval_find = files.find


class _Watch:
    """A hook of the interpreter that refuses every event while it is active."""

    def __init__(self) -> None:
        self._active = False
        sys.addaudithook(self._refuse)

    def _refuse(self, event: str, _: Any) -> None:
        if self._active and event not in _HARMLESS:
            raise RefusedError(f"it does {event!r} in the interpreter, which is not allowed")

    @contextmanager
    def set(self, active: bool) -> Iterator[None]:
        """Be active, or not, for the time of the block."""
        before, self._active = self._active, active
        try:
            yield
        finally:
            self._active = before


class _Files:
    """The files that a xacro file may read: those beside it, and those of ROS packages."""

    def __init__(self, file: Path, shares: Sequence[str]) -> None:
        self.watch = _Watch()
        self._shares = shares
        self._packages = dict[str, Path]()
        self._roots = list[Path]()
        for path in (file, _real(file)):  # ROS installs links to the files of a workspace
            self._roots.append(_real(path.parent))
            for name, manifest in _manifests(path):
                self._add(name, manifest)

    def _add(self, name: str, manifest: Path) -> None:
        self._packages.setdefault(name, manifest.parent)
        self._roots += [_real(manifest.parent), _real(manifest).parent]

    def find(self, name: str) -> str:
        """Return the folder of a ROS package."""
        if name not in self._packages and re.fullmatch(r"\w[\w.-]*", name):
            with self.watch.set(False):
                for share in map(Path, self._shares):
                    inner = share.glob(f"*/{name}/package.xml")
                    for manifest in (share / name / "package.xml", *inner):
                        if _is_manifest(manifest):
                            self._add(name, manifest)
        if name not in self._packages:
            raise LookupError(
                f"the package {name!r} is in none of the folders above the file and beside those: put it beside the file's"
            )
        return str(self._packages[name])

    def _checked(self, name: str) -> Path:
        path = _real(Path(name))
        if any(_is_inside(path, root) for root in self._roots):
            return path
        raise RefusedError(
            f"it reads {name}, which is neither beside it nor in a package that $(find) finds: put a package.xml into the folder that holds both"
        )

    def _read(self, name: str) -> bytes:
        return read_bytes(self._checked(name))

    def parse(self, name: str) -> minidom.Document:
        """Return an XML file, or raise OSError."""
        with self.watch.set(False):
            blob = self._read(name)
            # without a DOCTYPE
            understood(blob, read_xml, InvalidInputError, f"the file {name}", "XML")
            return minidom.parseString(blob)

    def open(self, name: str) -> io.StringIO:
        """Return a text file, or raise OSError."""
        with self.watch.set(False):
            blob = self._read(name)
            where = f"the file {name}"
            return io.StringIO(
                understood(blob, _as_utf8, InvalidInputError, where, "text in UTF-8")
            )

    def glob(self, pattern: str) -> list[str]:
        """Return the names of the files that fit a pattern."""
        pattern = os.path.normpath(pattern)
        fixed = pattern[: _WILD.search(pattern + "*").start()]  # type: ignore[union-attr]
        self._checked(os.path.dirname(fixed))
        with self.watch.set(False):
            return glob.glob(pattern)


def _as_utf8(blob: bytes) -> str:
    return blob.decode("utf-8-sig")


def _manifests(file: Path) -> Iterator[tuple[str, Path]]:
    """Yield names and package.xml of the ROS packages above a file, and of those beside them."""
    for folder in list(file.parents)[: PARENTS + 1]:
        for manifest in [folder / "package.xml", *sorted(folder.glob("*/package.xml"))]:
            with suppress(GraspError):  # not XML
                if _is_manifest(manifest):
                    package = parsed(manifest, read_xml, InvalidInputError, str(manifest), "XML")
                    yield package.findtext("name", "").strip(), manifest


def _is_manifest(path: Path) -> bool:
    """Return True if a file is, or links to, a package.xml; another link would open its target."""
    return path.is_file() and _real(path).name == "package.xml"


def _is_inside(path: Path, root: Path) -> bool:
    """Return True if a path is in a folder and not hidden; of / only its own files are inside."""
    if not path.is_relative_to(root):
        return False
    hidden = any(name.startswith(".") for name in path.relative_to(root).parts)
    return not hidden and (root != root.parent or path.parent == root)


def _real(path: Path) -> Path:
    """Return a path without links; it need not exist."""
    return Path(os.path.realpath(path))


class _Arguments(dict[str, str]):
    """Values of a file's arguments by name, and the names that the file requests."""

    def __init__(self, given: dict[str, str]) -> None:
        super().__init__(given)
        self._given = tuple(given)  # xacro adds defaults
        self.requested = dict[str, None]()

    def __contains__(self, name: object) -> bool:
        self.requested[str(name)] = None
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.requested[name] = None
        return super().__getitem__(name)

    def __missing__(self, name: str) -> str:
        given = f"; given are {', '.join(self._given)}" if self._given else ""
        raise RefusedError(
            f'its argument {name!r} has no default: pass xacro_args={{"{name}": ...}}{given}'
        )

    def check(self) -> None:
        """Raise RefusedError if the file does not ask for a given argument."""
        for name in self._given:
            if name not in self.requested:
                others = ", ".join(self.requested) or "none"
                raise RefusedError(
                    f"it has no argument {name!r}:{alike(name, self.requested)} its arguments are {others}"
                )


def _message(error: BaseException) -> str:
    """Return one sentence about the first cause of an error, with its expression."""
    where = ""
    while isinstance(cause := getattr(error, "exc", None), BaseException):
        where = getattr(error, "suffix", None) or where
        error = cause
    if isinstance(error, RefusedError | GraspError):
        return str(error)
    if isinstance(error, MemoryError):
        return "it needs too much memory"
    if isinstance(error, RecursionError):
        return "it is nested too deep, or a macro calls itself"
    if isinstance(error, OSError):
        return f"it reads {error.filename}: {error.strerror}"
    return " ".join(f"{str(error) or type(error).__name__} {where}".split())[:500]
