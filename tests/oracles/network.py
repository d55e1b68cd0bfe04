"""Small networks, plain: the same as the core's `network.hpp`, in float64."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


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
