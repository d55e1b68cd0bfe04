"""The description matrix P and cone coordinates (paper, Eqs. 4, 5 and 18).

P_i = [[u, 0, o], [0, u, t], [o, t, u]] with u = mu * normal; P_i > 0 exactly when the force lies
strictly inside the friction cone sqrt(o^2 + t^2) < mu * normal. Eigenvalues: u, u + s, u - s with s
= sqrt(o^2 + t^2).

| paper | here |
|---|---|
| VP | cone coordinates x = (u, o, t) per contact, `Grasp.to_cone` |
| P | `description_matrix` |
| Q, Q_bar, VWP | the core's `projection.hpp`; plain in `tests/oracles/full_flow.py`, `reduced_flow.py` |
| alpha_k | step size, the rules of `step_size` |
| W_p = omega I, W_i = lambda I | `force_weight`, `barrier_weight` of `Objective` |
"""

from __future__ import annotations

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, ContactForces, as_array

METRIC = np.array([3.0, 2.0, 2.0])
"""Metric of the flows: |P|_F^2 = 3 u^2 + 2 o^2 + 2 t^2 per contact."""


def description_matrix(force: ContactForces, friction: Array) -> Array:
    """Return P (3N, 3N), Eqs. 4 and 5, of `force` (N, 3) [N] and `friction`, a number or (N,).

    Example:
        >>> description_matrix(np.array([[10.0, 1.0, 2.0]]), np.array([0.4]))
        array([[4., 0., 1.],
               [0., 4., 2.],
               [1., 2., 4.]])
    """
    x = _forces(force, friction)
    matrix = np.zeros((3 * len(x), 3 * len(x)))
    for k, (u, o, t) in enumerate(x):
        matrix[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = [[u, 0.0, o], [0.0, u, t], [o, t, u]]
    return matrix


def _forces(force: ContactForces, friction: Array) -> Array:
    """Return (N, 3) cone coordinates (u, o, t) of forces in round cones."""
    x = as_array(force, (None, 3), "force", ranges.SIZE)
    if not 1 <= len(x) <= ranges.CONTACTS:
        raise InvalidInputError(
            f"force must have 1 to {ranges.CONTACTS} contacts, got shape {x.shape}"
        )
    mu = as_array(friction, None, "friction", ranges.Range(0.0, ranges.FRICTION.high))
    if mu.shape not in ((), (len(x),)):
        raise InvalidInputError(
            f"friction must be a number or one per contact, ({len(x)},), got shape {mu.shape}"
        )
    x[:, 0] *= mu
    return x
