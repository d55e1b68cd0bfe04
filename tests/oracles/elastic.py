"""The force inside the cones that nearly balances a wrench, where contacts cannot; one that exceeds limits least, where it must."""

from __future__ import annotations

import numpy as np
from oracles.boundary import longest_step
from oracles.phi import gradient, hessian, phi
from scipy.optimize import minimize


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


def penalised(force: np.ndarray, normals: np.ndarray, friction: float, most: np.ndarray, weight: float = 0.01) -> float:
    """Phi (omega 1) of forces (N, 3) on normals (N, 3) of length one, plus the elastic barriers of normal forces up to `most` (N,).

    Below 0.1 sqrt(weight), the barrier weight / slack goes on as a parabola with the same value, slope and curvature.
    """
    u = friction * (force * normals).sum(1)
    s = np.sqrt(((force - (u / friction)[:, None] * normals) ** 2).sum(1))
    edge = 0.1 * np.sqrt(weight)
    slack = friction * most - u
    below = np.minimum(slack - edge, 0.0) / edge
    barrier = weight / np.maximum(slack, edge) * (1.0 - below + below**2)
    inside = bool((s < u).all())
    return float((3.0 * u + weight * (1.0 / u + 1.0 / (u - s) + 1.0 / (u + s)) + barrier).sum()) if inside else np.inf


def excess(force: np.ndarray, normals: np.ndarray, most: np.ndarray) -> float:
    """Sum of the squared excesses of the normal forces [N^2]."""
    return float((np.maximum((force * normals).sum(1) - most, 0.0) ** 2).sum())


def least_excess(
    force: np.ndarray, normals: np.ndarray, friction: float, most: np.ndarray, balance: np.ndarray
) -> np.ndarray | None:
    """Another force of least `excess` in the cones with the wrench balance (6, 3N) @ force, by SLSQP from `force`; None: not found."""

    def room(flat: np.ndarray) -> np.ndarray:
        pressure = (flat.reshape(force.shape) * normals).sum(1)
        across = ((flat.reshape(force.shape) - pressure[:, None] * normals) ** 2).sum(1)
        return np.concatenate([(friction * pressure) ** 2 - across, pressure])

    def missed(flat: np.ndarray) -> np.ndarray:
        return balance @ (flat - force.ravel())

    def cost(flat: np.ndarray) -> float:
        return excess(flat.reshape(force.shape), normals, most)

    rules = [{"type": "ineq", "fun": room}, {"type": "eq", "fun": missed}]
    found = minimize(cost, force.ravel(), constraints=rules, method="SLSQP", options={"maxiter": 300})
    good = room(found.x).min() > -1e-6 and np.abs(missed(found.x)).max() < 1e-6
    return found.x.reshape(force.shape) if good else None
