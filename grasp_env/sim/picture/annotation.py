"""Content of an annotated picture of a grasp: forces, friction cones, wrench and text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array, positive

WRENCH_COLOR = (150, 30, 140)
LONGEST = 0.08  # length of the longest force arrow [m]
WRENCH_STRETCH = 2.0  # drawn scale of the wrench's force over that of the fingers' larger forces
LONGEST_TURN = math.radians(300.0)  # angle of the longest arc of a moment [rad]


@dataclass(frozen=True, eq=False)
class Annotation:
    """Annotation of a picture of a grasp with N contacts, in the world frame.

    Attributes:
        points: (N, 3) contacts [m].
        normals: (N, 3) unit normals, into the object.
        forces: (N, 3) commanded force of each finger ON the object [N].
        measured: (N, 3) measured force of each finger ON the object [N], a thin dark line.
        friction: (N,) coefficients of friction; the drawn cones have the half angle atan(friction).
        active: (N,) True if the contact takes part; others are drawn hollow and grey.
        colors: (N, 3) colours of the fingers: red, green and blue in [0, 1].
        wrench: (6,) external force [N] and moment [N m] on the object.
        center: (3,) point of application of the wrench's force [m].
        scale: drawn length of forces [m/N]; the longest should have about `LONGEST`.
        turn: drawn angle of moments [rad/(N m)]; the largest should have about `LONGEST_TURN`.
        title: task and disturbance, at the top left.
        hand: name of the hand, at the top right.
        alarm: error text, in red, as is then the first of `lines`.
        lines: (label, value) pairs at the bottom.

    Raises:
        InvalidInputError: An array has a wrong shape or is not finite, or a scale is not positive.
    """

    points: Array
    normals: Array
    forces: Array
    measured: Array
    friction: Array
    active: NDArray[Any]
    colors: Array
    wrench: Array
    center: Array
    scale: float
    turn: float
    title: str = ""
    hand: str = ""
    alarm: str = ""
    lines: Sequence[tuple[str, str]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "active", np.multiply(self.active, 1.0))
        count = len(as_array(self.points, (None, 3), "points"))
        vectors = ("points", "normals", "forces", "measured", "colors")
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(vectors, (count, 3))
        shapes |= {"friction": (count,), "active": (count,), "wrench": (6,), "center": (3,)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, as_array(getattr(self, name), shape, name, ranges.SIZE))
        positive(self.scale, "scale")
        positive(self.turn, "turn")
