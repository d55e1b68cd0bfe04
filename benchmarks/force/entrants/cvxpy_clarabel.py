"""CVXPY with Clarabel, as most people would write the problem."""

from __future__ import annotations

from importlib import import_module

import numpy as np

from benchmarks.force.entrant import Answer, Task
from benchmarks.force.problems import BARRIER_WEIGHT, Array, Problem
from grasp_env.inputs.extras import need


class CvxpyClarabel:
    """A compiled CVXPY problem (DPP) whose parameters are set."""

    name = "cvxpy_clarabel"
    note = (
        "One CVXPY problem of a session, the wrench and, where contacts move, all data as parameters; Clarabel's default tolerances. "
        "Reviewer's note: most of a call is CVXPY's own work, and it gives no proof of infeasibility."
    )

    def setup(self, task: Task) -> None:
        """See `Entrant`."""
        self._objective = task.objective
        self._moving = False
        self._state(task.first)

    def solve(self, problem: Problem, start: Array | None = None) -> Answer:
        """See `Entrant`; `start` is not used, as Clarabel has no warm start."""
        if problem.moved and not self._moving:
            self._moving = True
            self._state(problem)
        for parameter, value in zip(self._parameters, self._data(problem), strict=False):
            parameter.value = value
        self._problem.solve(solver="CLARABEL")
        if self._force.value is None:
            return None, None, "infeasible" if self._problem.status == "infeasible" else "failed"
        self.iterations = self._problem.solver_stats.num_iters
        force = self._force.value.ravel()
        if problem.touching is not None:
            force *= np.repeat(problem.touching, problem.width)
        multipliers = [-self._balance.dual_value, *(limit.dual_value for limit in self._limits)]
        status = "solved" if self._problem.status == "optimal" else "failed"
        return force, np.concatenate(multipliers), status

    def _data(self, problem: Problem) -> tuple[Array, ...]:
        lever = problem.lever
        return (
            problem.wrench,
            problem.matrix,
            problem.friction,
            problem.limit_matrix,
            problem.limit_bound,
            np.divide(1.0, lever, out=np.ones(len(lever)), where=lever > 0.0),
        )

    def _state(self, problem: Problem) -> None:
        with need("cvxpy"):
            cp = import_module("cvxpy")
        data = self._data(problem)
        count = len(data) if self._moving else 1
        self._parameters = [cp.Parameter(array.shape) for array in data[:count]]
        wrench, matrix, friction, limits, bound, per_lever = [*self._parameters, *data[count:]]
        self._force = force = cp.Variable((problem.n_contacts, problem.width))
        x = cp.vec(force, order="C")
        u = cp.multiply(friction, force[:, 0])
        tangential = force[:, 1:3]
        self._balance = matrix @ x + wrench == 0
        self._limits = [limits @ x <= bound] if len(problem.limit_bound) else []
        across = [tangential]
        if problem.width == 4:  # a torsion over its lever is like a tangential force
            across.append(
                cp.reshape(cp.multiply(per_lever, force[:, 3]), (problem.n_contacts, 1), order="C")
            )
        cones = [cp.norm(cp.hstack(across), axis=1) <= u]
        hard = problem.lever == 0.0
        if problem.width == 4 and hard.any():
            cones.append(force[hard, 3] == 0.0)
        cost = cp.sum(force[:, 0])
        if self._objective == "phi":
            # 2 u / (u^2 - o^2 - t^2) is 2 / v with the largest v that u (u - v) >= o^2 + t^2 allows
            product = u
            v = cp.Variable(problem.n_contacts)
            u = cp.Variable(problem.n_contacts)  # with the product itself it is not DPP
            contacts = range(problem.n_contacts)
            inside = [cp.quad_over_lin(tangential[i], u[i]) <= u[i] - v[i] for i in contacts]
            cones = [u == product, *inside]
            cost = 3 * cp.sum(u) + BARRIER_WEIGHT * cp.sum(cp.inv_pos(u) + 2 * cp.inv_pos(v))
        self._problem = cp.Problem(cp.Minimize(cost), [self._balance, *self._limits, *cones])
