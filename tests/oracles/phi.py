"""Phi, its derivatives and its dual bound (paper, Eqs. 10, 27-31), one contact after the other.

x (w N,) holds cone coordinates (u, o, t) of every contact, or (u, o, t, v) with v = mu torsion /
gamma, w = 3 or 4. weights (N, 3) holds its omega, its lambda and axial = k - 1, where k is its
number of tangential parts: 0 without friction, 2 of hard contacts, 3 of soft ones. Parts that a
contact does not transmit are zero. Weights (N, 2) are those of hard contacts.

The barrier is lambda tr P^-1 of the arrow matrix P with u on its diagonal and the tangential parts
y beside it. Its eigenvalues are u - |y|, u + |y| and, k - 1 times, u.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def phi(x: np.ndarray, weights: np.ndarray) -> np.floating:
    """Sum of 3 omega u + lambda (axial/u + 2u/(u^2 - |y|^2)); +inf unless strictly inside every
    cone."""
    total = x.dtype.type(0.0)
    for u, y, omega, lam, axial in contacts(x, weights):
        d = determinant(u, y)
        if not (u > 0.0 and d > 0.0):
            return np.float64(np.inf)
        total += 3.0 * omega * u + lam * (axial / u + 2.0 * u / d)
    return total


def contacts(
    x: np.ndarray, weights: np.ndarray
) -> Iterator[tuple[float, np.ndarray, float, float, float]]:
    """u, y (2,) or (3,), omega, lambda and axial of every contact."""
    rows = x.reshape(len(weights), -1)
    assert rows.shape[1] in (3, 4)
    for row, weight in zip(rows, weights, strict=True):
        omega, lam, axial = weight if len(weight) == 3 else (*weight, 1.0)
        yield row[0], row[1:], omega, lam, axial


def determinant(u: float, y: np.ndarray) -> float:
    """u^2 - |y|^2 as a product: the squares would cancel near the cone's surface."""
    s = np.hypot.reduce(y)
    return (u - s) * (u + s)


def gradient(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(w N,)."""
    out = []
    for u, y, omega, lam, axial in contacts(x, weights):
        d = determinant(u, y)
        out += [3.0 * omega - lam * (axial / u**2 + 2.0 * (u**2 + y @ y) / d**2)]
        out += [*(4.0 * lam * u * y / d**2)]
    return np.array(out)


def hessian(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The dense Hessian, (w N, w N)."""
    full = np.zeros((len(x), len(x)), dtype=x.dtype)
    wide = len(x) // len(weights)
    for k, (u, y, _, lam, axial) in enumerate(contacts(x, weights)):
        d = determinant(u, y)
        s2 = y @ y
        block = np.zeros((wide, wide), dtype=x.dtype)
        block[0, 0] = 2.0 * axial / u**3 + 4.0 * u * (u**2 + 3.0 * s2) / d**3
        block[0, 1:] = block[1:, 0] = -4.0 * y * (3.0 * u**2 + s2) / d**3
        block[1:, 1:] = 4.0 * u / d**2 * np.eye(len(y)) + 16.0 * u * np.outer(y, y) / d**3
        full[wide * k : wide * (k + 1), wide * k : wide * (k + 1)] = lam * block
    return full


def inverse_hessian(x: np.ndarray, omega: float, lam: float, axial: float = 1.0) -> np.ndarray:
    """Inverse of one contact's block, (w, w), to the last digits of x's type, close to the surface
    too.

    In p = u + s and q = u - s, phi is lambda (2 axial/(p+q) + 1/p + 1/q) and a linear part: its
    Hessian in that plane is lambda (diag(2/p^3, 2/q^3) + 4 axial/(p+q)^3 (1, 1)(1, 1)^T), inverted
    after Sherman and Morrison. Across it the curvature is the slope along s divided by s, 4 lambda
    u / d^2.
    """
    plane, along, across = curvature(x, lam, axial)
    back = np.array([[1, 1], [1, -1]]) / x.dtype.type(2)  # (p, q) -> (u, s)
    plane = back @ plane @ back.T
    full = np.zeros((len(x), len(x)), dtype=x.dtype)
    full[0, 0], full[0, 1:] = plane[0, 0], plane[0, 1] * along
    full[1:, 0] = full[0, 1:]
    full[1:, 1:] = plane[1, 1] * np.outer(along, along)
    for side in sides(along):
        full[1:, 1:] += across * np.outer(side, side)
    return full


def sides(along: np.ndarray) -> list[np.ndarray]:
    """The unit vectors across a unit vector of 2 or 3 numbers."""
    if len(along) == 2:
        return [np.array([-along[1], along[0]])]
    axis = np.zeros_like(along)
    axis[np.argmin(np.abs(along))] = 1.0
    one = np.cross(along, axis)
    one /= np.sqrt(one @ one)
    return [one, np.cross(along, one)]


def curvature(
    x: np.ndarray, lam: float, axial: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.floating]:
    """Inverse Hessian in p and q (2, 2), the direction of y, the inverse curvature across; see
    `inverse_hessian`."""
    u, y = x[0], x[1:]
    s = np.hypot.reduce(y)
    along = y / s if s > 0.0 else np.eye(len(y), dtype=x.dtype)[0]
    p = u + s
    q = u - s
    d = np.array([p**3 / 2, q**3 / 2]) / lam
    c = 4 * lam * axial / (p + q) ** 3
    return (
        np.diag(d) - np.outer(d, d) * (c / (1 + c * d.sum())),
        along,
        (p * q) ** 2 / (4 * lam * u),
    )


def least_of_lagrangian(
    y: np.ndarray, omega: float, lam: float, axial: float = 1.0
) -> tuple[float, float]:
    """(least over a cone of phi(x) - y .

    x, its ratio r = (u - s)/(u + s)); (-inf, nan) if there is none.

    With a = 3 omega - y_u, b = |(y_o, y_t, y_v)|, x = (u, s along y): the least over u at fixed r
    is 2 sqrt(lambda c1 c2), c1 = ((a - b) + (a + b) r)/2, c2 = 1 + 1/r + m/(1 + r), m = 2 axial,
    and over r it is stationary where (a + b) r^2 ((1 + r)^2 + m) = (a - b) ((1 + r)^2 + m r^2). The
    roots of that quartic are then brought to the last digits of long double, so that a bound can be
    compared with this one to rounding. Without friction b is 0, and r is 1.
    """
    a = np.longdouble(3.0) * omega - np.longdouble(y[0])
    b = np.hypot.reduce(np.asarray(y[1:], dtype=np.longdouble))
    if not a > b:
        return -np.inf, np.nan
    if axial < 0.0:
        assert b == 0.0
        return float(2.0 * np.sqrt(lam * a)), 1.0
    m = 2.0 * axial
    k = (a - b) / (a + b)
    quartic = [1.0, 2.0, (1.0 + m) * (1.0 - k), -2.0 * k, -k]
    roots = np.roots(np.array(quartic, dtype=float))
    r = np.longdouble(max(root.real for root in roots if abs(root.imag) < 1e-9))
    # numpy's roots are exact to 1e-16 of the largest one: halve the logarithm of what holds the
    # positive one
    low = np.sqrt(k / (1.0 + m)) * 0.99
    high = np.sqrt(k) * 1.01
    assert low <= r * 1.01 + 1e-7
    assert high >= r * 0.99 - 1e-7
    for _ in range(80):
        r = np.sqrt(low * high)
        q = 1.0 + r
        low, high = (low, r) if r * r * (q * q + m) > k * (q * q + m * r * r) else (r, high)
    c1 = ((a - b) + (a + b) * r) / 2.0
    return float(2.0 * np.sqrt(lam * c1 * (1.0 + 1.0 / r + m / (1.0 + r)))), float(r)


def lower_bound(
    multipliers: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, weights: np.ndarray
) -> float:
    """Least of the Lagrangian over all cones at nu (6,): no balanced force has a smaller Phi; -inf
    without information.

    matrix (6, w N) is G in cone coordinates, wrench the external one, G x + w = 0; grad Phi = G^T nu
    at the optimum.
    """
    parts = []
    for u, y, *weight in contacts(matrix.T @ multipliers, weights):
        parts.append(least_of_lagrangian(np.array([u, *y]), *weight)[0])
    return float(sum(parts) - multipliers @ wrench)
