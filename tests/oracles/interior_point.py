"""One dense interior-point iteration with limits and shared variables: the plain twin of the core's `interior_point.hpp`.

    min  c . x + d . t   s.t.  A x + g t = b,  x in K
    max -b . y           s.t.  s = c + A^T y in K,  g^T y + d = 0

K is a product of cones x_0 >= |(x_1, x_2)|, one a contact, and of rays x >= 0: w of soft contacts, slacks that turn limits
into equations. A ray is a cone of one number, and every formula below holds for it as it stands.

With p o q = (p . q, p_0 q_1 + q_0 p_1, p_0 q_2 + q_0 p_2) and e = (1, 0, 0), feasible x and s are optimal where x o s = 0.
Nesterov and Todd's W has W s = W^-1 x = l in every cone. A direction solves, for a right side h,

    A dx + g dt = b - A x - g t,   ds - A^T dy = c + A^T y - s,   g^T dy = -d - g^T y,   W^-1 dx + W ds = h

first with h = -l, straight at the optimum (the predictor). How far it gets says how much to centre, and its second-order
error is known, so the step taken has l o h = -l o l + mu e - (W^-1 dx) o (W ds) (Mehrotra's corrector).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class ConicProgram(NamedTuple):
    """A program and the rules by which a kernel steps through it.

    Attributes:
        matrix: A (m, n); right: b (m,); cost: c (n,).
        coupling: g (m, T); shared_cost: d (T,).
        sizes: numbers in each cone, 3 or 1; their sum is n.
        counted: how many of the cones, the first ones, make up the gap; the others only limit the steps.
        reach: (a, b): a step goes a + b min(predictor's steps) of the way to the boundary.
        floor: least part of the mean gap to aim at.
    """

    matrix: np.ndarray
    right: np.ndarray
    cost: np.ndarray
    coupling: np.ndarray
    shared_cost: np.ndarray
    sizes: tuple[int, ...]
    counted: int
    reach: tuple[float, float]
    floor: float


class Iterate(NamedTuple):
    """x (n,) and s (n,) strictly inside the cones, t (T,), y (m,)."""

    x: np.ndarray
    s: np.ndarray
    t: np.ndarray
    y: np.ndarray


def nt_step(program: ConicProgram, at: Iterate) -> Iterate:
    """The next iterate: predictor, centring, corrector, one step length for (x, t) and one for (s, y)."""
    a, b, c, g, d, sizes, counted, (near, nearer), floor = program
    x, s, t, y = at
    m, n, shared = len(b), len(x), len(d)
    ends = np.cumsum(sizes)
    cones = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    w, w_inverse, l_product, e = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    for k in cones:
        w[k, k] = scaling(x[k], s[k])
        w_inverse[k, k] = np.linalg.inv(w[k, k])
        l_product[k, k] = arrow(w[k, k] @ s[k])
        e[k.start] = 1.0
    scaled = w @ s
    kkt = np.block(
        [
            [a, np.zeros((m, n)), g, np.zeros((m, m))],
            [np.zeros((n, n)), np.eye(n), np.zeros((n, shared)), -a.T],
            [np.zeros((shared, 2 * n + shared)), g.T],
            [w_inverse, w, np.zeros((n, shared)), np.zeros((n, m))],
        ]
    )
    missed = np.concatenate([b - a @ x - g @ t, c + a.T @ y - s, -d - g.T @ y])

    def direction(h: np.ndarray) -> list[np.ndarray]:
        """(dx, ds, dt, dy)."""
        found = np.linalg.solve(kkt, np.concatenate([missed, h])).astype(np.float64)
        return np.split(found, [n, 2 * n, 2 * n + shared])

    def step(point: np.ndarray, move: np.ndarray, part: float) -> float:
        """`part` of the way to the boundary, at most 1."""
        return part / max(part, *(per_boundary(point[k], move[k]) for k in cones))

    def gap(primal: np.ndarray, dual: np.ndarray) -> float:
        return float(primal[: ends[counted - 1]] @ dual[: ends[counted - 1]])

    dx, ds, _, _ = direction(-scaled)
    primal, dual = step(x, dx, 1.0), step(s, ds, 1.0)
    left = min(1.0, max(gap(x + primal * dx, s + dual * ds), 0.0) / gap(x, s))
    # x o s = mu e has gap mu a cone: counting a contact's cone twice, as its barrier does, aims at half of that
    degree = sum(2 if size == 3 else 1 for size in sizes[:counted])
    target = max(left**3, floor) * gap(x, s) / degree
    second = np.concatenate([arrow((w_inverse @ dx)[k]) @ (w @ ds)[k] for k in cones])

    dx, ds, dt, dy = direction(-scaled + np.linalg.solve(l_product, target * e - second))
    part = near + nearer * min(primal, dual)
    primal, dual = step(x, dx, part), step(s, ds, part)
    return Iterate(x + primal * dx, s + dual * ds, t + primal * dt, y + dual * dy)


def arrow(p: np.ndarray) -> np.ndarray:
    """The matrix of q -> p o q."""
    matrix = p[0] * np.eye(len(p))
    matrix[0], matrix[:, 0] = p, p
    return matrix


def scaling(x: np.ndarray, s: np.ndarray) -> np.ndarray:
    """W, symmetric, with W s = W^-1 x, that maps the cone onto itself; W^2 = eta (2 v v^T - J), J = diag(1, -1, -1)."""
    j = np.array([1.0, -1.0, -1.0])[: len(x)]
    eta = np.sqrt((x @ (j * x)) / (s @ (j * s)))
    v = x + eta * j * s
    v = v / np.sqrt(v @ (j * v))
    w = np.eye(len(x)) + np.outer(v, v) / (1.0 + v[0])
    w[0], w[:, 0] = v, v
    return np.sqrt(eta) * w


def per_boundary(x: np.ndarray, d: np.ndarray) -> float:
    """1 / (the largest step that keeps x + a d in the cone), at least 0: W with W^2 e = x makes it e + a W^-2 d."""
    w = scaling(x, np.eye(len(x))[0])
    r = np.linalg.solve(w @ w, d)
    return max(0.0, float(np.linalg.norm(r[1:]) - r[0]))
