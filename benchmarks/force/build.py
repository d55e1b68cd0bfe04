"""Shared libraries of entrants and of the clock, compiled once for this machine."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from grasp_env.inputs.files import digest, replacing

BUILD = Path(__file__).parents[2] / "build/force"
"""Folder of the libraries."""


def compiler(variable: str, *names: str) -> str:
    """Find a compiler: `$VARIABLE`, else the first of `names` on PATH, else a `RuntimeError`."""
    for name in (os.environ.get(variable), *names):
        if name and (path := shutil.which(name)):
            return path
    raise RuntimeError(f"no compiler: install {names[0]} or {names[1]}, or set {variable}")


def library(
    name: str,
    sources: Sequence[Path],
    flags: Sequence[str],
    depends: Sequence[Path] = (),
    cpp: bool = False,
) -> Path:
    """Return a shared library in `BUILD`, compiled if it does not exist, or raise `RuntimeError`."""
    names = ("CXX", "g++", "clang++", "c++") if cpp else ("CC", "gcc", "clang", "cc")
    command = compiler(*names)
    texts = (command, *flags, *(path.read_text(encoding="utf-8") for path in (*sources, *depends)))
    words = [command, *flags, "-fPIC", "-shared", *map(str, sources), "-o"]
    return cached(name, "\0".join(texts).encode(), lambda path: execute([*words, str(path)]))


def cached(name: str, key: bytes, make: Callable[[Path], None]) -> Path:
    """Return the library of a key in `BUILD`, written by `make` if it does not exist."""
    path = BUILD / f"{name}_{digest(key)[:16]}.so"
    if not path.exists():
        BUILD.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            make(temporary)
    return path


def execute(words: Sequence[str]) -> None:
    """Run a compiler, or raise a `RuntimeError` with its first words."""
    ended = subprocess.run(words, capture_output=True, text=True, check=False, timeout=900)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(words)[:200]} fails: {ended.stderr.strip()[:300]}")
