"""The problems of the benchmarks: grasps with force closure, standard wrenches."""

from __future__ import annotations

import numpy as np

from grasp_env.grasp import Grasp
from grasp_env.grasp.wrench import sample_ball
from training.data.grasps import BENCH, PRESETS


def closed_grasps(rng: np.random.Generator, count: int, number: int) -> list[Grasp]:
    """`number` grasps of `count` contacts: the preset of that size first, then random ones with force closure."""
    first = [PRESETS[count]()] if count in PRESETS else []
    return first + [BENCH.closed(rng, count) for _ in range(number - len(first))]


def problems(seed: int, count: int, wrenches: int, number: int = 4) -> list[tuple[Grasp, np.ndarray]]:
    """[(grasp, wrenches (n, 6))]: `wrenches` in all, in the standard ball, shared out over `number` grasps."""
    rng = np.random.default_rng([seed, count])
    parts = np.array_split(sample_ball(rng, wrenches), number)
    return list(zip(closed_grasps(rng, count, number), parts, strict=True))
