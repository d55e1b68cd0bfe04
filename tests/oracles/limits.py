"""Newton on Phi within limits A z <= b, by the dense KKT system: Phi gains weight / (b - A z) for
each row.

z (w N,) holds the cone coordinates of every contact, w = 3 or 4 numbers each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from oracles.boundary import longest_step
from oracles.newton import kkt_step
from oracles.phi import gradient, hessian, phi


class Terms(NamedTuple):
    """Phi of contacts with limits: weights (N, 3) of `phi.py`; rows A (M, w N), bound (M,) and weights
    of the rows (M,)."""

    weights: np.ndarray
    rows: np.ndarray
    bound: np.ndarray
    row_weights: np.ndarray

    def raised(self, by: float) -> Terms:
        """With limits wider by this."""
        return self._replace(bound=self.bound + by)


def value(z: np.ndarray, terms: Terms) -> np.floating:
    """+inf unless strictly inside."""
    slack = terms.bound - terms.rows @ z
    inside = (slack > 0.0).all()
    return phi(z, terms.weights) + (terms.row_weights / slack).sum() if inside else np.inf


def derivatives(z: np.ndarray, terms: Terms) -> tuple[np.ndarray, np.ndarray]:
    """(gradient (n,), Hessian (n, n))."""
    weights, rows, bound, row_weights = terms
    slack = bound - rows @ z
    slope = gradient(z, weights) + rows.T @ (row_weights / slack**2)
    full = hessian(z, weights) + rows.T @ ((2.0 * row_weights / slack**3)[:, None] * rows)
    return slope, full


def newton_step(
    z: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, terms: Terms
) -> tuple[np.ndarray, float]:
    """(step, squared decrement) with matrix (6, n) of z: the step ends in balance."""
    step, _, decrement = kkt_step(*derivatives(z, terms), matrix, matrix @ z + wrench)
    return step, decrement


def minimum(
    z: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, terms: Terms
) -> np.ndarray | None:
    """argmin from a balanced z strictly inside the cones, anywhere to the limits; long double.

    Limits are raised as far as z asks, and lowered as far as each optimum allows. None: they cannot
    be lowered all the way.
    """
    z = z.astype(np.longdouble)
    matrix = matrix.astype(np.longdouble)
    wrench = wrench.astype(np.longdouble)
    terms = terms._replace(rows=terms.rows.astype(np.longdouble))
    for _ in range(60):
        excess = max(0.0, float((terms.rows @ z - terms.bound).max(initial=-1.0)))
        raised = 0.0 if excess == 0.0 else 1.2 * excess + 1e-3
        z = _descent(z, matrix, wrench, terms.raised(raised))
        if raised == 0.0:
            return z.astype(float)
    return None


def _descent(z: np.ndarray, matrix: np.ndarray, wrench: np.ndarray, terms: Terms) -> np.ndarray:
    """Damped Newton until Phi falls no more."""
    wide = len(z) // len(terms.weights)
    here = value(z, terms)
    for _ in range(300):
        step, decrement = newton_step(z, matrix, wrench, terms)
        slack = terms.bound - terms.rows @ z
        ahead = terms.rows @ step
        far = (0.9 * slack[ahead > 0.0] / ahead[ahead > 0.0]).min(initial=np.inf)
        alpha = min(1.0, 0.9 * longest_step(z, step, wide), far)
        if decrement < 1e-18 * here:
            return z
        while alpha > 1e-9 and not value(z + alpha * step, terms) < here:
            alpha *= 0.5
        if alpha <= 1e-9:
            return z
        z = z + alpha * step
        here = value(z, terms)
    raise ArithmeticError("Newton does not end")
