"""Direction from a hand's palm to the object: checks of a wanted one, and the actual one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array, as_array, choice
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.objects.description import ObjectDescription

# largest angle between the direction from the palm to the object and the wanted one
DEVIATION = math.radians(30.0)
DIRECTIONS = {"down": (0.0, -1.0, 0.0), "up": (0.0, 1.0, 0.0), "side": None}
"""Directions by name, world frame; "side" is any horizontal one.

Gravity is along -y: with "down" the palm is above the object.
"""
_PROBE, _STEP = 0.002, 1e-4  # diameter of the ball that probes for the palm, and its steps [m]


def as_approach(value: Any, name: str) -> str | tuple[float, float, float]:
    """Check a direction, world frame; return a name in `DIRECTIONS` or a unit vector."""
    if isinstance(value, str):
        return choice(
            value,
            name,
            DIRECTIONS,
            ", or give the direction (3,) from the palm to the object, world frame",
        )
    direction = as_array(value, (3,), name)
    largest = float(np.abs(direction).max())
    if largest == 0.0:
        raise InvalidInputError(
            f"{name}={direction.tolist()} must have a direction; 'down' is (0, -1, 0)"
        )
    direction = direction / largest
    x, y, z = (direction / np.linalg.norm(direction)).tolist()
    return x, y, z


@dataclass(frozen=True)
class Approach:
    """A wanted direction from the palm to the object, see `as_approach`."""

    wanted: str | tuple[float, float, float]

    def __str__(self) -> str:
        if isinstance(self.wanted, str):
            return repr(self.wanted)
        return f"({', '.join(f'{x:.3g}' for x in self.wanted)})"

    def allows(self, direction: Array) -> bool:
        """True if a unit direction (3,) is within `DEVIATION` of the wanted one."""
        wanted = self._vector
        if wanted is None:
            return bool(abs(direction[1]) <= math.sin(DEVIATION))
        return bool(direction @ wanted >= math.cos(DEVIATION))

    def draw(self, rng: np.random.Generator) -> Array:
        """Return the wanted unit direction (3,); a random horizontal one for "side"."""
        wanted = self._vector
        turn = rng.uniform(0.0, 2.0 * np.pi)
        return np.array([np.cos(turn), 0.0, np.sin(turn)]) if wanted is None else np.array(wanted)

    @property
    def _vector(self) -> tuple[float, float, float] | None:
        return DIRECTIONS[self.wanted] if isinstance(self.wanted, str) else self.wanted


def palm_direction(kinematics: HandKinematics, limbs: core.HandLimbs, center: Array) -> Array:
    """Return the unit direction (3,) from the palm to the object's centre (3,) [m], hand frame.

    It starts at the nearest point of the palm, or at the mean of the fingers' first joints if the
    palm has no shapes.
    """
    probe = ObjectDescription("sphere", (_PROBE,)).surface
    still = np.eye(3).ravel().tolist()

    def palm_gap(point: Array) -> float:
        return limbs.moved(still, (-point).tolist(), kinematics.home).palm_gap(probe)

    steps = _STEP * np.eye(3)
    away = np.array([palm_gap(center + step) - palm_gap(center - step) for step in steps])
    if not np.isfinite(away).all() or np.linalg.norm(away) < _STEP:
        away = center - kinematics.roots.mean(axis=0)
    return away / max(float(np.linalg.norm(away)), 1e-12)
