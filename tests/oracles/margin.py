"""A margin within the friction cones: a share m of friction, a preload s.

    sqrt((o / mu_o)^2 + (t / mu_t)^2 + (torsion / gamma)^2) <= m (n - s)

f - s n lies in the cones of the friction m mu and m gamma, and balances a shifted wrench within
shifted limits A f <= b. All is of the contacts that touch: forces (N, 4) are (normal, o, t,
torsion), G is (6, N, 4) and A (M, N, 4), zero where a contact transmits nothing; mu is (N, 2),
gamma (N,), 0 unless soft; s is (N,) [N].
"""

from __future__ import annotations

import numpy as np


def shifted_wrench(matrix: np.ndarray, wrench: np.ndarray, preload: np.ndarray) -> np.ndarray:
    """w + G s n, (6,): what f - s n balances."""
    return wrench + matrix[:, :, 0] @ preload


def shifted_bound(rows: np.ndarray, bound: np.ndarray, preload: np.ndarray) -> np.ndarray:
    """b - A s n, (M,): the limits of f - s n."""
    return bound - rows[:, :, 0] @ preload


def friction_used(force: np.ndarray, mu: np.ndarray, gamma: np.ndarray) -> np.ndarray:
    """The share (N,) of the given friction that a force uses; inf where it has tangential force or
    torsion without normal force."""
    used = []
    for f, pair, g in zip(force, mu, gamma, strict=True):
        used.append(_part(_across(f, pair, g), f[0]))
    return np.array(used)


def cone_margin(
    force: np.ndarray, mu: np.ndarray, gamma: np.ndarray, m: float, preload: np.ndarray
) -> float:
    """The least of mubar (m (n - s) - sqrt((o / mu_o)^2 + (t / mu_t)^2 + (torsion / gamma)^2)),
    mubar = sqrt(mu_o mu_t); n - s of a frictionless contact."""
    margins = []
    for f, pair, g, s in zip(force, mu, gamma, preload, strict=True):
        mean = np.sqrt(pair[0] * pair[1])
        margins.append((m * mean or 1.0) * (f[0] - s) - mean * _across(f, pair, g))
    return float(min(margins))


def proof_slacks(
    proof: tuple[np.ndarray, np.ndarray],
    limits: tuple[np.ndarray, np.ndarray],
    matrix: np.ndarray,
    wrench: np.ndarray,
    friction: tuple[np.ndarray, np.ndarray],
    margin: tuple[float, np.ndarray],
) -> tuple[float, float]:
    """(cones, balance) of a proof (v, y) with limits (A, b), friction (mu, gamma), margin (m, s).

    q = G^T v + A^T y lies in the dual cones, q_n >= m sqrt((mu_o q_o)^2 + (mu_t q_t)^2 + (gamma
    q_torsion)^2), and v . (w + G s n) > y . (b - A s n), with y >= 0. Both slacks are relative to
    the largest terms, and not negative but for rounding; the sides of the second are equal where
    the shifted wrench is zero.
    """
    (twist, multipliers), (rows, bound), (mu, gamma), (m, preload) = proof, limits, friction, margin
    assert (multipliers >= 0.0).all()
    pushed = np.einsum("rna,r->rna", matrix, twist)
    limited = multipliers[:, None, None] * rows
    q = pushed.sum(axis=0) + limited.sum(axis=0)
    least = m * np.sqrt(((np.column_stack([mu, gamma]) * q[:, 1:]) ** 2).sum(axis=1))
    size = max(np.abs(pushed).max(), np.abs(limited).max(initial=0.0))
    work = twist @ shifted_wrench(matrix, wrench, preload)
    price = multipliers @ shifted_bound(rows, bound, preload)
    terms = np.abs(twist) @ np.abs(wrench) + (np.abs(pushed[:, :, 0]) @ preload).sum()
    terms += multipliers @ (np.abs(bound) + np.abs(rows[:, :, 0]) @ preload)
    return float((q[:, 0] - least).min() / size), float((work - price) / (terms or 1.0))


def _across(force: np.ndarray, mu: np.ndarray, gamma: float) -> float:
    """sqrt((o / mu_o)^2 + (t / mu_t)^2 + (torsion / gamma)^2)."""
    parts = (_part(part, most) for part, most in zip(force[1:], (*mu, gamma), strict=True))
    return float(np.sqrt(sum(part**2 for part in parts)))


def _part(part: float, whole: float) -> float:
    """part / whole; 0 for no part, inf for a part of nothing."""
    if part == 0.0:
        return 0.0
    return part / whole if whole != 0.0 else np.inf
