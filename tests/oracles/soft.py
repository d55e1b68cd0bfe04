"""Newton on Phi with soft contacts, by the dense KKT system: each gains lambda (1/(u - v) + 1/(u + v)), abs(v) <= u its torsion.

z = (x, v): (3N,) cone coordinates, then (N,) torsions in units of their limits, zero where a contact is not soft.
"""

from __future__ import annotations

import numpy as np
from oracles.boundary import longest_step
from oracles.newton import solve
from oracles.phi import gradient, hessian, phi


def soft_phi(z: np.ndarray, weights: np.ndarray, soft: np.ndarray) -> np.floating:
    """+inf unless strictly inside.

    Example:
        >>> z, weights = np.array([0.5, 0.0, 0.0, 0.3]), np.array([[1.0, 0.01]])
        >>> round(float(soft_phi(z, weights, np.array([True]))), 4)
        1.6225
    """
    count = len(weights)
    x, u, v = z[: 3 * count], z[: 3 * count : 3][soft], z[3 * count :][soft]
    if not (np.abs(v) < u).all():
        return np.float64(np.inf)
    return phi(x, weights) + (weights[soft, 1] * (1.0 / (u - v) + 1.0 / (u + v))).sum()


def derivatives(z: np.ndarray, weights: np.ndarray, soft: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(gradient (4N,), Hessian (4N, 4N)); that of v is the identity where a contact is not soft."""
    count = len(weights)
    slope, full = np.zeros_like(z), np.eye(4 * count, dtype=z.dtype)
    slope[: 3 * count] = gradient(z[: 3 * count], weights)
    full[: 3 * count, : 3 * count] = hessian(z[: 3 * count], weights)
    for i in np.flatnonzero(soft):
        u, v, lam = z[3 * i], z[3 * count + i], weights[i, 1]
        full[3 * count + i, 3 * count + i] = 0.0
        for sign, r in ((-1.0, u - v), (1.0, u + v)):
            along = np.zeros_like(z)
            along[3 * i], along[3 * count + i] = 1.0, sign
            slope -= lam / r**2 * along
            full += 2.0 * lam / r**3 * np.outer(along, along)
    return slope, full


def newton_step(z, matrix, wrench, weights, soft) -> tuple[np.ndarray, np.ndarray, float]:
    """(step, multipliers, squared decrement) with matrix (6, 4N) of z: the step ends in balance."""
    size = len(z)
    slope, full = derivatives(z, weights, soft)
    kkt = np.block([[full, -matrix.T], [matrix, np.zeros((6, 6))]])
    scale = np.sqrt(np.concatenate([1.0 / np.diag(kkt)[:size], np.ones(6)]))
    scale[size:] = 1.0 / np.sqrt(((matrix * scale[:size]) ** 2).sum(axis=1))
    found = scale * solve(scale[:, None] * kkt * scale, -scale * np.concatenate([slope, matrix @ z + wrench]))
    return found[:size], found[size:], float(-slope @ found[:size])


def minimum(x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray, soft: np.ndarray) -> np.ndarray:
    """argmin from a balanced x strictly inside the cones, without torsion; long double."""
    count = len(weights)
    z = np.concatenate([x, np.zeros(count)]).astype(np.longdouble)
    matrix, wrench = matrix.astype(np.longdouble), wrench.astype(np.longdouble)
    for _ in range(300):
        step, _, decrement = newton_step(z, matrix, wrench, weights, soft)
        value = soft_phi(z, weights, soft)
        if decrement < 1e-18 * value:
            return (z + step).astype(float)
        alpha = min(1.0, 0.9 * longest_step(z[: 3 * count], step[: 3 * count]))
        while alpha > 1e-9 and not soft_phi(z + alpha * step, weights, soft) < value - 1e-4 * alpha * decrement:
            alpha *= 0.5
        z = z + alpha * step
    raise ArithmeticError("Newton does not end")
