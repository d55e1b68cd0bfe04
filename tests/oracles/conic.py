"""One dense iteration of the interior-point method for the least weighted sum of normal forces: the
plain twin of `interior_point.hpp`.

    min  c . x   s.t.  A x = b,  x in K          max -b . y   s.t.  s = c + A^T y in K

K is a product of cones x_0 >= |(x_1, x_2)|, one a contact. With p o q = (p . q, p_0 q_1 + q_0 p_1,
p_0 q_2 + q_0 p_2) and e = (1, 0, 0), feasible x and s are optimal where x o s = 0. Nesterov and
Todd's W has W s = W^-1 x = l in every cone. A direction solves, for a right side h,

    A dx = b - A x,   ds - A^T dy = c + A^T y - s,   W^-1 dx + W ds = h

first with h = -l, straight at the optimum (the predictor). How far it gets says how much to centre,
and its second-order error is known, so the step taken has l o h = -l o l + mu e - (W^-1 dx) o (W
ds) (Mehrotra's corrector).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Program(NamedTuple):
    """A (m, n), b (m,), c (n,); a step goes a + b min(predictor's steps) of the way to the
    boundary, (a, b) = reach."""

    matrix: np.ndarray
    right: np.ndarray
    cost: np.ndarray
    reach: tuple[float, float] = (0.9, 0.095)


class Iterate(NamedTuple):
    """x and s (n,) strictly inside the cones, y (m,)."""

    x: np.ndarray
    s: np.ndarray
    y: np.ndarray


def of_grasp(
    matrix: np.ndarray, wrench: np.ndarray, divisor: np.ndarray, omega: np.ndarray
) -> Program:
    """The program of a grasp whose normal forces have the weights omega (N,), unit frame."""
    cost = np.zeros(matrix.shape[1])
    cost[0::3] = omega / divisor[:, 0]
    return Program(matrix, -wrench, cost)


def iteration(program: Program, at: Iterate) -> Iterate:
    """The next iterate: predictor, centring, corrector, one step length for x and one for (s, y)."""
    (a, b, c, (near, nearer)), (x, s, y) = program, at
    m, n = a.shape
    cones = [slice(k, k + 3) for k in range(0, n, 3)]
    w = np.zeros((n, n))
    w_inverse = np.zeros((n, n))
    l_product = np.zeros((n, n))
    e = np.zeros(n)
    for k in cones:
        w[k, k] = scaling(x[k], s[k])
        w_inverse[k, k] = np.linalg.inv(w[k, k])
        l_product[k, k] = arrow(w[k, k] @ s[k])
        e[k.start] = 1.0
    scaled = w @ s
    kkt = np.block(
        [
            [a, np.zeros((m, n + m))],
            [np.zeros((n, n)), np.eye(n), -a.T],
            [w_inverse, w, np.zeros((n, m))],
        ]
    )
    missed = np.concatenate([b - a @ x, c + a.T @ y - s])

    def direction(h: np.ndarray) -> list[np.ndarray]:
        """(dx, ds, dy)."""
        return np.split(np.linalg.solve(kkt, np.concatenate([missed, h])), [n, 2 * n])

    def step(point: np.ndarray, move: np.ndarray, part: float) -> float:
        """`part` of the way to the boundary, at most 1."""
        return part / max(part, *(per_boundary(point[k], move[k]) for k in cones))

    dx, ds, _ = direction(-scaled)
    primal = step(x, dx, 1.0)
    dual = step(s, ds, 1.0)
    left = min(1.0, max(float((x + primal * dx) @ (s + dual * ds)), 0.0) / float(x @ s))
    # x o s = mu e has gap mu a cone: counting each cone twice, as its barrier does, aims at half of
    # that
    target = left**3 * float(x @ s) / (2 * len(cones))
    second = np.concatenate([arrow((w_inverse @ dx)[k]) @ (w @ ds)[k] for k in cones])

    dx, ds, dy = direction(-scaled + np.linalg.solve(l_product, target * e - second))
    part = near + nearer * min(primal, dual)
    primal = step(x, dx, part)
    dual = step(s, ds, part)
    return Iterate(x + primal * dx, s + dual * ds, y + dual * dy)


def certified_bound(program: Program, y: np.ndarray) -> tuple[float, np.ndarray]:
    """(lower bound of c .

    x, multipliers): -y scaled onto the boundary of its set, as weak duality wants it.
    """
    pull = -(program.matrix.T @ y).reshape(-1, 3)
    steepest = ((pull[:, 0] + np.hypot(pull[:, 1], pull[:, 2])) / program.cost[0::3]).max()
    scaled = -y / steepest if steepest > 0.0 else -y
    return max(0.0, float(program.right @ scaled)), scaled


def arrow(p: np.ndarray) -> np.ndarray:
    """The matrix of q -> p o q."""
    matrix = p[0] * np.eye(3)
    matrix[0], matrix[:, 0] = p, p
    return matrix


def scaling(x: np.ndarray, s: np.ndarray) -> np.ndarray:
    """W, symmetric, with W s = W^-1 x, that maps the cone onto itself; W^2 = eta (2 v v^T - J), J =
    diag(1, -1, -1)."""
    j = np.array([1.0, -1.0, -1.0])
    eta = np.sqrt((x @ (j * x)) / (s @ (j * s)))
    v = x + eta * j * s
    v = v / np.sqrt(v @ (j * v))
    w = np.eye(3) + np.outer(v, v) / (1.0 + v[0])
    w[0], w[:, 0] = v, v
    return np.sqrt(eta) * w


def per_boundary(x: np.ndarray, d: np.ndarray) -> float:
    """1 / (the largest step that keeps x + a d in the cone), at least 0: W with W^2 e = x makes it
    e + a W^-2 d."""
    w = scaling(x, np.eye(3)[0])
    r = np.linalg.solve(w @ w, d)
    return max(0.0, float(np.linalg.norm(r[1:]) - r[0]))
