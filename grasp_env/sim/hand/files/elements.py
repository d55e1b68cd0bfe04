"""Links and joints read from a file of any kind, and the protocol of the readers."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from grasp_env.errors import shown
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.frames import IDENTITY, Frame
from grasp_env.sim.hand.inertia import Inertia
from grasp_env.sim.hand.tree import Geometry, Mimic

Ends: TypeAlias = Sequence[tuple[str, str, str]]
"""Name, parent and child of each joint."""
NO_INERTIA: Inertia = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of a link without one in the file


@dataclass(frozen=True)
class FileLink:
    """A link of a file; `HandFile.with_shapes` adds the shapes."""

    name: str
    mass: float = 0.0  # 0 if the file has none
    inertial_frame: Frame = IDENTITY
    inertia: Inertia = NO_INERTIA
    collision: tuple[Geometry, ...] = ()
    visual: tuple[Geometry, ...] = ()
    color: Vector3 | None = None  # of its first visual shape


@dataclass(frozen=True)
class FileJoint:
    """A joint of a file; `origin` and `rotation` place the child at angle 0."""

    name: str
    parent: str
    child: str
    fixed: bool
    origin: Vector3
    rotation: Vector3
    axis: Vector3 = (1.0, 0.0, 0.0)
    lower: float = -math.inf
    upper: float = math.inf
    effort: float | None = None
    sliding: bool = False
    mimic: Mimic | None = None
    rotor: float = 0.0  # [kg m^2]


class HandFile(Protocol):
    """A reader of one kind of file; `urdf.UrdfReader` describes the attributes."""

    name: str
    names: list[str]
    ends: list[tuple[str, str, str]]
    origins: dict[str, Vector3]
    mimics: dict[str, str]
    fixed: set[str]
    undrawn: dict[str, str]
    notes: list[str]

    def elements(self, links: Collection[str], /) -> tuple[dict[str, FileLink], list[FileJoint]]:
        """Return some of the links by name, and the joints between them in file order."""
        ...

    def with_shapes(self, links: dict[str, FileLink], /) -> dict[str, FileLink]:
        """Return the links with their shapes."""
        ...


def names_of(values: Sequence[Any]) -> str:
    """Return at most 60 names for a message, and the number of the others."""
    return listed(list(map(shown, values)), 60)


def listed(rows: Sequence[str], most: int = 20) -> str:
    """Return at most `most` texts for a message, and the number of the others."""
    return ", ".join(rows[:most]) + (f" and {len(rows) - most} more" if len(rows) > most else "")
