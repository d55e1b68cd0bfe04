"""Inner pyramids in place of friction cones, for solvers of linear and quadratic programs.

min sum of weights >= 0   s.t.  columns @ weights = -w (6 rows), <= b (L rows)
with force = edges @ weights

All edges lie on the cone. In units of (o / mu, t / mu) those of a hard contact point to the corners
and the middles of the sides of a square: a regular pyramid of 8 sides, which holds circles of 0.92
of the cone's. In units of (o / mu, t / mu, torsion / gamma) those of a soft contact point to the
corners, the middles of the edges and the middles of the faces of a cube: 26 edges, which hold
spheres of 0.89. Those without torsion are a hard contact's.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from benchmarks.force.problems import Array, Problem


class Pyramids:
    """The pyramids of a problem.

    Attributes:
        columns: (6 + L, N E) what a unit of each edge adds to G f and B f; E is 8, or 26 with
            torsion.
    """

    def __init__(self, problem: Problem) -> None:
        n, k = problem.n_contacts, problem.width
        most = np.ones((n, k))  # of each component, with a normal force of 1
        most[:, 1:3] = problem.friction[:, None]
        if problem.torsional_friction is not None:
            most[:, 3] = problem.torsional_friction
        self._edges = most[:, :, None] * directions(k - 1).T  # (N, k, E)
        if problem.touching is not None:
            self._edges *= problem.touching[:, None, None]
        rows = np.concatenate([problem.matrix, problem.limit_matrix]).reshape(-1, n, k)
        self.columns = np.einsum("rnk,nke->rne", rows, self._edges).reshape(len(rows), -1)

    def force(self, weights: Array) -> Array:
        """Return the force (N k,) of the weights of all edges."""
        return np.einsum("nke,ne->nk", self._edges, weights.reshape(len(self._edges), -1)).ravel()


def directions(dimensions: int) -> Array:
    """Return the edges (E, 1 + dimensions) of a pyramid in a cone of slope 1, (1, unit vector)."""
    corners = np.array([each for each in product((-1.0, 0.0, 1.0), repeat=dimensions) if any(each)])
    lengths = np.sqrt((corners**2).sum(axis=1))
    return np.column_stack([np.ones(len(corners)), corners / lengths[:, None]])
