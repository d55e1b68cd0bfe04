"""Meshes named in a hand's file, and their convex pieces as collision shapes of its links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from grasp_env._check import AllFaults, Array
from grasp_env.errors import InvalidInputError, shown
from grasp_env.sim.hand.files.pieces import pieces_of_file
from grasp_env.sim.hand.solids import hull_shape
from grasp_env.sim.hand.tree import Geometry, Vector3
from grasp_env.sim.progress import progress_bar


@dataclass(frozen=True)
class MeshUse:
    """A mesh of a <collision> or <visual> that has not been read: its name in the hand's file, its path and its pose."""

    name: str
    path: Path
    scale: Vector3
    origin: Vector3
    rotation: Vector3
    color: Vector3 | None


def solids_of(shapes: Mapping[str, Sequence[Geometry | MeshUse]], file: str) -> dict[str, list[Geometry]]:
    """Return the collision shapes of links, with meshes replaced by convex pieces; each mesh is decomposed once.

    Args:
        shapes: Collision shapes by link.
        file: Name of the hand's file, for the progress on a terminal.

    Raises:
        InvalidInputError: Files are not meshes of a hand; the message lists all of them.
    """
    first = dict[tuple[Path, Vector3], tuple[str, str]]()
    for link, parts in shapes.items():
        for part in parts:
            if isinstance(part, MeshUse):
                first.setdefault((part.path, part.scale), (link, part.name))
    pieces, faults = dict[tuple[Path, Vector3], list[Array]](), list[str]()
    for (path, scale), (link, name) in progress_bar(list(first.items()), f"{file}: convex pieces of meshes"):
        try:
            pieces[path, scale] = pieces_of_file(path, scale)
        except InvalidInputError as error:
            faults.append(f"link {link!r}, <collision>, {shown(name)}: {error}")
    with AllFaults() as check:
        check.add(*faults)
    return {link: [solid for part in parts for solid in _solids(part, pieces)] for link, parts in shapes.items()}


def _solids(shape: Geometry | MeshUse, pieces: Mapping[tuple[Path, Vector3], list[Array]]) -> list[Geometry]:
    if isinstance(shape, Geometry):
        return [shape]
    return [hull_shape(piece, shape.origin, shape.rotation) for piece in pieces[shape.path, shape.scale]]
