"""Links and joints as files of any kind have them, and what a reader of one kind offers."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from grasp_env.errors import shown
from grasp_env.sim.hand.check import Vector3
from grasp_env.sim.hand.frames import Frame
from grasp_env.sim.hand.inertia import Inertia
from grasp_env.sim.hand.tree import Geometry, Mimic

NO_INERTIA: Inertia = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Of a link whose file names none."""


@dataclass(frozen=True)
class FileLink:
    """A link of a file: mass 0 where the file names none; `color` is that of its first visual; its shapes come by `HandFile.shaped`."""

    name: str
    mass: float = 0.0
    inertial_frame: Frame = field(default_factory=lambda: Frame(np.eye(3), np.zeros(3)))
    inertia: Inertia = NO_INERTIA
    collision: tuple[Geometry, ...] = ()
    visual: tuple[Geometry, ...] = ()
    color: Vector3 | None = None


@dataclass(frozen=True)
class FileJoint:
    """A joint of a file: `origin` and `rotation` put the child at angle 0; `effort` is None where it names none.

    `rotor` is the inertia of its motor [kg m^2], which a URDF has no word for.
    """

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
    rotor: float = 0.0


class HandFile(Protocol):
    """A reader of any kind of file; see `urdf.UrdfReader`."""

    name: str
    names: list[str]
    ends: list[tuple[str, str, str]]
    mimics: dict[str, str]
    fixed: set[str]
    unseen: dict[str, str]
    said: list[str]

    def elements(self, links: Collection[str], /) -> tuple[dict[str, FileLink], list[FileJoint]]:
        """Some of the links by name, and the joints between them in the order of the file."""
        ...

    def shaped(self, links: dict[str, FileLink], /) -> dict[str, FileLink]:
        """The links with the shapes that they touch with."""
        ...


def names_of(values: Sequence[Any]) -> str:
    """Names for a message, not more than can be read."""
    return ", ".join(map(shown, values[:60])) + (f" and {len(values) - 60} more" if len(values) > 60 else "")
