"""An entrant in thirty lines: SciPy's SLSQP on the least sum of normal forces of hard contacts."""

import numpy as np
from scipy.optimize import minimize


class Mine:
    """`python -m benchmarks.force run --solver benchmarks/force/example.py:Mine`."""

    name = "mine"
    objectives = ("sum",)

    def setup(self, task):
        """Prepare a session: check that the problems are supported."""
        if task.first.width > 3 or len(task.first.limit_bound):
            raise NotImplementedError("hard contacts without limits")
        self.cost = np.tile([1.0, 0.0, 0.0], task.first.n_contacts)

    def solve(self, problem, start=None):
        """The force (3N,) along normal, o and t of i contact."""
        matrix = problem.matrix
        friction = problem.friction
        i = np.arange(problem.n_contacts)

        def cones(f):
            return friction * f[::3] - np.sqrt(f[1::3] ** 2 + f[2::3] ** 2 + 1e-16)

        def cones_jacobian(f):
            jacobian = np.zeros((len(i), len(i), 3))
            size = np.sqrt(f[1::3] ** 2 + f[2::3] ** 2 + 1e-16)
            jacobian[i, i] = np.stack([friction, -f[1::3] / size, -f[2::3] / size], axis=1)
            return jacobian.reshape(len(i), -1)

        f = -np.linalg.pinv(matrix) @ problem.wrench if start is None else np.array(start)
        f[::3] = np.maximum(f[::3], 1.1 * np.hypot(f[1::3], f[2::3]) / friction)
        balance = {
            "type": "eq",
            "fun": lambda f: matrix @ f + problem.wrench,
            "jac": lambda f: matrix,
        }
        inside = {"type": "ineq", "fun": cones, "jac": cones_jacobian}
        result = minimize(
            lambda f: (self.cost @ f, self.cost),
            f,
            jac=True,
            method="SLSQP",
            constraints=[balance, inside],
            options={"ftol": 1e-8, "maxiter": 300},
        )
        self.iterations = result.nit
        return result.x, None, "solved" if result.success else "failed"
