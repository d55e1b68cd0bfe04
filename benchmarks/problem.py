"""The conic force problem that all solvers are given, measures of their answers, and the timing of their calls.

Forces of N contacts in cone coordinates x_i = (u, o, t)_i with u = friction * normal, A = `Grasp.cone_matrix`,
c = 1 / friction, w the wrench to balance:

    primal: min sum_i c_i u_i      s.t.  A x = -w,  u_i >= sqrt(o_i^2 + t_i^2)
    dual:   min w . y, y in R^6    s.t.  h - A^T y in the same cones,  h_i = (c_i, 0, 0)

The multipliers of the dual's cones are the forces x: its stationarity is w + A x = 0. With 6 variables and no
equality it is the form a careful user hands to an interior-point solver; between calls only w changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy import sparse

from grasp_env._check import Array, Wrench
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.grasp.wrench import sample_ball
from training.data.grasps import BENCH, PRESETS

WARM_UP = 20
"""Calls before any is timed."""


class Solver:
    """A solver that is set up for one grasp."""

    def solve(self, wrench: Wrench) -> Array:
        """The forces x (3N,) [N] that balance `wrench` (6,) [N, N m]; NaN where the solver does not report success."""
        raise NotImplementedError

    def times(self, wrenches: Array, passes: int) -> Array:
        """(n,) seconds of one call for each wrench (n, 6), the best of `passes`; see `best_times`."""
        return best_times(self.solve, wrenches, passes)


def closed_grasps(rng: np.random.Generator, count: int, number: int) -> list[Grasp]:
    """`number` grasps of `count` contacts: the preset of that size first, then random ones with force closure."""
    first = [PRESETS[count]()] if count in PRESETS else []
    return first + [BENCH.closed(rng, count) for _ in range(number - len(first))]


def problems(seed: int, count: int, wrenches: int, number: int = 4) -> list[tuple[Grasp, Array]]:
    """[(grasp, wrenches (n, 6))]: `wrenches` in all, in the standard ball, shared out over `number` grasps."""
    rng = np.random.default_rng([seed, count])
    parts = np.array_split(sample_ball(rng, wrenches), number)
    return list(zip(closed_grasps(rng, count, number), parts, strict=True))


def dual_form(grasp: Grasp) -> tuple[sparse.csc_matrix, Array]:
    """A^T, sparse (3N, 6), and h (3N,) of the dual form."""
    bound = np.zeros(3 * grasp.n_contacts)
    bound[::3] = 1.0 / grasp.friction
    return sparse.csc_matrix(grasp.cone_matrix.T), bound


def achieved(grasp: Grasp, wrenches: Array, forces: Array) -> tuple[Array, Array, Array]:
    """Measures answers `forces` (n, 3N) for `wrenches` (n, 6) by the problem alone.

    Returns:
        (n,) each, NaN where there is no answer: the sum of the normal forces [N]; the largest |component| of A x + w over that of w;
        the largest sqrt(o^2 + t^2) - u of the contacts over the largest |component| of x, 0 inside the cones.

    Example:
        >>> from grasp_env.grasp import presets
        >>> achieved(presets.tripod(), np.ones((1, 6)), np.tile([1.0, 0.0, 0.0], (1, 3)))[0]
        array([6.])
    """
    contacts = forces.reshape(len(forces), -1, 3)
    outside = np.hypot(contacts[:, :, 1], contacts[:, :, 2]) - contacts[:, :, 0]
    balance = np.abs(forces @ grasp.cone_matrix.T + wrenches).max(axis=1) / np.abs(wrenches).max(axis=1)
    violation = np.maximum(outside.max(axis=1), 0.0) / np.abs(forces).max(axis=1)
    return contacts[:, :, 0] @ (1.0 / grasp.friction), balance, violation


def best_times(solve: Callable[[Wrench], object], wrenches: Array, passes: int) -> Array:
    """(n,) seconds of one Python call for each wrench (n, 6): new wrench in, forces out as an array.

    The best of `passes` passes over all wrenches: a pass, unlike the same wrench again and again, leaves nothing of
    the last call in the branch predictor, and a noisy moment of the machine hits one repeat of many wrenches.
    """
    best = np.full(len(wrenches), np.inf)
    for wrench in wrenches[:WARM_UP]:
        solve(wrench)
    for _ in range(passes):
        for k, wrench in enumerate(wrenches):
            begin = time.perf_counter_ns()
            solve(wrench)
            best[k] = min(best[k], 1e-9 * (time.perf_counter_ns() - begin))
    return best


def compiled_times(optimizer: ForceOptimizer, wrenches: Array, passes: int) -> tuple[Array, Array]:
    """(n,) seconds of one compiled call for each wrench (n, 6), certificate included, and the records of the solutions.

    Loop and clock are compiled, too; every call is the first of its optimizer.
    """
    loads, best = np.array(wrenches), np.empty(len(wrenches))
    records = np.zeros((len(loads), optimizer.core.size))
    optimizer.core.times(loads[:WARM_UP], 1, records[:WARM_UP], best[:WARM_UP])
    optimizer.core.times(loads, passes, records, best)
    return best, records
