"""Learned Newton layers and small networks, plain: what `core/include/grasp/layers.hpp` and `network.hpp` do, in float64.

A layer works per contact on p = u - s and q = u + s, which change by p a and q b, and on the tangential force across itself, which
changes by c sqrt(p q): a step is z (3N,) = (a, b, c) of every contact, and x changes by T z.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from oracles.phi import gradient, hessian, phi

FEATURES, REACH = 11, 0.9


def activation(x: np.ndarray) -> np.ndarray:
    """x (1 + x / sqrt(1 + x^2)) / 2."""
    return 0.5 * x * (1.0 + x / np.sqrt(1.0 + x * x))


def network(sizes: list[int], weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """weights: of each stage (inputs x outputs), then its bias, flat."""
    at = 0
    for stage, (inputs, outputs) in enumerate(pairwise(sizes)):
        matrix = weights[at : at + inputs * outputs].reshape(inputs, outputs)
        at += (inputs + 1) * outputs
        x = x @ matrix + weights[at - outputs : at]
        x = activation(x) if stage + 2 < len(sizes) else x
    return x


def perceptron(width: int, weights: np.ndarray, features: np.ndarray) -> np.ndarray:
    """(N, 3) of (N, FEATURES): every contact alike, which also hears the mean of all contacts' first hidden numbers."""
    cuts = np.cumsum([FEATURES * width, width, 2 * width * width, width, 3 * width])
    first, one, second, two, last, three = np.split(weights, cuts)
    hidden = activation(features @ first.reshape(-1, width) + one)
    both = np.hstack([hidden, np.tile(hidden.mean(axis=0), (len(hidden), 1))])
    return activation(both @ second.reshape(-1, width) + two) @ last.reshape(-1, 3) + three


def coordinates(x: np.ndarray) -> np.ndarray:
    """T (3N, 3N): x changes by T (a, b, c)."""
    full = np.zeros((len(x), len(x)))
    for k, (u, o, t) in enumerate(x.reshape(-1, 3)):
        s = np.hypot(o, t)
        cos, sin = (o / s, t / s) if s > 0.0 else (1.0, 0.0)
        p, q = u - s, u + s
        root = np.sqrt(p * q)
        columns = [
            [0.5 * p, -0.5 * p * cos, -0.5 * p * sin],
            [0.5 * q, 0.5 * q * cos, 0.5 * q * sin],
            [0, -root * sin, root * cos],
        ]
        full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.array(columns).T
    return full


def layer(
    x: np.ndarray, matrix: np.ndarray, rest: np.ndarray, weights: np.ndarray, width: int, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(x after one layer at its full length, multipliers of its Newton step).

    Args:
        x: (3N,) balanced and strictly inside.
        matrix: (6, 3N) G in cone coordinates.
        rest: (3N,) the optimum without a wrench.
        weights: (N, 2) omega and lambda.
        width, numbers: of the perceptron; none: the plain Newton step.
    """
    turn = coordinates(x)
    bend, pull, rows = turn.T @ hessian(x, weights) @ turn, turn.T @ gradient(x, weights), matrix @ turn
    inverse = np.linalg.inv(bend)
    schur = rows @ inverse @ rows.T

    def balanced(z: np.ndarray) -> np.ndarray:
        return z - inverse @ rows.T @ np.linalg.solve(schur, rows @ z)

    newton = balanced(-inverse @ pull)
    multipliers = np.linalg.solve(schur, rows @ inverse @ pull)
    step = newton
    if len(numbers):
        size, decrement = newton @ newton, newton @ bend @ newton
        unit = np.sqrt(weights[:, 1] / weights[:, 0])
        blocks = x.reshape(-1, 3)
        s = np.hypot(blocks[:, 1], blocks[:, 2])
        depths = np.stack([blocks[:, 0] - s, blocks[:, 0] + s], axis=1)
        there = np.linalg.solve(turn, rest).reshape(-1, 3)
        common = [0.2 * np.log(decrement / phi(x, weights) + 1e-12), 0.2 * np.log(size + 1e-12), len(blocks) - 4.0]
        features = np.hstack(
            [
                0.5 * np.log(depths / unit[:, None]),
                squash(newton.reshape(-1, 3)),
                squash(there),
                np.tile(common, (len(blocks), 1)),
            ]
        )
        said = perceptron(width, numbers, features).reshape(-1)
        step = newton / np.sqrt(1.0 + size) + balanced(said * size / (1.0 + size))
    # inside: 1 + t (a + b) + t^2 (a b - c^2) > 0 for every contact
    a, b, c = step.reshape(-1, 3).T
    away = (np.sqrt((a - b) ** 2 + 4.0 * c * c) - (a + b)).max()
    theta = min(1.0, 2.0 * REACH / away) if away > 0.0 else 1.0
    return x + theta * (turn @ step), multipliers


def squash(v: np.ndarray) -> np.ndarray:
    """v / sqrt(1 + |v|)."""
    return v / np.sqrt(1.0 + np.abs(v))
