"""Reading of mesh files by trimesh, in a process of its own: no file makes the user's process hang,
grow or crash.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import read_bytes, stand_in
from grasp_env.sim.mesh_files import EXPORT, KINDS, MAX_MEMORY, SIMPLIFY, TOO_MUCH_MEMORY
from grasp_env.sim.objects.apart import apart

SECONDS = 30.0
"""Longest time to read a file [s]; the largest take a few."""


class MeshFile(NamedTuple):
    """A mesh file: its bytes, its kind, such as ".obj", and its name in messages."""

    content: bytes
    kind: str
    name: str


def open_mesh(path: str | os.PathLike[str], name: str) -> MeshFile:
    """Return the bytes of a mesh file, or raise an InvalidInputError: it has another kind, is
    missing, empty or too large.
    """
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise InvalidInputError(
            f"{name} is of no kind that is read: {', '.join(KINDS)}; export it as one of them"
        )
    try:
        content = read_bytes(path, KINDS[kind])
    except OSError as problem:
        remedy = SIMPLIFY if problem.errno == errno.EFBIG else "check the path"
        raise InvalidInputError(f"cannot read {name}: {problem.strerror}; {remedy}") from problem
    other, remedy = stand_in(content)
    if other:
        raise InvalidInputError(f"{name} is a {other}: {remedy}")
    if not content:
        raise InvalidInputError(f"{name} is empty; {EXPORT}")
    return MeshFile(content, kind, name)


def read_mesh(file: MeshFile) -> tuple[Array, Any]:
    """Return the corners (V, 3) float64 of the faces of a mesh file, in its units, and the faces
    (F, 3) int64, or raise an InvalidInputError.
    """
    (found,) = read_meshes([file])
    if isinstance(found, InvalidInputError):
        raise found
    return found


def read_meshes(files: Sequence[MeshFile]) -> list[tuple[Array, Any] | InvalidInputError]:
    """Return what `read_mesh` returns or raises for each of several files, which one process reads."""
    if not files:
        return []
    need("sim")
    kinds = np.array([file.kind for file in files])
    contents: dict[str, Any] = {
        f"file{number}": np.frombuffer(file.content, np.uint8) for number, file in enumerate(files)
    }
    text = f"reading {files[0].name if len(files) == 1 else f'{len(files)} mesh files'}, once for this content"
    variables = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # each thread would take memory
    seconds = SECONDS + len(files) - 1
    try:
        made = apart(
            "grasp_env.sim.mesh_files:read_files",
            text,
            seconds,
            memory=MAX_MEMORY,
            variables=variables,
            kinds=kinds,
            **contents,
        )
    except (TimeoutError, ChildProcessError) as error:
        if len(files) > 1:  # one of them is at fault
            return [found for file in files for found in read_meshes([file])]
        return [InvalidInputError(f"{files[0].name} {_why_ended(error, files[0].kind)}")]
    return [_found(made, number, file.name) for number, file in enumerate(files)]


def _found(made: dict[str, Any], number: int, name: str) -> tuple[Array, Any] | InvalidInputError:
    if f"fault{number}" in made:
        return InvalidInputError(f"{name} {made[f'fault{number}']}")
    return made[f"corners{number}"], made[f"faces{number}"]


def _why_ended(error: TimeoutError | ChildProcessError, kind: str) -> str:
    """Return what happened to a file whose reading had to end, or ended by itself."""
    if isinstance(error, TimeoutError):
        return f"took more than {SECONDS:.0f} s to be read as {kind}; {SIMPLIFY}"
    last = str(error).strip().rsplit("\n", 1)[-1]
    return TOO_MUCH_MEMORY if "MemoryError" in last else f"made trimesh crash ({last}); {EXPORT}"
