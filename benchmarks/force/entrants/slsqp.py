"""SciPy's SLSQP, a common first choice, on the original problem."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.problems import BARRIER_WEIGHT, Array, Problem

ROUND = 1e-16
"""Added under the root [N^2], so that the apex of a cone has a gradient."""


class Slsqp:
    """Sequential quadratic programming with exact Jacobians."""

    name = "slsqp"
    note = "scipy.optimize.minimize, exact Jacobians, ftol 1e-8, from the least-norm force lifted into the cones or from the last force."

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        self._objective = _phi if task.objective == "phi" else _sum

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """See `Entrant`."""
        on, k = problem.active, problem.width
        mu = problem.friction[on]
        columns = np.repeat(on, k)
        matrix = problem.matrix[:, columns]
        bound = problem.limit_bound
        limits = problem.limit_matrix[:, columns]
        # torsions are divided by their levers: like tangential forces
        scale = np.ones((problem.n_contacts, k))
        if k == 4:
            scale[:, 3] = problem.lever
        scale = scale.ravel()[columns]
        matrix = matrix * scale
        limits = limits * scale
        if start is not None:
            begin = np.divide(start[columns], scale, out=np.zeros(len(scale)), where=scale > 0.0)
        else:
            begin = -np.linalg.pinv(matrix) @ problem.wrench
        begin[::k] = np.maximum(begin[::k], 1.1 * _sideways(begin, k) / mu)
        constraints = [
            {"type": "eq", "fun": lambda x: matrix @ x + problem.wrench, "jac": lambda x: matrix},
            {"type": "ineq", "fun": _room, "jac": _room_jacobian, "args": (mu, k)},
            {"type": "ineq", "fun": lambda x: bound - limits @ x, "jac": lambda x: -limits},
        ]
        result = minimize(
            self._objective,
            begin,
            (mu, k),
            "SLSQP",
            jac=True,
            constraints=constraints,
            options={"ftol": 1e-8, "maxiter": 300},
        )
        self.iterations = result.nit
        force = np.zeros(problem.matrix.shape[1])
        force[columns] = result.x * scale
        return force, None, "solved" if result.success else "failed"


def _sideways(x: Array, k: int) -> Array:
    return np.sqrt((x.reshape(-1, k)[:, 1:] ** 2).sum(axis=1) + ROUND)


def _room(x: Array, mu: Array, k: int) -> Array:
    # with mu^2 n^2 - o^2 - t^2 >= 0 it reports success far from the optimum on some wrenches
    return mu * x[::k] - _sideways(x, k)


def _room_jacobian(x: Array, mu: Array, k: int) -> Array:
    i = np.arange(len(mu))
    jacobian = np.zeros((len(mu), len(mu), k))
    jacobian[i, i, 0] = mu
    jacobian[i, i, 1:] = -x.reshape(-1, k)[:, 1:] / _sideways(x, k)[:, None]
    return jacobian.reshape(len(mu), -1)


def _sum(x: Array, mu: Array, k: int) -> tuple[float, Array]:
    gradient = np.zeros_like(x)
    gradient[::k] = 1.0
    return float(x[::k].sum()), gradient


def _phi(x: Array, mu: Array, k: int) -> tuple[float, Array]:
    u = mu * x[::k]
    o = x[1::k]
    t = x[2::k]
    room = u**2 - o**2 - t**2
    if min(u.min(), room.min()) <= 0.0:
        return np.inf, np.zeros_like(x)
    value = 3.0 * u + BARRIER_WEIGHT * (1.0 / u + 2.0 * u / room)
    by_u = 3.0 - BARRIER_WEIGHT * (1.0 / u**2 - 2.0 / room + 4.0 * (u / room) ** 2)
    by_square = 4.0 * BARRIER_WEIGHT * u / room**2
    return float(value.sum()), np.column_stack([mu * by_u, by_square * o, by_square * t]).ravel()
