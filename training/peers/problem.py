"""What every peer solves, how its answers are checked, and how its calls are timed.

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
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy import sparse

from grasp_env._check import Array, Wrench

WARM_UP = 20
"""Calls before any is timed."""


class Solver(Protocol):
    """A peer set up for one grasp."""

    def solve(self, wrench: Wrench) -> Array:
        """The forces x (3N,) [N] that balance `wrench` (6,) [N, N m]; NaN where the peer does not report success."""
        ...

    def times(self, wrenches: Array, repeats: int) -> Array:
        """Seconds (M,) of one call per wrench (M, 6), the best of `repeats`; see `best_times`."""
        ...


@runtime_checkable
class BatchSolver(Solver, Protocol):
    """A peer that also takes many wrenches in one call."""

    def prepare(self, count: int) -> None:
        """What can be set up before the wrenches are known."""
        ...

    def solve_many(self, wrenches: Array) -> Array:
        """The forces (M, 3N) for wrenches (M, 6); NaN where there are none."""
        ...


@dataclass(frozen=True)
class MissingPeer:
    """A peer that cannot run here, and why, for people."""

    name: str
    reason: str


@dataclass(frozen=True)
class Achieved:
    """What answers are worth, by the problem alone; (M,) each, NaN where there is no answer.

    Attributes:
        objective: sum of the normal forces [N].
        balance: largest |component| of A x + w [N, N m].
        violation: largest sqrt(o^2 + t^2) - u over the contacts [N], 0 inside the cones.
    """

    objective: Array
    balance: Array
    violation: Array


def achieved(cone_matrix: Array, cost: Array, wrenches: Array, forces: Array) -> Achieved:
    """Checks answers `forces` (M, 3N) for `wrenches` (M, 6) against A (6, 3N) and c (N,).

    Example:
        >>> from grasp_env.grasp import presets
        >>> tripod = presets.tripod()
        >>> squeeze = np.tile([1.0, 0.0, 0.0], (1, 3))
        >>> achieved(tripod.cone_matrix, 1.0 / tripod.friction, np.zeros((1, 6)), squeeze).objective
        array([6.])
    """
    contacts = forces.reshape(len(forces), -1, 3)
    outside = np.hypot(contacts[:, :, 1], contacts[:, :, 2]) - contacts[:, :, 0]
    return Achieved(
        objective=contacts[:, :, 0] @ cost,
        balance=np.abs(forces @ cone_matrix.T + wrenches).max(axis=1),
        violation=np.maximum(outside.max(axis=1), 0.0),
    )


def dual_form(cone_matrix: Array, cost: Array) -> tuple[sparse.csc_matrix, Array]:
    """A^T, sparse (3N, 6), and h (3N,) of the dual form."""
    bound = np.zeros(3 * len(cost))
    bound[::3] = cost
    return sparse.csc_matrix(cone_matrix.T), bound


def best_times(solve: Callable[[Wrench], object], wrenches: Array, repeats: int) -> Array:
    """Seconds (M,) per wrench (M, 6) of one Python call: new wrench in, forces out as an array.

    The best of `repeats` passes over all wrenches: a pass, unlike the same wrench again and again, leaves nothing of
    the last call in the branch predictor, and a noisy moment of the machine hits one repeat of many wrenches.
    """
    best = np.full(len(wrenches), np.inf)
    for wrench in wrenches[:WARM_UP]:
        solve(wrench)
    for _ in range(repeats):
        for k, wrench in enumerate(wrenches):
            begin = time.perf_counter_ns()
            solve(wrench)
            best[k] = min(best[k], 1e-9 * (time.perf_counter_ns() - begin))
    return best
