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
    """The path of a compiler: that of an environment variable, or the first of these; a
    `RuntimeError` if there is none.
    """
    each = (os.environ.get(variable), *names)
    found = next((found for name in each if name and (found := shutil.which(name))), None)
    if found is None:
        raise RuntimeError(f"no compiler: install {names[0]} or {names[1]}, or set {variable}")
    return found


def library(
    name: str,
    sources: Sequence[Path],
    flags: Sequence[str],
    depends: Sequence[Path] = (),
    cpp: bool = False,
) -> Path:
    """Return a shared library of sources in `BUILD`, compiled if it does not exist, or raise a
    `RuntimeError`.
    """
    command = (
        compiler("CXX", "g++", "clang++", "c++") if cpp else compiler("CC", "gcc", "clang", "cc")
    )
    texts = (command, *flags, *(path.read_text(encoding="utf-8") for path in (*sources, *depends)))
    words = [command, *flags, "-fPIC", "-shared", *map(str, sources), "-o"]
    return made(name, "\0".join(texts).encode(), lambda part: execute([*words, str(part)]))


def made(name: str, key: bytes, make: Callable[[Path], None]) -> Path:
    """Return the library of a key in `BUILD`, written by `make` if it does not exist."""
    path = BUILD / f"{name}_{digest(key)[:16]}.so"
    if not path.exists():
        BUILD.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            make(part)
    return path


def execute(words: Sequence[str]) -> None:
    """Run a compiler, or raise a `RuntimeError` with its first words."""
    answer = subprocess.run(words, capture_output=True, text=True, check=False, timeout=900)
    if answer.returncode:
        raise RuntimeError(f"{' '.join(words)[:200]} fails: {answer.stderr.strip()[:300]}")
