"""One dense iteration of the interior-point method for the least sum of normal forces.

    min  c . x   s.t.  A x = b,  x in K          max -b . y   s.t.  s = c + A^T y in K

K is a product of cones x_0 >= |(x_1, x_2)|, one a contact: a program of `interior_point` without rays and shared variables.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from oracles import interior_point
from oracles.interior_point import ConicProgram, nt_step


class Program(NamedTuple):
    """A program and the rules by which the core steps through it.

    Attributes:
        matrix: A (m, n); right: b (m,); cost: c (n,).
        reach: (a, b): a step goes a + b min(predictor's steps) of the way to the boundary.
    """

    matrix: np.ndarray
    right: np.ndarray
    cost: np.ndarray
    reach: tuple[float, float] = (0.9, 0.095)


class Iterate(NamedTuple):
    """x and s (n,) strictly inside the cones, y (m,)."""

    x: np.ndarray
    s: np.ndarray
    y: np.ndarray


def of_grasp(matrix: np.ndarray, wrench: np.ndarray, divisor: np.ndarray) -> Program:
    """The program of a grasp, unit frame."""
    cost = np.zeros(matrix.shape[1])
    cost[0::3] = 1.0 / divisor[:, 0]
    return Program(matrix, -wrench, cost)


def start(program: Program, inverse: np.ndarray, rest: np.ndarray) -> Iterate:
    """x = G^+ b + k rest, k 1.3 times what takes every contact inside; s = c. rest: (3N,) strictly inside."""
    x = inverse @ program.right
    depth = rest[0::3] - np.hypot(rest[1::3], rest[2::3])
    squeeze = 1.3 * max(1e-6, ((np.hypot(x[1::3], x[2::3]) - x[0::3]) / depth).max())
    return Iterate(x + squeeze * rest, program.cost.copy(), np.zeros(6))


def iteration(program: Program, at: Iterate) -> Iterate:
    """The next iterate: `nt_step` without rays and shared variables."""
    a, b, c, reach = program
    cones = len(c) // 3
    general = ConicProgram(a, b, c, np.zeros((len(b), 0)), np.zeros(0), (3,) * cones, cones, reach, 0.0)
    x, s, _, y = nt_step(general, interior_point.Iterate(at.x, at.s, np.zeros(0), at.y))
    return Iterate(x, s, y)


def certified_bound(program: Program, y: np.ndarray) -> tuple[float, np.ndarray]:
    """(lower bound of c . x, multipliers): -y scaled onto the boundary of its set, as weak duality wants it."""
    pull = -(program.matrix.T @ y).reshape(-1, 3)
    steepest = ((pull[:, 0] + np.hypot(pull[:, 1], pull[:, 2])) / program.cost[0::3]).max()
    scaled = -y / steepest if steepest > 0.0 else -y
    return max(0.0, float(program.right @ scaled)), scaled
