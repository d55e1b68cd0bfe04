"""SciPy's SLSQP on the primal: what people do first, for few contacts."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from grasp_env._check import Array, Wrench
from training.peers.problem import best_times

_ROUND = 1e-16
"""[N^2] under the root: a gradient at the apex of a cone."""


class Slsqp:
    """SLSQP with exact Jacobians from the least-norm force, its u lifted into the cones.

    The cones are written u - sqrt(o^2 + t^2) >= 0: from the same start, u^2 - o^2 - t^2 >= 0 ends as a success far
    from the optimum on some wrenches.

    Args:
        cone_matrix: A, (6, 3N).
        cost: c, (N,).
        tolerance: SLSQP's ftol [N].
    """

    def __init__(self, cone_matrix: Array, cost: Array, tolerance: float = 1e-8) -> None:
        self._matrix, self._count = cone_matrix, len(cost)
        self._pseudoinverse = np.linalg.pinv(cone_matrix)
        self._objective = np.zeros(3 * len(cost))
        self._objective[::3] = cost
        self._each = np.arange(len(cost))
        self._options = {"ftol": tolerance, "maxiter": 300}
        self._cones = {"type": "ineq", "fun": self._slack, "jac": self._slack_jacobian}

    def solve(self, wrench: Wrench) -> Array:
        """See `Solver`."""
        start = -self._pseudoinverse @ wrench
        contacts = start.reshape(-1, 3)
        contacts[:, 0] = np.maximum(contacts[:, 0], 1.1 * np.hypot(contacts[:, 1], contacts[:, 2]))
        balance = {"type": "eq", "fun": lambda x: self._matrix @ x + wrench, "jac": lambda x: self._matrix}
        answer = minimize(
            lambda x: self._objective @ x,
            start,
            jac=lambda x: self._objective,
            method="SLSQP",
            constraints=[balance, self._cones],
            options=self._options,
        )
        return answer.x if answer.success else np.full_like(start, np.nan)

    def times(self, wrenches: Array, repeats: int) -> Array:
        """See `best_times`."""
        return best_times(self.solve, wrenches, repeats)

    def _slack(self, x: Array) -> Array:
        contacts = x.reshape(-1, 3)
        return contacts[:, 0] - np.sqrt(contacts[:, 1] ** 2 + contacts[:, 2] ** 2 + _ROUND)

    def _slack_jacobian(self, x: Array) -> Array:
        tangents = x.reshape(-1, 3)[:, 1:]
        jacobian = np.zeros((self._count, self._count, 3))
        jacobian[self._each, self._each, 0] = 1.0
        jacobian[self._each, self._each, 1:] = -tangents / np.sqrt((tangents**2).sum(axis=1) + _ROUND)[:, None]
        return jacobian.reshape(self._count, -1)
