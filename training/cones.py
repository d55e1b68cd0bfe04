"""Batches of forces in cone coordinates, differentiable: kept inside, balanced again, and in closed form from multipliers."""

from __future__ import annotations

import torch
from torch import Tensor

from grasp_env.core import LAYER_REACH as REACH
from policies.newton_layers import Problems


def inside(safe: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """(B, N, 3) from `safe`, strictly inside, towards `target`: all of the way, or `REACH` of that to the nearest cone."""
    move = target - safe
    sign = torch.tensor([1.0, -1.0, -1.0], dtype=safe.dtype)
    a, b, c = ((one * other * sign).sum(-1) for one, other in ((move, move), (safe, move), (safe, safe)))
    # c + 2 b t + a t^2 = 0 first at t = c / (sqrt(b^2 - a c) - b); inside, c > 0
    away = (torch.sqrt((b * b - a * c).clamp(min=1e-18)) - b) / torch.where(mask > 0, c, torch.ones_like(c))
    share = (REACH / (away * mask).amax(1).clamp(min=1e-9)).clamp(max=1.0)
    return safe + share[:, None, None] * move


def balanced(problems: Problems, x: Tensor, other: Tensor) -> Tensor:
    """X, strictly inside, with the change that gives it the wrench of `other` and is least in the Hessian of Phi at x."""
    u, (o, t) = torch.where(problems.mask > 0, x[..., 0], 1.0), x[..., 1:].unbind(-1)
    square = o * o + t * t
    room = u * u - square
    uu = 2 / u**3 + 4 * u * (u * u + 3 * square) / room**3
    uo, ut = (-4 * part * (3 * u * u + square) / room**3 for part in (o, t))
    oo, tt = (4 * u / room**2 + 16 * u * part * part / room**3 for part in (o, t))
    ot = 16 * u * o * t / room**3
    hessian = torch.stack([uu, uo, ut, uo, oo, ot, ut, ot, tt], -1).reshape(*u.shape, 3, 3)
    half = torch.einsum("bnij,brnj->bnir", torch.linalg.inv(hessian), problems.rows)
    schur = torch.einsum("brni,bnis->brs", problems.rows, half)
    missing = torch.einsum("brni,bni->br", problems.rows, other - x)
    return x + torch.einsum("bnir,br->bni", half, torch.linalg.solve(schur, missing))


def least_forces(slack: Tensor, mask: Tensor) -> Tensor:
    """(B, N, 3) argmin of each contact's Phi minus the pull, in closed form but for one root.

    With slack = 3 e_u - pull, r = s / u and rho = |slack tangential| / slack normal: 4 r = rho (3 + r^4).
    """
    a = torch.where(mask > 0, slack[..., 0], 3.0)
    b = torch.sqrt(slack[..., 1] ** 2 + slack[..., 2] ** 2 + 1e-24)
    rho = b / a
    with torch.no_grad():  # from the left the convex function's Newton steps stay there
        r = 0.75 * rho
        for _ in range(40):
            r = r + (rho * (3 + r**4) - 4 * r) / (4 - 4 * rho * r**3)
    r = r + (rho * (3 + r**4) - 4 * r) / (4 - 4 * rho * r**3)  # once more, for its derivative
    u = torch.sqrt((1 + 2 * (1 + r * r) / (1 - r * r).square()) / a)
    tangential = -slack[..., 1:] * (u * r / b)[..., None]
    return torch.cat([u[..., None], tangential], -1) * mask[..., None]
