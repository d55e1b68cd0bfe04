"""Trials of learned starts against the default start of a method: their Phi must not be larger,
beyond rounding.

Wrenches are of 1e-4 to 1e4 N, friction from below the trained range to above it. The methods
themselves compute Phi of both starts.
"""

from __future__ import annotations

import numpy as np

from grasp_env.force import optimize_forces
from grasp_env.grasp import Grasp, presets, wrench
from policies import LearnedInitialForce

OWN = {"newton": "internal_force", "reduced_flow": "linear_combination"}
"""Default start of each method."""
CHUNK = 50_000
FRICTIONS = (0.2, 0.7)
ROUNDING = 1e-15
"""Relative difference by the order of sums: four units of the last digit. The comparison within a
call has no tolerance."""


def violations(
    rule: LearnedInitialForce, grasp: Grasp, wrenches: np.ndarray, method: str
) -> np.ndarray:
    """Return (B,) True for starts with more Phi than the default one."""
    starts, own = (
        optimize_forces(
            grasp, wrenches, method=method, initial=initial, max_iterations=0, tolerance=1e-13
        )
        for initial in (rule, OWN[method])
    )
    return ~(starts.objective <= own.objective * (1.0 + ROUNDING))


def trial(rule: LearnedInitialForce, count: int, seed: int, method: str) -> int:
    """Return how many of `count` wrenches have a worse start."""
    rng = np.random.default_rng(seed)
    found = 0
    for begin in range(0, count, CHUNK):
        grasp = presets.paper_cuboid().with_friction(float(rng.uniform(*FRICTIONS)))
        wrenches = wrench.sample_magnitudes(rng, min(CHUNK, count - begin), 1e-4, 1e4)
        found += int(violations(rule, grasp, wrenches, method).sum())
    return found
