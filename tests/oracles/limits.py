"""Newton on Phi within limits A x <= b, by the dense KKT system: Phi gains weight / (b - A x) for each row."""

from __future__ import annotations

import numpy as np
from oracles.boundary import longest_step
from oracles.newton import solve
from oracles.phi import gradient, hessian, phi


def limited_phi(x: np.ndarray, weights: np.ndarray, rows: np.ndarray, bound: np.ndarray, row_weights: np.ndarray):
    """Phi and the rows' terms; +inf outside.

    Example:
        >>> x, weights = np.array([0.5, 0.0, 0.0]), np.array([[1.0, 0.01]])
        >>> float(limited_phi(x, weights, np.array([[1.0, 0.0, 0.0]]), np.array([1.0]), np.array([0.02])))
        1.6
    """
    slack = bound - rows @ x
    return phi(x, weights) + (row_weights / slack).sum() if (slack > 0.0).all() else np.inf


def minimum(
    x: np.ndarray,
    matrix: np.ndarray,
    weights: np.ndarray,
    rows: np.ndarray,
    bound: np.ndarray,
    row_weights: np.ndarray,
) -> np.ndarray | None:
    """argmin from a balanced x strictly inside the cones, anywhere to the limits: those are raised as far as x asks, and lowered as far as
    each optimum allows. None: they cannot be lowered all the way.
    """
    x, matrix, rows = x.astype(np.longdouble), matrix.astype(np.longdouble), rows.astype(np.longdouble)
    for _ in range(60):
        excess = max(0.0, float((rows @ x - bound).max(initial=0.0)))
        raised = 0.0 if excess == 0.0 else 1.2 * excess + 1e-3
        x = _descent(x, matrix, weights, rows, bound + raised, row_weights)
        if raised == 0.0:
            return x.astype(float)
    return None


def _descent(x, matrix, weights, rows, bound, row_weights) -> np.ndarray:
    """Damped Newton that keeps G x, until Phi falls no more."""
    size, value = len(x), limited_phi(x, weights, rows, bound, row_weights)
    for _ in range(300):
        slack = bound - rows @ x
        slope = gradient(x, weights) + rows.T @ (row_weights / slack**2)
        full = hessian(x, weights) + rows.T @ ((2.0 * row_weights / slack**3)[:, None] * rows)
        kkt = np.block([[full, -matrix.T], [matrix, np.zeros((6, 6))]])
        scale = np.sqrt(np.concatenate([1.0 / np.diag(kkt)[:size], np.ones(6)]))
        scale[size:] = 1.0 / np.sqrt(((matrix * scale[:size]) ** 2).sum(axis=1))
        step = (scale * solve(scale[:, None] * kkt * scale, -scale * np.concatenate([slope, np.zeros(6)])))[:size]
        decrement = float(-slope @ step)
        ahead = rows @ step
        alpha = min(1.0, 0.9 * longest_step(x, step), *(0.9 * slack[ahead > 0.0] / ahead[ahead > 0.0]))
        if decrement < 1e-18 * value:
            return x
        while alpha > 1e-9 and not limited_phi(x + alpha * step, weights, rows, bound, row_weights) < value:
            alpha *= 0.5
        if alpha <= 1e-9:
            return x
        x = x + alpha * step
        value = limited_phi(x, weights, rows, bound, row_weights)
    raise ArithmeticError("Newton does not end")
