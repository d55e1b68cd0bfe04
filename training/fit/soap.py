"""SOAP: Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al., 2024).

An exact regression takes far fewer steps than with Adam, and with narrow layers the products are
cheap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

DECAY = 0.95
"""Decay of all moving means."""
SMALL = 1e-8
EVERY = 10
"""Steps between two updates of the eigenbases."""


class Soap(torch.optim.Optimizer):
    """Optimiser with moments in the eigenbases of mean G G^T and mean G^T G, G a gradient.

    Args:
        parameters: matrices and vectors.
        lr: learning rate.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float) -> None:
        super().__init__(list(parameters), {"lr": lr})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Update every parameter that has a gradient."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    gradient = parameter.grad.reshape(len(parameter), -1)
                    move = _direction(self.state[parameter], gradient)
                    parameter.add_(move.reshape(parameter.shape), alpha=-group["lr"])


def _direction(state: dict[str, Any], gradient: Tensor) -> Tensor:
    # contiguous, as after loading: products of another layout round differently, and a resumed
    # training must have the same bits
    sides = {"rows": gradient @ gradient.T, "columns": gradient.T @ gradient}
    if not state:
        state["step"] = torch.zeros(())
        state["mean"] = torch.zeros_like(gradient)
        state["square"] = torch.zeros_like(gradient)
        for name, product in sides.items():
            state[name] = product
            state[f"{name} basis"] = torch.linalg.eigh(product)[1].contiguous()
    state["step"] += 1
    rows = state["rows basis"]
    columns = state["columns basis"]
    rotated = rows.T @ gradient @ columns
    state["mean"].lerp_(gradient, 1.0 - DECAY)
    state["square"].lerp_(rotated.square(), 1.0 - DECAY)
    correction = 1.0 - DECAY ** float(state["step"])
    scaled = (rows.T @ state["mean"] @ columns / correction) / (
        (state["square"] / correction).sqrt() + SMALL
    )
    for name, product in sides.items():
        state[name].lerp_(product, 1.0 - DECAY)
        # a power iteration follows the slowly turning eigenvectors
        if int(state["step"]) % EVERY == 0:
            turned = state[name] @ state[f"{name} basis"]
            state[f"{name} basis"] = torch.linalg.qr(turned)[0].contiguous()
    return rows @ scaled @ columns.T
