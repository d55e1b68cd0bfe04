"""Random grasps: points on random solids, with force closure, or a known grasp whose contacts lie a little elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import GraspError, RankDeficientGraspError
from grasp_env.force import Objective, OfflineBasis, phase_one
from grasp_env.grasp import Grasp, presets

PRESETS = {3: presets.tripod, 4: presets.paper_cuboid, 5: presets.five_finger_cuboid}
"""By their number of contacts."""


@dataclass(frozen=True)
class Recipe:
    """What random grasps are drawn from.

    Attributes:
        shapes: keys of `SOLIDS`, as likely as each other.
        half: [m] range of half of a solid's width along an axis.
        reach: part of a flat face or of a cylinder's height that contacts lie on.
        ends: part of a cylinder's contacts that lie on its two ends, and of the ends' area that they lie on.
        friction: range.
        own_friction: part of the grasps whose contacts each have a friction of their own.
        margin: least closure margin times the contacts; nearer to no closure forces grow without bound.
        basis: whether a closed one must have an offline basis, too (of 3 contacts 3 % have none).
    """

    shapes: tuple[str, ...] = ("cuboid", "ellipsoid", "cylinder")
    half: tuple[float, float] = (0.03, 0.06)
    reach: float = 1.0
    ends: tuple[float, float] = (1.0 / 3.0, 1.0)
    friction: tuple[float, float] = (0.3, 0.8)
    own_friction: float = 0.0
    margin: float = 0.01
    basis: bool = True

    def points(self, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        """Places (count, 3) [m] and inward unit normals on one random solid."""
        place = int(rng.integers(len(self.shapes))) if len(self.shapes) > 1 else 0
        return SOLIDS[self.shapes[place]](self, rng, count)

    def draw(self, rng: np.random.Generator, count: int) -> Grasp:
        """One grasp, with or without force closure.

        Raises:
            RankDeficientGraspError: all contacts happen to lie on a line.
        """
        places, inward = self.points(rng, count)
        own = self.own_friction >= 1.0 or (self.own_friction > 0.0 and rng.random() < self.own_friction)
        return Grasp.from_contacts(places, inward, rng.uniform(*self.friction, count if own else None))

    def closes(self, grasp: Grasp) -> bool:
        """Whether a grasp has force closure worth the name."""
        if phase_one(grasp, np.zeros(6)).margin <= self.margin / grasp.n_contacts:
            return False
        return not self.basis or basis_of(grasp) is not None

    def closed(self, rng: np.random.Generator, count: int) -> Grasp:
        """One grasp of `count` contacts that closes."""
        while True:
            try:
                grasp = self.draw(rng, count)
            except RankDeficientGraspError:
                continue
            if self.closes(grasp):
                return grasp


def basis_of(grasp: Grasp, objective: Objective | None = None) -> Array | None:
    """The 12-basis and the rest force (13, 3N) in cone coordinates; None without force closure."""
    try:
        return OfflineBasis.of(grasp, objective or Objective()).cone_forces
    except GraspError:
        return None


def moved(grasp: Grasp, places: Array, inward: Array | None = None) -> Grasp:
    """A grasp with its contacts (N, 3) elsewhere, along other normals (N, 3) of any length.

    Raises:
        RankDeficientGraspError: the result has rank(G) < 6.
    """
    return Grasp.from_contacts(places, grasp.normals if inward is None else _unit(inward), grasp.friction)


def _unit(vectors: Array) -> Array:
    return vectors / np.sqrt((vectors**2).sum(axis=1, keepdims=True))


def _cuboid(recipe: Recipe, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    half, axis, side = rng.uniform(*recipe.half, 3), rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    places, inward = rng.uniform(-recipe.reach, recipe.reach, (count, 3)) * half, np.zeros((count, 3))
    places[np.arange(count), axis] = side * half[axis]
    inward[np.arange(count), axis] = -side
    return places, inward


def _ellipsoid(recipe: Recipe, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    half, outward = rng.uniform(*recipe.half, 3), _unit(rng.standard_normal((count, 3)))
    return outward * half, -_unit(outward / half)


def _sphere(recipe: Recipe, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    radius, outward = rng.uniform(*recipe.half), _unit(rng.standard_normal((count, 3)))
    return radius * outward, -outward


def _cylinder(recipe: Recipe, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    radius, half = rng.uniform(*recipe.half, 2)
    angle, height = rng.uniform(0.0, 2.0 * np.pi, count), recipe.reach * rng.uniform(-half, half, count)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    share, area = recipe.ends
    ends, reach = rng.random(count) < share, np.sqrt(area * rng.random(count))
    up = np.array([0.0, 0.0, 1.0])
    side, top = np.where(height > 0.0, 1.0, -1.0)[:, None], ends[:, None]
    places = np.where(
        top, radius * (reach[:, None] * around) + side * half * up, radius * around + height[:, None] * up
    )
    return places, -np.where(top, side * up, around)


SOLIDS: dict[str, Callable[[Recipe, np.random.Generator, int], tuple[Array, Array]]] = {
    "cuboid": _cuboid,
    "ellipsoid": _ellipsoid,
    "sphere": _sphere,
    "cylinder": _cylinder,
}
TRAINING = Recipe(
    ("cuboid", "ellipsoid", "sphere", "cylinder"), half=(0.03, 0.07), reach=0.9, ends=(0.25, 0.8), friction=(0.2, 1.0),
    own_friction=0.3,
)  # fmt: skip
"""What the model for any grasp is trained and held out on: whatever has force closure at all."""
EVALUATION = Recipe()
"""What starts are compared on."""
BENCH = Recipe(("ellipsoid",), friction=(0.3, 1.0), own_friction=1.0, margin=0.02, basis=False)
"""What solvers are timed on: away from losing closure."""
PRESET_SHARE = 0.1
"""Share of the training's grasps that are presets with displaced contacts, as a simulated hand has them."""


def random_grasps(
    rng: np.random.Generator, count: int, objective: Objective, contacts: Sequence[int] = (3, 4, 5)
) -> list[tuple[Grasp, Array]]:
    """Grasps to train on with force closure and their bases, see `basis_of`; about 57 % of those drawn have it.

    Example:
        >>> made = random_grasps(np.random.default_rng(0), 3, Objective(), contacts=(4,))
        >>> [(grasp.n_contacts, basis.shape) for grasp, basis in made]
        [(4, (13, 12)), (4, (13, 12)), (4, (13, 12))]
    """
    found: list[tuple[Grasp, Array]] = []
    while len(found) < count:
        number = int(rng.choice(contacts))
        try:
            if rng.random() < PRESET_SHARE:
                grasp = shaken(rng, PRESETS[number](rng.uniform(0.25, 0.8)), 0.01, 0.15)
            else:
                grasp = TRAINING.draw(rng, number)
        except GraspError:
            continue
        basis = basis_of(grasp, objective)
        if basis is not None:
            found.append((grasp, basis))
    return found


def shaken(rng: np.random.Generator, grasp: Grasp, distance: float, angle: float) -> Grasp:
    """The grasp with contacts that slipped or rolled.

    Args:
        rng: source of all numbers.
        grasp: hard contacts.
        distance: [m] largest standard deviation of the displacements (drawn once for all contacts).
        angle: [rad] the same of the normals.

    Raises:
        RankDeficientGraspError: the result has rank(G) < 6.
    """
    share, shape = rng.random(), grasp.positions.shape
    places = grasp.positions + share * distance * rng.standard_normal(shape)
    return moved(grasp, places, grasp.normals + share * angle * rng.standard_normal(shape))


def slid(rng: np.random.Generator, grasp: Grasp, low: float, high: float, only: int | None = None) -> Grasp:
    """The grasp with its contacts moved in their tangent planes by `low` to `high` [m], uniform over the ring.

    Args:
        rng: draws distances and directions.
        grasp: the contacts.
        low: least distance.
        high: largest.
        only: the one contact to move; None: all.

    Raises:
        RankDeficientGraspError: the result has rank(G) < 6.
    """
    count = grasp.n_contacts
    distance, angle = np.sqrt(rng.uniform(low**2, high**2, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    if only is not None:
        distance[np.arange(count) != only] = 0.0
    moves = grasp.frames[:, :, 1] * np.cos(angle)[:, None] + grasp.frames[:, :, 2] * np.sin(angle)[:, None]
    return moved(grasp, grasp.positions + distance[:, None] * moves)
