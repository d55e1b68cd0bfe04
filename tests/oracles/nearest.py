"""The balanced forces inside the friction cones that are nearest to given ones."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from grasp_env.grasp import Grasp


def nearest_forces(
    grasp: Grasp, wrench: np.ndarray, forces: np.ndarray, preload: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return forces (N, 3) and torsions (N,) by sequential quadratic programming, for isotropic
    friction; a torsion counts as the tangential force that uses as much of the friction."""
    count = len(forces)
    mu = grasp.friction
    gamma = grasp.models.torsional_friction
    soft = gamma > 0.0
    per = np.where(soft, mu / np.where(soft, gamma, 1.0), 0.0)
    turning = np.divide(1.0, per, out=np.zeros(count), where=soft)
    given = np.hstack([forces, np.zeros((count, 1))])
    matrix = np.hstack([grasp.matrix, grasp.contacts.torsion_matrix * turning])
    scale = np.repeat([1.0, 1.0 / grasp.length], 3)

    def flat(x: np.ndarray) -> np.ndarray:
        rows = x.reshape(count, 4)
        return np.concatenate([rows[:, :3].reshape(-1), rows[:, 3]])

    def room(x: np.ndarray) -> np.ndarray:
        rows = x.reshape(count, 4)
        sides = np.sqrt((rows[:, 1:] ** 2).sum(axis=1) + 1e-16)
        return mu * (rows[:, 0] - preload) - sides

    answer = minimize(
        lambda x: 0.5 * ((x - given.reshape(-1)) ** 2).sum(),
        given.reshape(-1),
        jac=lambda x: x - given.reshape(-1),
        constraints=[
            {"type": "eq", "fun": lambda x: scale * (matrix @ flat(x) + wrench)},
            {"type": "ineq", "fun": room},
        ],
        bounds=[
            (None, None) if k < 3 or soft[i] else (0.0, 0.0) for i in range(count) for k in range(4)
        ],
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    rows = answer.x.reshape(count, 4)
    return rows[:, :3], rows[:, 3] * turning
