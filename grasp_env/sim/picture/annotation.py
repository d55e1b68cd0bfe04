"""What a picture of a grasp is to say, in numbers: forces, friction cones, the wrench, words, and the scales of it all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grasp_env import ranges
from grasp_env._check import Array, as_array, as_list, as_text, is_a, positive, together
from grasp_env.errors import InvalidInputError, shown

PALETTE = ((0.85, 0.33, 0.24), (0.20, 0.50, 0.80), (0.95, 0.69, 0.20), (0.27, 0.65, 0.42), (0.55, 0.40, 0.75),
           (0.35, 0.70, 0.75), (0.80, 0.45, 0.60), (0.50, 0.55, 0.30))  # fmt: skip
"""Colours of fingers that were given none, red, green and blue in [0, 1]; beyond eight they repeat."""

WRENCH_COLOR = (150, 30, 140)

LONGEST = 0.08
"""The longest force arrow [m]."""

WRENCH_STRETCH = 2.0
"""The wrench's force is drawn so many times longer than the fingers', which squeeze with more."""

LONGEST_TURN = math.radians(300.0)
"""The longest arc of a moment [rad]."""

LEAST = 0.1, 0.02
"""Force [N] and moment [N m] of the largest scales: what is near nothing is not blown up."""


@dataclass(frozen=True, eq=False)
class Annotation:
    """What to draw over a picture of a grasp with N contacts; everything in the world frame.

    Attributes:
        points: (N, 3) contacts [m].
        normals: (N, 3) unit normals, into the object.
        forces: (N, 3) commanded force of each finger ON the object [N].
        friction: (N,) coefficients; the drawn cones have the half angle atan(friction).
        active: (N,) whether the contact takes part; the others are drawn hollow and grey.
        wrench: (6,) force [N] and moment [N m] that act on the object from outside.
        center: (3,) where the wrench's force attacks [m].
        measured: (N, 3) measured force of each finger ON the object [N], a thin dark line; None: not drawn.
        lines: (label, value) pairs of the numbers below.
        colors: (N, 3) of the fingers, red, green and blue in [0, 1]; None: `PALETTE`.
        scale: drawn length of a force [m/N], `arrow_scale` of the largest of a film; None: of this picture's largest.
        turn: drawn angle of a moment [rad/(N m)], `arc_scale` of the largest of a film; None: of this picture's.
        title: what is seen, at the top; hand: who holds, at the right of it.
        alarm: what went wrong, in red; the first of `lines` is red, too.

    Raises:
        InvalidInputError: a wrong shape, or numbers that are not finite.
    """

    points: Array
    normals: Array
    forces: Array
    friction: Array
    active: Array
    wrench: Array
    center: Array
    measured: Array | None = None
    lines: Sequence[tuple[str, str]] = ()
    colors: Array | None = None
    scale: float | None = None
    turn: float | None = None
    title: str = ""
    hand: str = ""
    alarm: str = ""

    def __post_init__(self) -> None:
        count = len(as_array(self.points, (None, 3), "points"))
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("points", "normals", "forces"), (count, 3))
        shapes |= {"friction": (count,), "active": (count,), "wrench": (6,), "center": (3,)}
        shapes |= {name: (count, 3) for name in ("measured", "colors") if getattr(self, name) is not None}
        together(*(lambda name=name, shape=shape: self._keep(name, shape) for name, shape in shapes.items()))
        for name in ("scale", "turn"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, positive(getattr(self, name), name))
        pairs = [[as_text(part) for part in as_list(pair) or ()] for pair in as_list(self.lines) or ()]
        if as_list(self.lines) is None or any(len(pair) != 2 or None in pair for pair in pairs):
            raise InvalidInputError(f"lines must be a list of (label, value) pairs of text, got {shown(self.lines)}")

    def _keep(self, name: str, shape: tuple[int, ...]) -> None:
        value = getattr(self, name)
        if name == "active":  # true and false are no numbers elsewhere
            each = as_list(value)
            if each is not None:
                value = [float(entry) if is_a(entry, bool | np.bool_) else entry for entry in each]
            elif is_a(value, np.ndarray) and value.dtype == np.bool_:
                value = value.astype(np.float64)
        object.__setattr__(self, name, as_array(value, shape, name, ranges.SIZE))

    @property
    def force_scale(self) -> float:
        """Drawn length of forces [m/N]."""
        return self.scale or arrow_scale(self.forces * self.active[:, None], self.wrench)

    @property
    def moment_scale(self) -> float:
        """Drawn angle of moments [rad/(N m)]."""
        return self.turn or arc_scale(float(np.linalg.norm(self.wrench[3:])))


def arrow_scale(forces: Array, wrenches: Array) -> float:
    """Drawn length of forces [m/N] with which the longest arrow is `LONGEST`.

    Args:
        forces: (..., 3) of fingers [N].
        wrenches: (..., 6), whose forces are drawn `WRENCH_STRETCH` times longer.

    Example:
        >>> arrow_scale(np.array([[4.0, 0.0, 0.0]]), np.zeros(6))
        0.02
    """
    lengths = [np.linalg.norm(forces, axis=-1), WRENCH_STRETCH * np.linalg.norm(wrenches[..., :3], axis=-1)]
    return LONGEST / max(*(float(np.max(length, initial=0.0)) for length in lengths), LEAST[0])


def arc_scale(moment: float) -> float:
    """Drawn angle of moments [rad/(N m)] with which `moment` [N m] is `LONGEST_TURN`.

    Example:
        >>> round(float(np.degrees(0.05 * arc_scale(0.1))), 6)
        150.0
    """
    return LONGEST_TURN / max(moment, LEAST[1])


def round_down(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most `value` > 0.

    Example:
        >>> [round_down(value) for value in (0.013, 0.02, 7.0)]
        [0.01, 0.02, 5.0]
    """
    power = int(np.floor(np.log10(value) + 1e-9))
    return next(float(f"{k}e{power}") for k in (5, 2, 1) if k <= value / 10.0**power * (1.0 + 1e-9) or k == 1)
