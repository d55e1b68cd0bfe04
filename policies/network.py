"""The network: a small multilayer perceptron with an algebraic SiLU, which needs no exponential."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from grasp_env.inputs.extras import need

with need("train"):
    import torch
    from torch import Tensor, nn


class _Activation(torch.autograd.Function):
    """Algebraic SiLU with an explicit derivative: a third less memory traffic than torch's chain."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        inverse = torch.rsqrt(1.0 + x * x)
        sine = x * inverse
        ctx.save_for_backward(inverse, sine)
        return torch.addcmul(x, x, sine).mul_(0.5)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        inverse, sine = ctx.saved_tensors
        return torch.addcmul(sine, sine, inverse * inverse).add_(1.0).mul_(0.5).mul_(gradient)


def activation(x: Tensor) -> Tensor:
    """Return x (1 + x / sqrt(1 + x^2)) / 2, which is smooth, shaped like SiLU, and vectorises."""
    return _Activation.apply(x)  # type: ignore[return-value]


class Network(nn.Module):
    """Map features (F, B, inputs) to null-space coordinates over the magnitude m, (F, B, outputs).

    The weights are polynomials of the friction, the last feature, plus terms linear in the
    displacements of the contacts. Both have one value for each of the F rows: each friction, with
    its contacts, has a perceptron.

    Args:
        inputs, hidden, outputs: widths of the layers.
        degree: degree of the polynomials; 0: the same weights for every friction.
        moves: number of displacements.
    """

    def __init__(
        self, inputs: int, hidden: Sequence[int], outputs: int, degree: int, moves: int = 0
    ) -> None:
        super().__init__()
        self.degree = degree
        self.terms = degree + 1 + moves
        # one matrix per layer: a block of inputs + 1 rows for each term, the bias in the last row
        self.layers = nn.ParameterList()
        for a, b in pairwise([inputs, *hidden, outputs]):
            plain = nn.Linear(a, b)
            blocks = torch.zeros(self.terms, a + 1, b)
            blocks[0, :a], blocks[0, a] = plain.weight.detach().T, plain.bias.detach()
            self.layers.append(nn.Parameter(blocks.reshape(-1, b)))

    def forward(self, x: Tensor, moves: Tensor | None = None) -> Tensor:
        """Apply the network to features and displacements (F, moves), see the class."""
        terms = x[:, 0, -1:] ** torch.arange(self.degree + 1)
        if moves is not None:
            terms = torch.cat([terms, moves], 1)
        last = len(self.layers) - 1
        for index, layer in enumerate(self.layers):
            blocks = (terms @ layer.view(self.terms, -1)).view(len(x), -1, layer.shape[1])
            x = torch.baddbmm(blocks[:, -1:], x, blocks[:, :-1])
            if index < last:
                x = activation(x)
        return x

    def tensors(self) -> dict[str, Tensor]:
        """Return "weight" (terms, outputs, inputs) and "bias" (terms, outputs) per layer."""
        out: dict[str, Tensor] = {}
        for index, layer in enumerate(self.layers):
            blocks = layer.detach().view(self.terms, -1, layer.shape[1])
            out[f"layers.{index}.weight"] = blocks[:, :-1].mT
            out[f"layers.{index}.bias"] = blocks[:, -1]
        return out
