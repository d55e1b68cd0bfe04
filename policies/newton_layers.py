"""Learned Newton layers in torch: what the core's `layers.hpp` does, for training and as its oracle.

One layer takes a balanced force inside the cones and returns a better one: the Newton step of Phi, shortened where it is
long, plus what a small perceptron on every contact adds, projected back on balance in the Hessian of Phi. Weights are
shared by the contacts, each of which also hears the mean of all: any number and order of contacts, and since the
numbers are ratios, any frame, scale, omega and lambda. With zero output it is a Newton step.

Everything here is in units of sqrt(lambda / omega) for forces, so that Phi = sum 3 u + 1/u + 2 u / (u^2 - s^2).
"""

from __future__ import annotations

from typing import NamedTuple

from grasp_env._extras import need

with need("train"):
    import torch
    from torch import Tensor, nn

from grasp_env.core import LAYER_FEATURES as FEATURES
from grasp_env.core import LAYER_REACH as REACH
from policies.network import activation

SMALLEST = 1e-24
"""Added to s^2, so that a force along the normal has a direction too."""


class Problems(NamedTuple):
    """A batch of grasps with their wrenches.

    Attributes:
        rows: (B, 6, N, 3) G in cone coordinates and the unit frame; zero for contacts that are not there.
        mask: (B, N) 1 for contacts.
        rest: (B, N, 3) the optimum without a wrench.
    """

    rows: Tensor
    mask: Tensor
    rest: Tensor


def phi(problems: Problems, x: Tensor) -> Tensor:
    """(B,) Phi of x (B, N, 3); inf unless strictly inside."""
    mask = problems.mask
    u = torch.where(mask > 0, x[..., 0], torch.ones_like(x[..., 0]))
    room = u * u - x[..., 1] ** 2 - x[..., 2] ** 2
    inside = ((u > 0) & (room > 0)).all(1)
    value = (mask * (3 * u + 1 / u + 2 * u / torch.where(room > 0, room, torch.ones_like(room)))).sum(1)
    return torch.where(inside, value, torch.full_like(value, float("inf")))


class _System:
    """The coordinates of a layer at x (p, q and the direction of the tangential force), the Newton step in them, and the projection on balance."""

    def __init__(self, problems: Problems, x: Tensor) -> None:
        self.mask = problems.mask
        u = torch.where(self.mask > 0, x[..., 0], torch.ones_like(x[..., 0]))
        s = torch.sqrt(x[..., 1] ** 2 + x[..., 2] ** 2 + SMALLEST)
        self.q = u + s
        self.p = (u * u - s * s) / self.q
        self.cos, self.sin = x[..., 1] / s, x[..., 2] / s
        self.root = torch.sqrt(self.p * self.q)
        p, q, total = self.p, self.q, self.p + self.q
        along, across = self.turn(problems.rows[..., 1], problems.rows[..., 2], 1)
        normal = problems.rows[..., 0]
        columns = (
            0.5 * (normal - along) * p[:, None],
            0.5 * (normal + along) * q[:, None],
            across * self.root[:, None],
        )
        self._columns = torch.stack(columns, -1)
        bend = 4 / total**3
        h11, h22, h12 = 2 / p + bend * p * p, 2 / q + bend * q * q, bend * p * q
        h33, det = 2 * total / (p * q), h11 * h22 - h12 * h12
        i11, i22, i12 = h22 / det, h11 / det, -h12 / det
        a, b, c = columns
        half = (a * i11[:, None] + b * i12[:, None], a * i12[:, None] + b * i22[:, None], c / h33[:, None])
        self._half = torch.stack(half, -1)
        schur = torch.einsum("brnk,bsnk->brs", self._half, self._columns)
        # a hint of regularisation: a batch must not fail for one grasp at the edge of rank
        ridge = 1e-12 * torch.diagonal(schur, dim1=1, dim2=2).amax(1)
        self._factor, _ = torch.linalg.cholesky_ex(schur + ridge[:, None, None] * torch.eye(6, dtype=x.dtype))
        g1, g2 = p * (1.5 - 2 / total**2) - 1 / p, q * (1.5 - 2 / total**2) - 1 / q
        own = -torch.stack([i11 * g1 + i12 * g2, i12 * g1 + i22 * g2, torch.zeros_like(p)], -1) * self.mask[..., None]
        self.newton = self.balance(own)
        self.decrement = (-(g1 * self.newton[..., 0] + g2 * self.newton[..., 1]) * self.mask).sum(1).clamp(min=0.0)
        self.size = self.newton.square().sum((1, 2))

    def turn(self, o: Tensor, t: Tensor, axis: int | None = None) -> tuple[Tensor, Tensor]:
        """Tangential numbers along and across the force."""
        cos, sin = (self.cos, self.sin) if axis is None else (self.cos.unsqueeze(axis), self.sin.unsqueeze(axis))
        return cos * o + sin * t, cos * t - sin * o

    def balance(self, step: Tensor) -> Tensor:
        """A step (B, N, 3) without what would change G f, least in the Hessian of Phi."""
        wrench = torch.einsum("brnk,bnk->br", self._columns, step)
        multipliers = torch.cholesky_solve(wrench[..., None], self._factor)[..., 0]
        return step - torch.einsum("brnk,br->bnk", self._half, multipliers)

    def force(self, step: Tensor) -> Tensor:
        """The change of x (B, N, 3) that a step in these coordinates means, as long as it stays inside."""
        a, b, c = step.unbind(-1)
        away = torch.sqrt((a - b) ** 2 + 4 * c * c + 1e-24) - (a + b)
        reach = REACH * 2 / (away * self.mask).amax(1).clamp(min=1e-9)
        theta = reach.clamp(max=1.0)[:, None]
        dp, dq, dt = theta * self.p * a, theta * self.q * b, theta * self.root * c
        along = 0.5 * (dq - dp)
        parts = (0.5 * (dp + dq), along * self.cos - dt * self.sin, along * self.sin + dt * self.cos)
        return torch.stack(parts, -1) * self.mask[..., None]

    def features(self, rest: Tensor, value: Tensor) -> Tensor:
        """(B, N, FEATURES) what a layer reads."""
        along, across = self.turn(rest[..., 1], rest[..., 2])
        towards = torch.stack(
            [(rest[..., 0] - along) / self.p, (rest[..., 0] + along) / self.q, across / self.root], -1
        )
        count = self.mask.sum(1)
        common = torch.stack(
            [0.2 * torch.log(self.decrement / value + 1e-12), 0.2 * torch.log(self.size + 1e-12), count - 4], -1
        )
        own = torch.stack([0.5 * torch.log(self.p), 0.5 * torch.log(self.q)], -1)
        parts = (own, _squash(self.newton), _squash(towards), common[:, None].expand(-1, self.p.shape[1], -1))
        return torch.cat(parts, -1) * self.mask[..., None]


def _squash(x: Tensor) -> Tensor:
    return x * torch.rsqrt(1 + x.abs())


class Layer(nn.Module):
    """The perceptron of one layer: features (B, N, FEATURES) -> changes (B, N, 3)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(FEATURES, width)
        self.second = nn.Linear(2 * width, width)
        self.third = nn.Linear(width, 3)
        nn.init.zeros_(self.third.weight)
        nn.init.zeros_(self.third.bias)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """See the class."""
        hidden = activation(self.first(features))
        mean = (hidden * mask[..., None]).sum(1, keepdim=True) / mask.sum(1)[:, None, None]
        hidden = activation(self.second(torch.cat([hidden, mean.expand_as(hidden)], -1)))
        return self.third(hidden)


class NewtonLayers(nn.Module):
    """A few layers, each with weights of its own.

    Args:
        count: layers.
        width: of their hidden layers.
    """

    def __init__(self, count: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.layers = nn.ModuleList(Layer(width) for _ in range(count))

    def forward(self, problems: Problems, x: Tensor) -> list[Tensor]:
        """The force (B, N, 3) after each layer, from a balanced one strictly inside the cones; float64."""
        out = []
        for layer in self.layers:
            system = _System(problems, x)
            features = system.features(problems.rest, phi(problems, x))
            change = layer(features.float(), problems.mask.float()).to(x.dtype) * problems.mask[..., None]
            size = system.size[:, None, None]
            step = system.newton * torch.rsqrt(1 + size) + system.balance(change * (size / (1 + size)))
            x = x + system.force(step)
            out.append(x)
        return out


def newton_step(problems: Problems, x: Tensor) -> Tensor:
    """One plain Newton step, shortened to stay inside: what a layer is compared with."""
    system = _System(problems, x)
    return x + system.force(system.newton)
