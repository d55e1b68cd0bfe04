"""Reading of mesh files by trimesh in another process, as some make it hang, grow or crash."""

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
    """Read the bytes of a mesh file.

    Raises:
        InvalidInputError: The file is missing, empty, too large or of another kind.
    """
    kind = Path(path).suffix.lower()
    if kind not in KINDS:
        raise InvalidInputError(
            f"{name} is not of a supported type: {', '.join(KINDS)}; export it as one of them"
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
    """Return the used corners (V, 3) float64 of a mesh file, in its units, and faces (F, 3) int64.

    Raises:
        InvalidInputError: The file cannot be read.
    """
    (mesh,) = read_meshes([file])
    if isinstance(mesh, InvalidInputError):
        raise mesh
    return mesh


def read_meshes(files: Sequence[MeshFile]) -> list[tuple[Array, Any] | InvalidInputError]:
    """Read several files in one process; return the result or error of `read_mesh` for each."""
    if not files:
        return []
    need("sim")
    contents: dict[str, Any] = {
        f"file{number}": np.frombuffer(file.content, np.uint8) for number, file in enumerate(files)
    }
    name = files[0].name if len(files) == 1 else f"{len(files)} mesh files"
    try:
        arrays = apart(
            "grasp_env.sim.mesh_files:read_files",
            f"reading {name}, once for this content",
            SECONDS + len(files) - 1,
            memory=MAX_MEMORY,
            # each thread would take memory
            variables={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            kinds=np.array([file.kind for file in files]),
            **contents,
        )
    except (TimeoutError, ChildProcessError) as error:
        if len(files) > 1:  # one of them is at fault
            return [mesh for file in files for mesh in read_meshes([file])]
        return [InvalidInputError(f"{name} {_why_ended(error, files[0].kind)}")]
    return [
        InvalidInputError(f"{file.name} {arrays[f'fault{number}']}")
        if f"fault{number}" in arrays
        else (arrays[f"corners{number}"], arrays[f"faces{number}"])
        for number, file in enumerate(files)
    ]


def _why_ended(error: TimeoutError | ChildProcessError, kind: str) -> str:
    if isinstance(error, TimeoutError):
        return f"took more than {SECONDS:.0f} s to be read as {kind}; {SIMPLIFY}"
    last = str(error).strip().rsplit("\n", 1)[-1]
    return TOO_MUCH_MEMORY if "MemoryError" in last else f"made trimesh crash ({last}); {EXPORT}"
