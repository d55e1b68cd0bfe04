"""How smoothly a start follows the wrench: slopes, kinks and jumps along fine straight paths."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, ContactForces
from grasp_env.errors import GraspError
from grasp_env.force import ForceOptimizer, Objective
from grasp_env.grasp import presets, wrench
from training.cases.sets import HELD_OUT
from training.cases.starts import DoesNotApply, Start, newton_optimizer, scaled
from training.trials.arrays import Trials
from training.trials.compare import OPTIMUM, attempt

POINTS = 401
"""Of a path."""
FINER = 100
"""Parts of the steepest step, in which a jump keeps its size and a slope does not."""


def straight_paths(count: int, seed: int) -> Array:
    """(count, POINTS, 6) wrenches on straight lines through the ball, along which every component changes its sign once."""
    rng = np.random.default_rng([HELD_OUT, seed, 1 << 22])
    ends = wrench.sample_ball(rng, 2 * count).reshape(2, count, 6)
    ends[1] = -np.sign(ends[0]) * np.abs(ends[1])
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    return np.stack([a + share * (b - a) for a, b in zip(ends[0], ends[1], strict=True)])


def continuity(starts: dict[str, Start], objective: Objective, count: int, seed: int) -> Trials:
    """Slope, kink and jump of every start, and of the optimum, along straight paths on the fixed grasp; nan where there is no start.

    Args:
        starts: see `make_starts`; those with memory get the optimum of the point before.
        objective: Phi.
        count: paths P.
        seed: of the paths.

    Returns:
        "path/wrench" (P, K, 6), "path/step" (P,) [N]; per start "/slope" (P, K - 1) |df| / |dw|, "/kink" (P, K - 2) change of
        df / dw from step to step, "/jump" (P,) [N] largest |df| in a hundredth of the steepest step. |dw| with moments over 0.05 m.
    """
    grasp, paths = presets.paper_cuboid(), straight_paths(count, seed)
    newton = newton_optimizer(grasp, objective, OPTIMUM)
    steps = np.linalg.norm(scaled(paths[:, 1] - paths[:, 0]), axis=1)
    out: Trials = {"path/wrench": paths, "path/step": steps}
    every = {"optimum": _optimum(newton), **starts}
    for key in every:
        out[f"{key}/slope"] = np.full((count, POINTS - 1), np.nan)
        out[f"{key}/kink"] = np.full((count, POINTS - 2), np.nan)
        out[f"{key}/jump"] = np.full(count, np.nan)
    for p, path in enumerate(paths):
        optima = [newton.solve(load).force for load in path]
        for key, start in every.items():
            forces = np.stack([
                _force(start, newton, load, optima[k - 1] if k else None) for k, load in enumerate(path)
            ])  # fmt: skip
            moves = np.diff(forces.reshape(POINTS, -1), axis=0) / steps[p]
            out[f"{key}/slope"][p] = slopes = np.linalg.norm(moves, axis=1)
            out[f"{key}/kink"][p] = np.linalg.norm(np.diff(moves, axis=0), axis=1)
            if np.isfinite(slopes).any():
                k = int(np.nanargmax(slopes))
                share = np.linspace(0.0, 1.0, FINER + 1)[:, None]
                fine = path[k] + share * (path[k + 1] - path[k])
                close = np.stack([_force(start, newton, load, optima[k - 1] if k else optima[0]) for load in fine])
                out[f"{key}/jump"][p] = np.linalg.norm(np.diff(close.reshape(FINER + 1, -1), axis=0), axis=1).max()
    return out


def _optimum(newton: ForceOptimizer) -> Start:
    return lambda grasp, load, before: newton.solve(load).force


def _force(start: Start, newton: ForceOptimizer, load: Array, before: ContactForces | None) -> ContactForces:
    """The force (N, 3) of a start that a method can begin from, nan where there is none."""
    grasp = newton.grasp
    try:
        force = attempt(start, grasp, load, before)
        newton.solve(load, initial=force)  # refuses what is outside the cones or out of balance
    except (DoesNotApply, GraspError):
        return np.full((grasp.n_contacts, 3), np.nan)
    return force
