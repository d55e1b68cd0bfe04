"""Random grasps on solids, and known grasps with slightly moved contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grasp_env.errors import GraspError
from grasp_env.force import OfflineBasis
from grasp_env.grasp import Grasp, presets
from grasp_env.inputs.arguments import Array, unit_vectors
from grasp_env.quality import feasibility

PRESETS = {3: presets.tripod, 4: presets.paper_cuboid, 5: presets.five_finger_cuboid}
"""Preset grasps by their number of contacts."""
HALF = (0.03, 0.06)
"""Range of half a solid's width along an axis [m]."""
CLOSURE = 0.01
"""Least closure margin times the number of contacts: forces grow without bound near the loss of
closure."""
ENDS = 1.0 / 3.0
"""Share of a cylinder's contacts that lie on its two ends."""


@dataclass(frozen=True)
class Recipe:
    """Distribution of random grasps.

    Attributes:
        shapes: keys of `SOLIDS`, with equal probability.
        friction: range of the coefficient.
        own_friction: True if each contact draws its own friction.
        margin: least closure margin times the number of contacts.
        basis: True if a closed grasp must also have an offline basis (3 % of those with 3 contacts
            have none).
    """

    shapes: tuple[str, ...] = ("cuboid", "ellipsoid", "cylinder")
    friction: tuple[float, float] = (0.3, 0.8)
    own_friction: bool = False
    margin: float = CLOSURE
    basis: bool = True

    def points(self, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        """Draw positions (count, 3) [m] and inward unit normals (count, 3) on one random solid."""
        index = int(rng.integers(len(self.shapes))) if len(self.shapes) > 1 else 0
        return SOLIDS[self.shapes[index]](rng, count)

    def draw(self, rng: np.random.Generator, count: int) -> Grasp:
        """Draw one grasp, with or without force closure."""
        positions, normals = self.points(rng, count)
        friction = rng.uniform(*self.friction, count if self.own_friction else None)
        return Grasp.from_contacts(positions, normals, friction)

    def closes(self, grasp: Grasp) -> bool:
        """Return True if a grasp has force closure with the recipe's margin."""
        if grasp.rank < 6 or not closes(grasp, self.margin):
            return False
        if self.basis:
            try:
                OfflineBasis.of(grasp)
            except GraspError:
                return False
        return True

    def closed(self, rng: np.random.Generator, count: int) -> Grasp:
        """Draw one grasp of `count` contacts with force closure."""
        while True:
            grasp = self.draw(rng, count)
            if self.closes(grasp):
                return grasp


def closes(grasp: Grasp, margin: float = CLOSURE) -> bool:
    """Return True if the grasp closes with that margin; see `Recipe.margin`."""
    return feasibility(grasp, np.zeros(6)).margin > margin / grasp.n_contacts


def _cuboid(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    half = rng.uniform(*HALF, 3)
    axis = rng.integers(0, 3, count)
    side = rng.choice([-1.0, 1.0], count)
    positions = rng.uniform(-1.0, 1.0, (count, 3)) * half
    normals = np.zeros((count, 3))
    positions[np.arange(count), axis] = side * half[axis]
    normals[np.arange(count), axis] = -side
    return positions, normals


def _ellipsoid(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    half = rng.uniform(*HALF, 3)
    outward = unit_vectors(rng.standard_normal((count, 3)))
    return outward * half, -unit_vectors(outward / half)


def _cylinder(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    radius, half = rng.uniform(*HALF, 2)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    height = rng.uniform(-half, half, count)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    ends = rng.random(count) < ENDS
    reach = np.sqrt(rng.random(count))
    up = np.array([0.0, 0.0, 1.0])
    side = np.where(height > 0.0, 1.0, -1.0)[:, None]
    top = ends[:, None]
    flat = radius * (reach[:, None] * around) + side * half * up
    round_ = radius * around + height[:, None] * up
    positions = np.where(top, flat, round_)
    return positions, -np.where(top, side * up, around)


SOLIDS = {"cuboid": _cuboid, "ellipsoid": _ellipsoid, "cylinder": _cylinder}
EVALUATION = Recipe()
"""Grasps on which starts are compared."""
BENCH = Recipe(("ellipsoid",), friction=(0.3, 1.0), own_friction=True, margin=0.02, basis=False)
"""Grasps on which solvers are timed, far from the loss of closure."""


def slide_contacts(
    rng: np.random.Generator, grasp: Grasp, low: float, high: float, only: int | None = None
) -> Grasp:
    """Move the contacts in their tangent planes by `low` to `high` [m], uniformly over the ring.

    Args:
        rng: draws distances and directions.
        grasp: the contacts.
        low: least distance.
        high: largest distance.
        only: index of the one contact to move; None: all.
    """
    count = grasp.n_contacts
    distance = np.sqrt(rng.uniform(low**2, high**2, count))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    if only is not None:
        distance[np.arange(count) != only] = 0.0
    moves = (
        grasp.frames[:, :, 1] * np.cos(angle)[:, None]
        + grasp.frames[:, :, 2] * np.sin(angle)[:, None]
    )
    return Grasp.from_contacts(
        grasp.positions + distance[:, None] * moves, grasp.normals, grasp.friction
    )
