"""The description matrix P, cone coordinates and the cone margin (paper, Eqs. 4, 5 and 18).

P_i = [[u, 0, o], [0, u, t], [o, t, u]] with u = mu * normal; P_i > 0 exactly when the force lies strictly inside the
friction cone sqrt(o^2 + t^2) < mu * normal. Eigenvalues: u, u + s, u - s with s = sqrt(o^2 + t^2).

| paper | here |
|---|---|
| VP | cone coordinates x = (u, o, t) per contact, `Grasp.to_cone` |
| P | `description_matrix` |
| Q, Q_bar, VWP | the core's `projection.hpp`; plain in `tests/oracles/full_flow.py`, `reduced_flow.py` |
| alpha_k | step size, the rules of `step_size` |
| W_p = omega I, W_i = lambda I | `Objective.force_weight`, `Objective.barrier_weight` |
"""

from __future__ import annotations

import numpy as np

from grasp_env._check import Array, ContactForces

METRIC = np.array([3.0, 2.0, 2.0])
"""|P|_F^2 = 3 u^2 + 2 o^2 + 2 t^2 per contact: the metric of the flows."""


def description_matrix(force: ContactForces, friction: Array) -> Array:
    """P, the (3N, 3N) block-diagonal description matrix of forces (N, 3) (Eqs. 4 and 5).

    Example:
        >>> description_matrix(np.array([[10.0, 1.0, 2.0]]), np.array([0.4]))
        array([[4., 0., 1.],
               [0., 4., 2.],
               [1., 2., 4.]])
    """
    x = np.array(force, dtype=np.float64)
    x[:, 0] *= friction
    matrix = np.zeros((3 * len(x), 3 * len(x)))
    for k, (u, o, t) in enumerate(x):
        matrix[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = [[u, 0.0, o], [0.0, u, t], [o, t, u]]
    return matrix


def cone_margin(force: ContactForces, friction: Array) -> float:
    """Min over contacts of mu * normal - sqrt(o^2 + t^2) [N]: the least eigenvalue of P; > 0 strictly inside.

    Example:
        >>> cone_margin(np.array([[10.0, 3.0, 0.0]]), np.array([0.4]))
        1.0
    """
    force = np.asarray(force)
    return float((friction * force[:, 0] - np.sqrt(force[:, 1] ** 2 + force[:, 2] ** 2)).min())
