"""Find and read the mesh files of a hand, and check that Bullet can draw them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from grasp_env.errors import InvalidInputError, shown
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.files import MEGABYTE, digest, read_bytes, stand_in
from grasp_env.sim.mesh_files import EXPORT, unix_lines
from grasp_env.sim.mesh_shape import WELD, extent_of, weld
from grasp_env.sim.objects.cache import cached, lookup
from grasp_env.sim.objects.reading import MeshFile, open_mesh, read_meshes
from grasp_env.sim.progress import progress_bar

DRAWN = (".obj", ".stl", ".dae")  # suffixes of mesh files that Bullet draws
PARENTS = 5  # number of folders above a hand's file in which its meshes are looked for
_MAX_VISUAL_BYTES = 20 * MEGABYTE  # largest visual mesh [bytes]
_MAX_BLOCKS = 10_000
_LONGEST_HEAD = 65_536  # head of a .dae in which its unit is looked for [bytes]
_UNIT = re.compile(rb"""<(?:\w+:)?unit\s(?:[^<>]*\s)?meter\s*=\s*["']([^"'<>]*)["']""")
# version of the cache's entries; change it when results of meshes change
CACHE_VERSION = "1"


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Find a mesh file under its name in a URDF; None if it is missing.

    The name is an absolute path, or relative to the URDF's folder or one above it. The package name
    in package:// and model:// may be missing in the path.
    """
    kind, separator, rest = name.partition("://")
    path = Path(unquote(rest) if separator else name)
    if separator and kind not in ("package", "file", "model"):
        raise InvalidInputError(
            f"mesh {shown(name)}: only file://, package:// and plain paths are read"
        )
    parts = path.parts[1:] if path.is_absolute() else path.parts
    tails = [parts, parts[1:]] if kind in ("package", "model") and separator else [parts]
    folders = list(urdf.absolute().parents)[: PARENTS + 1]
    try:
        if path.is_absolute() and path.is_file():
            return path
        for folder in folders:
            for tail in tails:
                if tail and (file := folder.joinpath(*tail)).is_file():
                    return file
    except (OSError, ValueError):  # the name is too long, or has a zero byte
        pass
    return None


class Job(NamedTuple):
    """Something to make of a mesh file's corners (V, 3), without duplicates, and faces (F, 3)."""

    path: Path
    mark: bytes  # tells apart what is made of a file
    make: Callable[[Array, Any], dict[str, Any]]


def run_jobs(jobs: Sequence[Job], text: str) -> list[dict[str, Any] | InvalidInputError]:
    """Run jobs on mesh files and return the result or error of each, from the cache if it is there.

    One process reads all other files. `text` describes the work on the progress line.
    """
    done = dict[int, dict[str, Any] | InvalidInputError]()
    left = dict[int, tuple[str, MeshFile]]()
    for number, job in enumerate(jobs):
        try:
            file = open_mesh(job.path, f"the mesh {job.path}")
        except InvalidInputError as error:
            done[number] = error
            continue
        key = digest(CACHE_VERSION.encode(), file.kind.encode(), job.mark, file.content)
        if known := lookup(key):
            done[number] = known
        else:
            left[number] = key, file
    unread = list({file.name: file for _, file in left.values()}.values())
    meshes = {file.name: mesh for file, mesh in zip(unread, read_meshes(unread), strict=True)}
    for number, (key, file) in progress_bar(list(left.items()), text):
        make = partial(_make, jobs[number], file.name, meshes[file.name])
        try:
            done[number] = cached(key, jobs[number].path.name, make, use="hand")
        except InvalidInputError as error:
            done[number] = error
    return [done[number] for number in range(len(jobs))]


def _make(job: Job, name: str, mesh: tuple[Array, Any] | InvalidInputError) -> dict[str, Any]:
    if isinstance(mesh, InvalidInputError):
        raise mesh
    corners, faces = weld(*mesh, WELD * extent_of(mesh[0]))
    if len(faces) == 0:
        raise InvalidInputError(
            f"{name} holds no triangles: all its faces are lines or points; {EXPORT}"
        )
    return job.make(corners, faces)


def read_looks(files: Iterable[str]) -> dict[str, tuple[Array, Any]]:
    """Return corners (V, 3), without duplicates, and faces (F, 3) of meshes, by file.

    The corners are in the file's units.

    Raises:
        InvalidInputError: A file is not a mesh.
    """
    names = list(dict.fromkeys(files))
    jobs = [
        Job(Path(name), b"look", lambda corners, faces: {"corners": corners, "faces": faces})
        for name in names
    ]
    looks = dict[str, tuple[Array, Any]]()
    for name, mesh in zip(names, run_jobs(jobs, "meshes to look at"), strict=True):
        if isinstance(mesh, InvalidInputError):
            raise mesh
        looks[name] = mesh["corners"], mesh["faces"]
    return looks


def unit_of(path: Path) -> float:
    """Return the unit [m] of a .dae, as in <unit meter="0.001"/>; 1 for other files.

    ROS applies the unit; trimesh and Bullet do not. None of them applies <up_axis>.
    """
    if path.suffix.lower() != ".dae":
        return 1.0
    try:
        with path.open("rb") as file:
            match = _UNIT.search(file.read(_LONGEST_HEAD))
    except OSError:  # reading the whole file reports it
        match = None
    text = "1" if match is None else match[1].decode("latin1")
    with suppress(ValueError):
        if 0.0 < (unit := float(text)) < math.inf:
            return unit
    raise InvalidInputError(
        f'{path} has <unit meter="{text[:20]}">, which must be a number of metres above 0'
    )


def why_not_drawn(path: Path, scale: Sequence[float]) -> str:
    """Return the reason why Bullet cannot draw a mesh, or ""; missing corners would crash it."""
    if path.suffix.lower() not in DRAWN:
        return f"are not one of {', '.join(DRAWN)}"
    try:
        blob = read_bytes(path, _MAX_VISUAL_BYTES)
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    other, remedy = stand_in(blob)
    if other:
        return f"are {other}s ({remedy})"
    if path.suffix.lower() != ".obj":
        why = "" if len(blob) > 84 else "are empty"
    else:
        key = digest(CACHE_VERSION.encode(), b"drawn", blob)
        why = str(cached(key, path.name, lambda: {"why": _why_broken(blob)}, use="hand")["why"])
    return why or ("are mirrored by a scale below 0" if min(scale) < 0.0 else "")


def _why_broken(blob: bytes) -> Any:
    with suppress(ValueError):
        if _corners_exist(blob):
            return np.array("")
    return np.array("are broken")


def _corners_exist(blob: bytes) -> bool:
    """Return True if an .obj's faces only name corners, textures and normals before them."""
    text = b"\n" + unix_lines(blob)  # to search for a newline is several times as fast as for `^`
    faces, *others = (
        np.fromiter(_offsets(text, key), np.int64) for key in (b"f", b"v", b"vt", b"vn")
    )
    known = np.stack([np.searchsorted(other, faces) for other in others], axis=1)
    # blocks of faces behind the same number of corners; most files have one block
    cuts = (np.flatnonzero((np.diff(known, axis=0) != 0).any(axis=1)) + 1).tolist()
    if len(faces) == 0 or len(cuts) > _MAX_BLOCKS:
        return False
    rows = re.findall(rb"\n[ \t]*f[ \t]+(.*)", text)
    for begin, end in zip([0, *cuts], [*cuts, len(rows)], strict=True):
        for word in set(b" ".join(rows[begin:end]).split()):
            numbers = word.split(b"/")
            if len(numbers) > 3 or any(
                number and not 1 <= int(number) <= most
                for number, most in zip(numbers, known[begin], strict=False)
            ):
                return False
    return True


def _offsets(text: bytes, key: bytes) -> Iterator[int]:
    """Yield the offsets of the lines that begin with a word."""
    return (match.start() for match in re.finditer(rb"\n[ \t]*%s[ \t]" % key, text))
