"""Phi, its derivatives and its dual bound (paper, Eqs. 10, 27-31), one contact after the other.

x (3N,) holds cone coordinates (u, o, t) of every contact, weights (N, 2) its omega and lambda.
"""

from __future__ import annotations

import numpy as np


def phi(x: np.ndarray, weights: np.ndarray) -> np.floating:
    """Sum of 3 omega u + lambda (1/u + 2u/(u^2 - o^2 - t^2)); +inf unless strictly inside every
    cone."""
    total = x.dtype.type(0.0)
    for (u, o, t), (omega, lam) in zip(x.reshape(-1, 3), weights, strict=True):
        d = determinant(u, o, t)
        if not (u > 0.0 and d > 0.0):
            return np.float64(np.inf)
        total += 3.0 * omega * u + lam * (1.0 / u + 2.0 * u / d)
    return total


def determinant(u: float, o: float, t: float) -> float:
    """u^2 - o^2 - t^2 as a product: the squares would cancel near the cone's surface."""
    s = np.hypot(o, t)
    return (u - s) * (u + s)


def gradient(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(3N,)."""
    out = []
    for (u, o, t), (omega, lam) in zip(x.reshape(-1, 3), weights, strict=True):
        d = determinant(u, o, t)
        s2 = o * o + t * t
        out += [3.0 * omega - lam * (1.0 / u**2 + 2.0 * (u**2 + s2) / d**2)]
        out += [4.0 * lam * u * o / d**2, 4.0 * lam * u * t / d**2]
    return np.array(out)


def hessian(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The dense Hessian, (3N, 3N)."""
    full = np.zeros((len(x), len(x)), dtype=x.dtype)
    for k, ((u, o, t), (_, lam)) in enumerate(zip(x.reshape(-1, 3), weights, strict=True)):
        d = determinant(u, o, t)
        s2 = o * o + t * t
        uu = 2.0 / u**3 + 4.0 * u * (u**2 + 3.0 * s2) / d**3
        uo = -4.0 * o * (3.0 * u**2 + s2) / d**3
        ut = -4.0 * t * (3.0 * u**2 + s2) / d**3
        oo = 4.0 * u / d**2 + 16.0 * u * o**2 / d**3
        tt = 4.0 * u / d**2 + 16.0 * u * t**2 / d**3
        ot = 16.0 * u * o * t / d**3
        full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = lam * np.array(
            [[uu, uo, ut], [uo, oo, ot], [ut, ot, tt]]
        )
    return full


def inverse_hessian(x: np.ndarray, omega: float, lam: float) -> np.ndarray:
    """Inverse of one contact's block, (3, 3), to the last digits of x's type, close to the surface
    too.

    In p = u + s and q = u - s, phi is lambda (2/(p+q) + 1/p + 1/q) and a linear part: its Hessian
    in that plane is lambda (diag(2/p^3, 2/q^3) + 4/(p+q)^3 (1, 1)(1, 1)^T), inverted after Sherman
    and Morrison. Across it the curvature is the slope along s divided by s, 4 lambda u / d^2.
    """
    plane, along, across = curvature(x, lam)
    back = np.array([[1, 1], [1, -1]]) / x.dtype.type(2)  # (p, q) -> (u, s)
    plane = back @ plane @ back.T
    side = np.array([-along[1], along[0]])
    full = np.zeros((3, 3), dtype=x.dtype)
    full[0, 0], full[0, 1:] = plane[0, 0], plane[0, 1] * along
    full[1:, 0] = full[0, 1:]
    full[1:, 1:] = plane[1, 1] * np.outer(along, along) + across * np.outer(side, side)
    return full


def curvature(x: np.ndarray, lam: float) -> tuple[np.ndarray, np.ndarray, np.floating]:
    """Inverse Hessian in p and q (2, 2), the direction of s in (o, t), the inverse curvature
    across; see `inverse_hessian`."""
    u, o, t = x
    s = np.hypot(o, t)
    along = np.array([o, t]) / s if s > 0.0 else np.array([1.0, 0.0])
    p = u + s
    q = u - s
    d = np.array([p**3 / 2, q**3 / 2]) / lam
    c = 4 * lam / (p + q) ** 3
    return (
        np.diag(d) - np.outer(d, d) * (c / (1 + c * d.sum())),
        along,
        (p * q) ** 2 / (4 * lam * u),
    )


def least_of_lagrangian(y: np.ndarray, omega: float, lam: float) -> tuple[float, float]:
    """(least over a cone of phi(x) - y .

    x, its ratio r = (u - s)/(u + s)); (-inf, nan) if there is none.

    With a = 3 omega - y_u, b = |(y_o, y_t)|, x = (u, s along y): the least over u at fixed r is
    2 sqrt(lambda c1 c2), c1 = ((a - b) + (a + b) r)/2, c2 = 1 + 1/r + 2/(1 + r), and over r it is
    stationary where (a + b) r^2 ((1 + r)^2 + 2) = (a - b) ((1 + r)^2 + 2 r^2). The roots of that
    quartic are then brought to the last digits of long double, so that a bound can be compared with
    this one to rounding.
    """
    a = np.longdouble(3.0) * omega - np.longdouble(y[0])
    b = np.hypot(np.longdouble(y[1]), np.longdouble(y[2]))
    if not a > b:
        return -np.inf, np.nan
    k = (a - b) / (a + b)
    roots = np.roots(np.array([1.0, 2.0, 3.0 - 3.0 * k, -2.0 * k, -k], dtype=float))
    r = np.longdouble(max(root.real for root in roots if abs(root.imag) < 1e-9))
    # numpy's roots are exact to 1e-16 of the largest one: halve the logarithm of what holds the
    # positive one
    low = np.sqrt(k / 3.0) * 0.99
    high = np.sqrt(k) * 1.01
    assert low <= r * 1.01 + 1e-7
    assert high >= r * 0.99 - 1e-7
    for _ in range(80):
        r = np.sqrt(low * high)
        q = 1.0 + r
        low, high = (low, r) if r * r * (q * q + 2.0) > k * (q * q + 2.0 * r * r) else (r, high)
    c1 = ((a - b) + (a + b) * r) / 2.0
    return float(2.0 * np.sqrt(lam * c1 * (1.0 + 1.0 / r + 2.0 / (1.0 + r)))), float(r)


def lower_bound(
    multipliers: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> float:
    """Least of the Lagrangian over all cones at nu (6,): no balanced force has a smaller Phi; -inf
    without information.

    matrix (6, 3N) is G in cone coordinates, wrench the external one, G x + w = 0; grad Phi = G^T nu
    at the optimum.
    """
    pull = (matrix.T @ multipliers).reshape(-1, 3)
    parts = [
        least_of_lagrangian(y, omega, lam)[0] for y, (omega, lam) in zip(pull, weights, strict=True)
    ]
    return float(sum(parts) - multipliers @ wrench)
