"""Cases on other grasps than the fixed one: other friction, other places, random objects."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array
from grasp_env.errors import InfeasibleStartError, RankDeficientGraspError
from grasp_env.force import OfflineBasis, phase_one
from grasp_env.grasp import Grasp, presets, wrench
from training.cases.sets import Case, along, generator

FRICTIONS = (0.2, 0.7, 0.8)
"""Outside the training range of the fixed-grasp model, 0.25 to 0.6."""
DISPLACEMENT = 0.010
"""[m] by which contacts are moved on their faces, at most."""
CLOSURE = 0.01
"""Least closure margin of a random grasp, divided by its contacts: nearer to none, forces grow without bound."""
_PER_GRASP = 4


def grasp_cases(name: str, count: int, seed: int) -> list[Case]:
    """The cases of a set on near or random grasps; see `cases.SETS`.

    Args:
        name: "friction", "positions" or "random_<contacts>".
        count: about how many.
        seed: of the evaluation.
    """
    rng, fixed = generator(seed, name), presets.paper_cuboid()
    cases: list[Case] = []
    if name == "friction":
        for group, mu in enumerate(FRICTIONS):
            path = wrench.sample_ball(rng, max(2, count // len(FRICTIONS)))
            cases += along(fixed.with_friction(mu), path, group, f"{mu:g}")
    elif name == "positions":
        for group in range(max(1, count // _PER_GRASP)):
            cases += along(displaced(rng, fixed), wrench.sample_ball(rng, _PER_GRASP), group)
    else:
        for group in range(count):
            grasp = closed_grasp(rng, int(name.split("_")[1]))
            cases.append(Case(grasp, wrench.sample_ball(rng, 1)[0], None, group))
    return cases


def displaced(
    rng: np.random.Generator, grasp: Grasp, low: float = 0.0, high: float = DISPLACEMENT, only: int = -1
) -> Grasp:
    """The grasp with its contacts moved in their tangent planes by `low` to `high` [m], uniform over the ring.

    Args:
        rng: draws distances and directions.
        grasp: the contacts.
        low: least distance.
        high: largest.
        only: the one contact to move; -1: all.
    """
    count = grasp.n_contacts
    distance, angle = np.sqrt(rng.uniform(low**2, high**2, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    if only >= 0:
        distance[np.arange(count) != only] = 0.0
    moves = grasp.frames[:, :, 1] * np.cos(angle)[:, None] + grasp.frames[:, :, 2] * np.sin(angle)[:, None]
    return Grasp.from_contacts(grasp.positions + distance[:, None] * moves, grasp.normals, grasp.friction)


def closed_grasp(rng: np.random.Generator, count: int) -> Grasp:
    """A random grasp of `count` contacts with force closure, on a random box, ellipsoid or cylinder, friction 0.3 to 0.8."""
    while True:
        positions, normals = _SHAPES[int(rng.integers(len(_SHAPES)))](rng, count)
        try:
            grasp = Grasp.from_contacts(positions, normals, float(rng.uniform(0.3, 0.8)))
        except RankDeficientGraspError:
            continue
        if closes(grasp):
            return grasp


def closes(grasp: Grasp) -> bool:
    """Whether a grasp has force closure worth the name, and an offline basis to compare with (of 3 contacts 3 % have none)."""
    if phase_one(grasp, np.zeros(6)).margin <= CLOSURE / grasp.n_contacts:
        return False
    try:
        OfflineBasis.of(grasp)
    except InfeasibleStartError:
        return False
    return True


def _box(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    half, axis, side = rng.uniform(0.03, 0.06, 3), rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    positions, normals = rng.uniform(-1.0, 1.0, (count, 3)) * half, np.zeros((count, 3))
    positions[np.arange(count), axis] = side * half[axis]
    normals[np.arange(count), axis] = -side
    return positions, normals


def _ellipsoid(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    half, directions = rng.uniform(0.03, 0.06, 3), _unit(rng.standard_normal((count, 3)))
    return directions * half, -_unit(directions / half)


def _cylinder(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    radius, half = rng.uniform(0.03, 0.06, 2)
    angle, height = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-half, half, count)
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    positions = radius * outward + height[:, None] * np.array([0.0, 0.0, 1.0])
    # a third of the contacts on the two ends
    ends, reach = rng.random(count) < 1.0 / 3.0, np.sqrt(rng.random(count))
    positions[ends] = radius * (reach[:, None] * outward)[ends] + half * np.sign(height[ends])[:, None] * [
        0.0,
        0.0,
        1.0,
    ]
    outward[ends] = np.sign(height[ends])[:, None] * [0.0, 0.0, 1.0]
    return positions, -outward


def _unit(vectors: Array) -> Array:
    return vectors / np.sqrt((vectors**2).sum(axis=1))[:, None]


_SHAPES = (_box, _ellipsoid, _cylinder)
