"""Equality-constrained Newton steps on Phi: the plain twin of `kernels.newton_step` and of a step of `newton_kernels`."""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.force.objective import Objective


def newton_step(x: Array, cone_matrix: Array, wrench: Wrench, objective: Objective) -> tuple[Array, Array, float]:
    """The Newton step of min Phi s.t. G f + w = 0 at x, by the dense KKT system.

    Args:
        x: (3N,) cone coordinates, strictly inside.
        cone_matrix: (6, 3N) G in cone coordinates.
        wrench: (6,) external wrench.
        objective: Phi.

    Returns:
        (step (3N,), multipliers (6,), squared Newton decrement).
    """
    size = len(x)
    kkt = np.zeros((size + 6, size + 6))
    for k, block in enumerate(objective.hessian(x)):
        kkt[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    kkt[size:, :size] = cone_matrix
    kkt[:size, size:] = -cone_matrix.T
    gradient = objective.gradient(x)
    solution = np.linalg.solve(kkt, -np.concatenate([gradient, cone_matrix @ x + wrench])).astype(np.float64)
    step, multipliers = solution[:size], solution[size:]
    return step, multipliers, float(-(gradient - cone_matrix.T @ multipliers) @ step)
