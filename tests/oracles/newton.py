"""Newton on Phi under balance G x + w = 0, by the dense KKT system, and what follows from it.

x (w N,) holds the cone coordinates of every contact, w = 3 or 4 numbers each, and matrix (6, w N)
is G; weights (N, 3) are those of `phi.py`.
"""

from __future__ import annotations

import numpy as np
from oracles.boundary import longest_step
from oracles.phi import gradient, hessian, phi


def newton_step(
    x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """(step (w N,), multipliers (6,), squared decrement -grad .

    step) of min Phi s.t. G (x + step) + w = 0, from x strictly inside.
    """
    return kkt_step(gradient(x, weights), hessian(x, weights), matrix, matrix @ x + wrench)


def kkt_step(
    slope: np.ndarray, full: np.ndarray, matrix: np.ndarray, missed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """The same from the gradient (n,), the Hessian (n, n), matrix (6, n), and what balance misses
    (6,)."""
    size = len(slope)
    kkt = np.block([[full, -matrix.T], [matrix, np.zeros((6, 6))]])
    # rows of one size: near the cone's surface those of H differ by many powers of ten
    scale = np.sqrt(np.concatenate([1.0 / np.diag(kkt)[:size], np.ones(6)]))
    scale[size:] = 1.0 / np.sqrt(((matrix * scale[:size]) ** 2).sum(axis=1))
    scaled = scale[:, None] * kkt * scale
    right = -scale * np.concatenate([slope, missed])
    first = solve(scaled, right)
    found = scale * (first + solve(scaled, right - scaled @ first))
    return found[:size], found[size:], float(-slope @ found[:size])


def solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Gauss with pivots, in the type that it is given: numpy's own has no long double."""
    a = np.column_stack([matrix, right])
    size = len(matrix)
    for k in range(size):
        best = k + int(np.abs(a[k:, k]).argmax())
        a[[k, best]] = a[[best, k]]
        a[k + 1 :, k:] -= np.outer(a[k + 1 :, k] / a[k, k], a[k, k:])
    for k in range(size - 1, -1, -1):
        a[k, size] = (a[k, size] - a[k, k + 1 : size] @ a[k + 1 :, size]) / a[k, k]
    return a[:, size]


def tangent_correction(
    x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return x - H^-1 G^T S^-1 (G x + w), S = G H^-1 G^T: balance by the least change in the metric
    of the Hessian of Phi at x."""
    spread = np.linalg.solve(hessian(x, weights), matrix.T)
    return x - spread @ np.linalg.solve(matrix @ spread, matrix @ x + wrench)


def minimum(
    rest: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(argmin Phi, multipliers), from -G^+ w and enough of `rest`, an internal force strictly
    inside: every step is balanced."""
    x = balanced(np.zeros_like(rest), matrix, wrench)
    size = 1.0
    while phi(x + size * rest, weights) == np.inf:
        size *= 2.0
    return descent(x + size * rest, matrix, wrench, weights)


def balanced(x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """x with G x + w = 0 by the least change in cone coordinates; twice, for the last digits."""
    for _ in range(2):
        x = x - np.linalg.lstsq(matrix, matrix @ x + wrench, rcond=None)[0]
    return x


def descent(
    x: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(argmin Phi, multipliers) by damped Newton from a balanced x strictly inside, until Phi falls
    no more.

    In long double: close to the cones' surfaces, where optima are, Hessians have condition numbers
    of 1e18.
    """
    x = x.astype(np.longdouble)
    matrix = matrix.astype(np.longdouble)
    wrench = wrench.astype(np.longdouble)
    for _ in range(500):
        step, multipliers, decrement = newton_step(x, matrix, wrench, weights)
        alpha = min(1.0, 0.9 * longest_step(x, step, len(x) // len(weights)))
        value = phi(x, weights)
        if decrement < 1e-18 * value:
            return (x + alpha * step).astype(float), multipliers.astype(float)
        while (
            alpha > 1e-9 and not phi(x + alpha * step, weights) < value - 1e-4 * alpha * decrement
        ):
            alpha *= 0.5
        x = x + alpha * step
    raise ArithmeticError("Newton does not end")


def internal_force(matrix: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(w N,) the optimum without a wrench, from the cones' axes; ArithmeticError without force
    closure."""
    x = np.zeros(matrix.shape[1])
    wide = len(x) // len(weights)
    nothing = np.zeros(6)
    x[::wide] = np.sqrt(weights[:, 1] / weights[:, 0])
    for _ in range(100):
        step = newton_step(x, matrix, nothing, weights)[0]
        x = x + min(1.0, 0.9 * longest_step(x, step, wide)) * step
        found = balanced(x, matrix, nothing)
        if phi(found, weights) < np.inf:
            return descent(found, matrix, nothing, weights)[0]
        if not np.abs(x).max() < 1e6:
            break
    raise ArithmeticError("no balanced force strictly inside the cones")


def twelve_basis(matrix: np.ndarray, weights: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(13, w N) the optima for the wrenches +e_1..+e_6, -e_1..-e_6 and for none, in cone coordinates
    (paper, Sec. III).

    matrix is that of wrenches as given (N, N m); rest an internal force strictly inside the cones.
    """
    loads = [*np.eye(6), *-np.eye(6)]
    return np.array([*(minimum(rest, matrix, load, weights)[0] for load in loads), rest])


def combine(basis: np.ndarray, wrench: np.ndarray, printed: bool = False) -> np.ndarray:
    """sum_k E_k f_k + max(0, 1 - sum_k E_k) f_rest with E_k = max(0, +-w_k): Eqs. 33, 34.

    `printed`: without the rest.
    """
    parts = np.concatenate([np.maximum(0.0, wrench), np.maximum(0.0, -wrench)])
    rest = 0.0 if printed else max(0.0, 1.0 - float(parts.sum()))
    return parts @ basis[:12] + rest * basis[12]
