"""Inner pyramids in place of friction cones, for solvers of linear and quadratic programs.

min sum of weights >= 0   s.t.  columns @ weights = -w (6 rows), <= b (L rows)
with force = edges @ weights
"""

from __future__ import annotations

import numpy as np

from benchmarks.force.problems import Array, Problem

SIDES = 8
"""Sides of each pyramid; its edges lie on the cone."""


class Pyramids:
    """The pyramids of a problem.

    Attributes:
        columns: (6 + L, N E) what a unit of each edge adds to G f and B f; E is `SIDES`, or twice
            that with torsion.
    """

    def __init__(self, problem: Problem) -> None:
        n, k = problem.n_contacts, problem.width
        angle = 2.0 * np.pi / SIDES * np.arange(SIDES)
        one = np.ones((n, SIDES))
        o = np.outer(problem.friction, np.cos(angle))
        t = np.outer(problem.friction, np.sin(angle))
        self._edges = np.stack([one, o, t], axis=1)  # (N, k, E), with a normal force of 1
        if problem.torsional_friction is not None:
            torsion = problem.torsional_friction[:, None, None] * one[:, None]
            halves = [np.concatenate([self._edges, s * torsion], axis=1) for s in (1, -1)]
            self._edges = np.concatenate(halves, axis=2)
        if problem.touching is not None:
            self._edges *= problem.touching[:, None, None]
        rows = np.concatenate([problem.matrix, problem.limit_matrix]).reshape(-1, n, k)
        self.columns = np.einsum("rnk,nke->rne", rows, self._edges).reshape(len(rows), -1)

    def force(self, weights: Array) -> Array:
        """Return the force (N k,) of the weights of all edges."""
        return np.einsum("nke,ne->nk", self._edges, weights.reshape(len(self._edges), -1)).ravel()
