"""Random problems of the force layer, by kind, as its keyword arguments; its answers with
gradients, and how they compare."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from policies import GraspForceLayer, GraspForces, grasp_force

KINDS = ("hard", "elliptic", "soft", "slippery", "own joints", "shared joints", "normal", "all")
HOPELESS = ("exceeded", "far exceeded", "unbalanced")
"""Kinds without an optimum: limits exceeded by a little and by far, wrenches that two contacts
cannot balance."""


def problems(kind: str, batch: int, seed: int = 0) -> dict[str, Tensor]:
    """Return `batch` problems of one of the `KINDS` or `HOPELESS`, or "own exceeded", of own joints:
    four contacts around an object, two if "unbalanced"."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=draw, dtype=torch.float64)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(batch, *shape, generator=draw, dtype=torch.float64)

    n = 2 if kind == "unbalanced" else 4
    out = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=torch.float64)[
        :n
    ] + 0.15 * normal(n, 3)
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
        made["force_weight"], made["barrier_weight"] = (
            uniform(0.5, 2.0, n),
            10 ** uniform(-3, -1, n),
        )
    if kind in ("soft", "slippery", "all", "exceeded", "far exceeded"):
        made["torsional_friction"] = uniform(0.002, 0.02, n)
        made["torsional_friction"][:, 0] = 0.0  # a hard one among them
    if kind == "slippery":
        made["friction"][:, 3] = made["torsional_friction"][:, 3] = 0.0
    if kind in ("own joints", "own exceeded"):
        limit = 1.0 if kind == "own joints" else 0.01
        jacobian = torch.zeros(batch, n, 3, 3 * n, dtype=torch.float64)
        for i in range(n):
            jacobian[:, i, :, 3 * i : 3 * i + 3] = 0.05 * normal(3, 3)
        made["jacobian"], made["torque_limit"] = (
            jacobian,
            torch.full((batch, 3 * n), limit, dtype=torch.float64),
        )
        made["torque_bias"] = 0.05 * limit * normal(3 * n)
    if kind in ("shared joints", "all", "exceeded", "far exceeded", "unbalanced"):
        made["jacobian"] = 0.05 * normal(n, 6 if kind in ("all", "exceeded") else 3, 5)
        made["torque_limit"] = torch.full(
            (batch, 5), 0.005 if kind == "far exceeded" else 2.0, dtype=torch.float64
        )
        made["torque_limit"][:, 4] = torch.inf
    if kind == "exceeded":
        made["max_normal"] = uniform(0.3, 0.5, n)
        made["wrench"][:, 0] += 2.0
    if kind in ("normal", "all"):
        made["min_normal"], made["max_normal"] = uniform(0.2, 1.0, n), uniform(10.0, 20.0, n)
        made["max_normal"][:, 1] = torch.inf
    return made


def margin(given: dict[str, Tensor], seed: int = 0) -> dict[str, Tensor]:
    """Return margins for problems: 0.7 to 0.99 of the friction, preloads below 0.29 N, the last 0."""
    draw = torch.Generator().manual_seed(seed)
    batch, contacts = given["positions"].shape[:2]
    preload = 0.29 * torch.rand(batch, contacts, generator=draw, dtype=torch.float64)
    preload[:, -1] = 0.0
    share = 0.7 + 0.29 * torch.rand(batch, generator=draw, dtype=torch.float64)
    return {"friction_margin": share, "preload": preload}


def human(limits: str, contacts: int, batch: int, seed: int = 0) -> dict[str, Tensor]:
    """Return grasps of human size, most of which exceed their limits of "normals" or of "torques":
    5 to 40 N, points within 0.04 m.

    Half of them hold two parallel plates, the others have contacts anywhere.
    """
    draw = torch.Generator().manual_seed(100 * seed + contacts)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(batch, *shape, generator=draw, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=draw, dtype=torch.float64)

    points = uniform(-0.04, 0.04, contacts, 3)
    side = uniform(-1.0, 1.0, contacts).sign()
    side[:, :2] = torch.tensor([1.0, -1.0], dtype=torch.float64)
    inward = 0.3 * normal(contacts, 3) - points / points.norm(dim=-1, keepdim=True)
    plates = torch.arange(batch) % 2 == 0
    points[plates, :, 2], inward[plates, :, :2] = 0.04 * side[plates], 0.0
    inward[plates, :, 2] = -side[plates]
    push = normal(3)
    place = uniform(-0.02, 0.02, 3)
    push = uniform(5.0, 40.0, 1) * push / push.norm(dim=-1, keepdim=True)
    made = {
        "positions": points,
        "normals": inward,
        "friction": uniform(0.3, 1.0, 1, 1).expand(-1, contacts, 2).clone(),
        "wrench": torch.cat([push, torch.linalg.cross(place, push)], -1),
    }
    if limits == "normals":
        return made | {"max_normal": uniform(1.0, 20.0, contacts)}
    return made | {"jacobian": 0.05 * normal(contacts, 3, 5), "torque_limit": uniform(0.05, 0.6, 5)}


def almost_infeasible(limits: str, contacts: int, batch: int, seed: int = 0) -> dict[str, Tensor]:
    """Return grasps of `human` whose limits are 1e-5 to 1e-1 of themselves above the least for
    which a force exists.

    Their contacts are anywhere: between parallel plates the force bends so sharply there that
    rounding hides its slope from differences.
    """
    made = human(limits, contacts, 2 * batch, seed)
    draw = torch.Generator().manual_seed(seed)
    made = {key: a[1::2] for key, a in made.items()}
    name = {"normals": "max_normal", "torques": "torque_limit"}[limits]
    layer = GraspForceLayer()
    free = {
        key: a for key, a in made.items() if key not in ("max_normal", "jacobian", "torque_limit")
    }
    held = layer(**free).feasible
    made = {key: a[held] for key, a in made.items()}
    low, high = (torch.full_like(made["wrench"][:, :1], size) for size in (1e-3, 1e3))
    for _ in range(40):
        middle = (low * high).sqrt()
        enough = layer(**made | {name: middle * made[name]}).feasible.unsqueeze(-1)
        low = torch.where(enough, low, middle)
        high = torch.where(enough, middle, high)
    above = 10.0 ** (-5.0 + 4.0 * torch.rand(high.shape, generator=draw, dtype=torch.float64))
    return made | {name: (1.0 + above) * high * made[name]}


class Forces(torch.utils.data.Dataset[Tensor]):
    """Optimal forces of two problems, computed on access."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, k: int) -> Tensor:
        return GraspForceLayer()(**{name: a[k] for name, a in problems("hard", 2).items()}).force


class Passing(TorchDispatchMode):
    """Passes every call on.

    Under such a mode inputs are not read in place: they go through the operators.
    """

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return func(*args, **(kwargs or {}))


DIFFERENTIABLE = ("force", "torsion", "multipliers")


def gradients(given: dict[str, Tensor], **options: Any) -> tuple[GraspForces, dict[str, Tensor]]:
    """Answers, and gradients of a random linear function of them."""
    leaves = {name: a.detach().clone().requires_grad_() for name, a in given.items()}
    result = grasp_force(**leaves, **options)
    draw = torch.Generator().manual_seed(0)
    answers = [getattr(result, name) for name in DIFFERENTIABLE]
    loss = [
        (torch.randn(a[:1].shape, generator=draw, dtype=torch.float64).to(a.device) * a).sum()
        for a in answers
    ]
    torch.stack(loss).sum().backward()
    return GraspForces(*(a.detach() for a in result)), {
        k: a.grad for k, a in leaves.items() if a.grad is not None
    }


def same_bits(a: Sequence[Tensor], b: Sequence[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def error(a: Tensor, b: Tensor) -> float:
    """Largest difference of an element, relative to its size."""
    size = b.flatten(1).abs().amax(1).clamp(min=1e-9)
    return float(((a - b).flatten(1).abs().amax(1) / size).max())
