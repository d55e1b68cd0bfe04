"""The force inside the cones that nearly balances a wrench, where contacts cannot."""

from __future__ import annotations

import numpy as np
from oracles.boundary import longest_step
from oracles.phi import gradient, hessian, phi


def elastic(x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray, softness: float) -> np.ndarray:
    """argmin Phi(x) + |G x + w|^2 / (2 softness), (3N,), by dense Newton from x strictly inside the cones."""

    def value(x: np.ndarray) -> float:
        missed = matrix @ x + wrench
        return phi(x, weights) + float(missed @ missed) / (2.0 * softness)

    for _ in range(300):
        slope = gradient(x, weights) + matrix.T @ (matrix @ x + wrench) / softness
        step = -np.linalg.solve(hessian(x, weights) + matrix.T @ matrix / softness, slope)
        if -slope @ step < 1e-16 * value(x):
            break
        alpha = min(1.0, 0.9 * longest_step(x, step))
        while alpha > 1e-12 and not value(x + alpha * step) < value(x):
            alpha *= 0.5
        x = x + alpha * step
    return x
