"""The network: a small multilayer perceptron with an algebraic SiLU, which costs no exponential per call."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


def activation(x: Tensor) -> Tensor:
    """X (1 + x / sqrt(1 + x^2)) / 2: smooth, SiLU-shaped, vectorises in the compiled inference."""
    return 0.5 * x * (1.0 + x * torch.rsqrt(1.0 + x * x))


class Network(nn.Module):
    """features (B, inputs) -> null-space coordinates divided by the magnitude m (B, outputs)."""

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int) -> None:
        super().__init__()
        sizes = [inputs, *hidden, outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs) -> (B, outputs)."""
        for layer in self.layers[:-1]:
            x = activation(layer(x))
        return self.layers[-1](x)
