"""Designs of a start for any grasp, besides the chosen Newton layers: what they were measured against.

Each maps (problems, start) to the forces after each of its layers, balanced and strictly inside the cones; the wrench is read
from the start. None knows a frame: in cone coordinates the problem is x_p = -G^+ w and Pi = G^+ G (unit frame), with each contact's
tangents turned along x_p.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from policies.network import activation
from policies.newton_layers import Problems
from training.cones import balanced, inside, least_forces


class Problem:
    """x_p, Pi and the turned tangents of a batch.

    Attributes:
        particular: (B, N, 3) x_p, tangents turned: its last number is 0.
        projector: (B, 3N, 3N) Pi, tangents turned.
        rest: (B, N, 3) tangents turned.
        size: (B, 1, 1) magnitude of x_p, with a floor.
    """

    def __init__(self, problems: Problems, start: Tensor) -> None:
        self.mask = problems.mask
        batch, _, count, _ = problems.rows.shape
        rows = problems.rows.reshape(batch, 6, 3 * count)
        wrench = -(rows @ start.reshape(batch, -1, 1))
        inverse = rows.mT @ torch.linalg.inv(rows @ rows.mT)
        particular = -(inverse @ wrench).reshape(batch, count, 3)
        along = torch.sqrt(particular[..., 1] ** 2 + particular[..., 2] ** 2 + 1e-24)
        self._cos, self._sin = particular[..., 1] / along, particular[..., 2] / along
        self.particular, self.rest = self.turned(particular), self.turned(problems.rest)
        columns = torch.stack([self.turned(part) for part in rows.reshape(batch, 6, count, 3).unbind(1)], 1)
        flat = columns.reshape(batch, 6, 3 * count)
        self.projector = flat.mT @ torch.linalg.solve(flat @ flat.mT, flat)
        self.size = torch.sqrt(particular.square().sum((1, 2), keepdim=True) + 4.0)

    def turned(self, x: Tensor, back: bool = False) -> Tensor:
        """(B, N, 3) with tangents turned along x_p, or back."""
        sin = -self._sin if back else self._sin
        u, o, t = x.unbind(-1)
        return torch.stack([u, self._cos * o + sin * t, self._cos * t - sin * o], -1)

    def internal(self, x: Tensor) -> Tensor:
        """(B, N, 3) without what would change the wrench, least in the Euclidean metric."""
        flat = x.reshape(len(x), -1, 1)
        return (flat - self.projector @ flat).reshape(x.shape) * self.mask[..., None]


class Plain(nn.Module):
    """A perceptron from (x_p, Pi) to internal forces: null-space coordinates without a choice of basis. One N only."""

    def __init__(self, count: int = 4, width: int = 256) -> None:
        super().__init__()
        self._upper = torch.triu_indices(3 * count, 3 * count)
        sizes = (2 * count + self._upper.shape[1] + 1, width, width, width, 3 * count)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))

    def forward(self, problems: Problems, start: Tensor) -> list[Tensor]:
        """See the module."""
        problem = Problem(problems, start)
        count = int(problems.mask[0].sum())
        order = problem.particular[:, :count, 0].argsort(1)  # contacts are a set
        numbers = (3 * order[..., None] + torch.arange(3)).reshape(len(start), -1)
        rows = torch.arange(len(start))[:, None]
        projector = problem.projector[rows[..., None], numbers[..., None], numbers[:, None]]
        particular = problem.particular.reshape(len(start), -1)[rows, numbers].reshape(-1, count, 3) / problem.size
        parts = [
            particular[..., :2].flatten(1),
            projector[:, self._upper[0], self._upper[1]],
            problem.size.log()[:, 0] - 3.0,
        ]
        x = torch.cat(parts, 1).float()
        for layer in self.layers[:-1]:
            x = activation(layer(x))
        out = torch.zeros(len(start), problem.rest.shape[1] * 3, dtype=start.dtype)
        out[rows, numbers] = self.layers[-1](x).to(start.dtype)
        target = problem.particular + problem.internal(problem.size * out.reshape(start.shape))
        return [inside(start, problem.turned(target, back=True), problem.mask)]


class Shared(nn.Module):
    """A perceptron on every contact that hears the mean of all twice."""

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(inputs, width), nn.Linear(2 * width, width)
        self.third, self.last = nn.Linear(2 * width, width), nn.Linear(width, outputs)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """(B, N, inputs) -> (B, N, outputs) float64."""
        x = activation(self.first(features.float()))
        weights = (mask / mask.sum(1, keepdim=True)).float()[..., None]
        for layer in (self.second, self.third):
            x = activation(layer(torch.cat([x, (x * weights).sum(1, keepdim=True).expand_as(x)], -1)))
        return self.last(x).to(mask.dtype) * mask[..., None]


class Unrolled(nn.Module):
    """Layers that read Phi's gradient and project their step on balance in the Euclidean metric."""

    def __init__(self, count: int = 4, width: int = 32) -> None:
        super().__init__()
        layers = [Shared(17, width, 3) for _ in range(count)]
        for layer in layers:  # at first it stays where it starts
            nn.init.zeros_(layer.last.weight)
            nn.init.zeros_(layer.last.bias)
        self.layers = nn.ModuleList(layers)

    def forward(self, problems: Problems, start: Tensor) -> list[Tensor]:
        """See the module."""
        problem, mask = Problem(problems, start), problems.mask
        x, outputs = problem.turned(start), []
        for layer in self.layers:
            u, s = torch.where(mask > 0, x[..., 0], 1.0), torch.sqrt(x[..., 1] ** 2 + x[..., 2] ** 2 + 1e-24)
            room = (u - s) * (u + s)
            steep = 4 * u / room.square()
            pull = 3 - 1 / u**2 - 2 * (u * u + s * s) / room.square()
            gradient = torch.stack([pull, steep * x[..., 1], steep * x[..., 2]], -1) * mask[..., None]
            scale = u[..., None]
            read = (gradient * scale, problem.internal(gradient) * scale, x / scale, problem.particular / scale)
            own = torch.stack([u.log(), torch.log1p(-s / u), problem.size[:, 0].log().expand_as(u)], -1)
            features = torch.cat([*(_log(part) for part in read), problem.rest[..., :2] / scale, own], -1)
            step = problem.internal(layer(features * mask[..., None], mask) * scale)
            x = inside(x, x + step, mask)
            outputs.append(problem.turned(x, back=True))
        return outputs


class Multipliers(nn.Module):
    """The 6 multipliers of balance as Pi c with a c_i of each contact: the forces of least Phi they imply, then balance.

    These forces are inside the cones whatever c is, if only the slack 3 omega e_u - Pi c is; they balance only at the
    optimum, so a projection in the Hessian of Phi follows.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.first, self.second = Shared(12, width, 3), Shared(15, width, 3)

    def forward(self, problems: Problems, start: Tensor) -> list[Tensor]:
        """See the module."""
        problem, mask = Problem(problems, start), problems.mask
        count = mask.shape[1]
        blocks = problem.projector.reshape(-1, count, 3, count, 3).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
        upper = torch.triu_indices(3, 3)
        size = problem.size.log().expand(-1, count, 1) - 3.0
        own = (problem.particular[..., :2] / problem.size, problem.rest, blocks[..., upper[0], upper[1]], size)
        features = torch.cat(own, -1) * mask[..., None]
        guess = self.first(features, mask)
        mixed = guess - problem.internal(guess)
        pull = guess + self.second(torch.cat([features, mixed], -1), mask)
        pull = pull - problem.internal(pull)
        free = torch.zeros_like(pull)
        free[..., 0] = 3.0
        slack = inside(free, free - pull, mask)
        target = problem.turned(least_forces(slack, mask), back=True)
        return [inside(start, balanced(problems, target, start), mask)]


def _log(x: Tensor) -> Tensor:
    return 0.3 * torch.asinh(10 * x)
