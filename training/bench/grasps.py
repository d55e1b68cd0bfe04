"""The problems of the benchmarks: grasps with force closure, standard wrenches."""

from __future__ import annotations

import numpy as np

from grasp_env.force import phase_one
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball

DEEP = 0.02
"""Least closure margin of a random grasp here: away from losing closure, where forces grow without bound."""
_NAMED = {3: presets.tripod, 4: presets.paper_cuboid, 5: presets.five_finger_cuboid}


def random_grasp(rng: np.random.Generator, count: int) -> Grasp:
    """`count` contacts on a random ellipsoid of 30 to 60 mm half-axes, friction 0.3 to 1; no promise of closure."""
    axes = rng.uniform(0.03, 0.06, 3)
    directions = rng.standard_normal((count, 3))
    directions /= np.sqrt((directions**2).sum(axis=1))[:, None]
    positions = directions * axes
    normals = -positions / axes**2
    normals /= np.sqrt((normals**2).sum(axis=1))[:, None]
    return Grasp.from_contacts(positions, normals, rng.uniform(0.3, 1.0, count))


def closed_grasps(rng: np.random.Generator, count: int, number: int) -> list[Grasp]:
    """`number` grasps of `count` contacts: the preset of that size first, then random ones with force closure."""
    grasps = [_NAMED[count]()] if count in _NAMED else []
    while len(grasps) < number:
        grasp = random_grasp(rng, count)
        if phase_one(grasp, np.zeros(6)).margin > DEEP / count:
            grasps.append(grasp)
    return grasps


def problems(seed: int, count: int, wrenches: int, number: int = 4) -> list[tuple[Grasp, np.ndarray]]:
    """[(grasp, wrenches (n, 6))]: `wrenches` in all, in the standard ball, shared out over `number` grasps."""
    rng = np.random.default_rng([seed, count])
    parts = np.array_split(sample_ball(rng, wrenches), number)
    return list(zip(closed_grasps(rng, count, number), parts, strict=True))
