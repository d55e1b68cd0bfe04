"""Random grasps with force closure: what a model for any grasp is trained and held out on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import GraspError
from grasp_env.force import Objective, OfflineBasis
from grasp_env.grasp import Grasp, presets

SHAPES = ("cuboid", "ellipsoid", "sphere", "cylinder")
SIZE = (0.03, 0.07)
"""[m] half of an object's width along an axis."""
FRICTION = (0.2, 1.0)
OWN_FRICTION = 0.3
"""Share of grasps whose contacts each have a friction of their own."""
PRESET_SHARE = 0.1
"""Share of grasps that are presets with displaced contacts, as a simulated hand has them."""


def surface_points(rng: np.random.Generator, shape: str, count: int) -> tuple[Array, Array]:
    """Points (count, 3) [m] and inward unit normals on a random solid of 6 to 14 cm.

    Args:
        rng: source of all numbers.
        shape: one of `SHAPES`.
        count: how many.
    """
    half = rng.uniform(*SIZE, 3)
    if shape == "cuboid":
        axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
        points = rng.uniform(-0.9, 0.9, (count, 3)) * half
        inward = np.zeros((count, 3))
        inward[np.arange(count), axis] = -sign
        points[np.arange(count), axis] = sign * half[axis]
        return points, inward
    if shape == "cylinder":
        angle, height = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-0.9, 0.9, count) * half[2]
        around = np.stack([np.cos(angle), np.sin(angle)], 1)
        cap = rng.random(count) < 0.25
        side = np.concatenate([half[0] * around, height[:, None]], 1)
        end = np.where(height > 0.0, 1.0, -1.0)
        disc = half[0] * np.sqrt(rng.uniform(0.0, 0.8, count))[:, None] * around
        top = np.concatenate([disc, (end * half[2])[:, None]], 1)
        flat = np.zeros((count, 1))
        inward = np.where(
            cap[:, None], np.concatenate([flat, flat, -end[:, None]], 1), -np.concatenate([around, flat], 1)
        )
        return np.where(cap[:, None], top, side), inward
    if shape == "sphere":
        half = np.full(3, half[0])
    outward = rng.standard_normal((count, 3))
    points = outward / np.sqrt((outward**2).sum(1, keepdims=True)) * half
    inward = -points / half**2
    return points, inward / np.sqrt((inward**2).sum(1, keepdims=True))


def draw_grasp(rng: np.random.Generator, contacts: Sequence[int] = (3, 4, 5)) -> Grasp:
    """One random grasp, with or without force closure (about 57 % have it).

    Raises:
        RankDeficientGraspError: all contacts happen to lie on a line.
    """
    if rng.random() < PRESET_SHARE:
        name = {3: "tripod", 4: "paper_cuboid", 5: "five_finger_cuboid"}[int(rng.choice(contacts))]
        return displaced(rng, presets.preset(name, rng.uniform(0.25, 0.8)), 0.01, 0.15)
    count = int(rng.choice(contacts))
    points, inward = surface_points(rng, str(rng.choice(SHAPES)), count)
    friction = rng.uniform(*FRICTION, count)
    return Grasp.from_contacts(points, inward, friction if rng.random() < OWN_FRICTION else friction[0])


def displaced(rng: np.random.Generator, grasp: Grasp, distance: float, angle: float) -> Grasp:
    """The grasp with contacts that slipped or rolled.

    Args:
        rng: source of all numbers.
        grasp: hard contacts.
        distance: [m] largest standard deviation of the displacements (drawn once for all contacts).
        angle: [rad] the same of the normals.

    Raises:
        RankDeficientGraspError: the result has rank(G) < 6.
    """
    share = rng.random()
    points = grasp.positions + share * distance * rng.standard_normal(grasp.positions.shape)
    inward = grasp.normals + share * angle * rng.standard_normal(grasp.positions.shape)
    inward /= np.sqrt((inward**2).sum(1, keepdims=True))
    return Grasp.from_contacts(points, inward, grasp.friction)


def closed(grasp: Grasp, objective: Objective) -> Array | None:
    """The 12-basis and the rest force (13, 3N) in cone coordinates; None without force closure."""
    try:
        return OfflineBasis.of(grasp, objective).cone_forces
    except GraspError:
        return None


def random_grasps(
    rng: np.random.Generator, count: int, objective: Objective, contacts: Sequence[int] = (3, 4, 5)
) -> list[tuple[Grasp, Array]]:
    """Grasps with force closure and their bases, see `closed`.

    Example:
        >>> made = random_grasps(np.random.default_rng(0), 3, Objective(), contacts=(4,))
        >>> [(grasp.n_contacts, basis.shape) for grasp, basis in made]
        [(4, (13, 12)), (4, (13, 12)), (4, (13, 12))]
    """
    found: list[tuple[Grasp, Array]] = []
    while len(found) < count:
        try:
            grasp = draw_grasp(rng, contacts)
        except GraspError:
            continue
        basis = closed(grasp, objective)
        if basis is not None:
            found.append((grasp, basis))
    return found
