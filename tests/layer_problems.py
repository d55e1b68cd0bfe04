"""Random problems of the force layer, by kind, as its keyword arguments."""

from __future__ import annotations

import torch
from torch import Tensor

from policies import GraspForceLayer

KINDS = ("hard", "elliptic", "soft", "own joints", "shared joints", "normal")
HOPELESS = ("exceeded", "far exceeded", "unbalanced")
"""Kinds without an optimum: limits exceeded by a little and by far, wrenches that two contacts cannot balance."""


def problems(kind: str, batch: int, seed: int = 0) -> dict[str, Tensor]:
    """Return `batch` problems of one of the `KINDS` or `HOPELESS`: four contacts around an object, two if "unbalanced"."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=draw, dtype=torch.float64)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(batch, *shape, generator=draw, dtype=torch.float64)

    n = 2 if kind == "unbalanced" else 4
    out = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=torch.float64)[:n] + 0.15 * normal(n, 3)
    made = {
        "positions": 0.02 + 0.05 * out / out.norm(dim=-1, keepdim=True),
        "normals": -out + 0.1 * normal(n, 3),  # not of unit length
        "friction": uniform(0.5, 0.8, n).unsqueeze(-1).expand(-1, -1, 2).clone(),
        "wrench": normal(6) * torch.tensor([1, 1, 1, 0.02, 0.02, 0.02]),
        "force_weight": torch.ones(batch, n, dtype=torch.float64),
        "barrier_weight": torch.full((batch, n), 0.01, dtype=torch.float64),
    }
    if kind == "elliptic":
        made["friction"], made["tangents"] = uniform(0.4, 0.9, n, 2), normal(n, 3)
        made["force_weight"], made["barrier_weight"] = uniform(0.5, 2.0, n), 10 ** uniform(-3, -1, n)
    if kind in ("soft", "exceeded", "far exceeded"):
        made["torsional_friction"] = uniform(0.002, 0.02, n)
        made["torsional_friction"][:, 0] = 0.0  # a hard one among them
    if kind == "own joints":
        jacobian = torch.zeros(batch, n, 3, 3 * n, dtype=torch.float64)
        for i in range(n):
            jacobian[:, i, :, 3 * i : 3 * i + 3] = 0.05 * normal(3, 3)
        made["jacobian"], made["torque_limit"] = jacobian, torch.full((batch, 3 * n), 1.0, dtype=torch.float64)
        made["torque_bias"] = 0.05 * normal(3 * n)
    if kind in ("shared joints", *HOPELESS):
        made["jacobian"] = 0.05 * normal(n, 6 if kind == "exceeded" else 3, 5)
        made["torque_limit"] = torch.full((batch, 5), 0.005 if kind == "far exceeded" else 2.0, dtype=torch.float64)
        made["torque_limit"][:, 4] = torch.inf
    if kind == "exceeded":
        made["max_normal"] = uniform(0.3, 0.5, n)
        made["wrench"][:, 0] += 2.0
    if kind == "normal":
        made["min_normal"], made["max_normal"] = uniform(0.2, 1.0, n), uniform(10.0, 20.0, n)
        made["max_normal"][:, 1] = torch.inf
    return made


class Forces(torch.utils.data.Dataset[Tensor]):
    """Optimal forces of two problems, computed on access."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, k: int) -> Tensor:
        return GraspForceLayer()(**{name: a[k] for name, a in problems("hard", 2).items()}).force
