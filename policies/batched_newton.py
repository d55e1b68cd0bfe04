"""The optimum of Phi for a batch of grasps, and its gradient, in torch: any device, float64.

`GraspForceLayer` uses it for tensors that are not on the CPU; on the CPU it uses the compiled core. Both solve the same problem: minimise

    E(z) = sum_i [3 omega u + lambda (1/u + 2u / (u^2 - o^2 - t^2))] + sum_soft lambda (1/(u - v) + 1/(u + v)) + sum_rows weight / slack

under balance, in cone coordinates z = (u, o, t, v) = scale * (force along normal, o, t; torsion). The limits are rows a . z <= bound of
length one. Moments are taken about the contacts' centre and divided by the contacts' spread, the root mean square of their distances from
it. So the components of a wrench have similar sizes. This is the unit frame.

The file is long because problem, Newton's method, starts and the adjoint share one formulation of the barrier.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from grasp_env._extras import need
from grasp_env.core import LARGEST, TANGENT_SWITCH

with need("layer"):
    import torch
    from torch import Tensor

OPTIMAL, LIMIT, STALLED, INFEASIBLE, REFUSED, LIMITS_EXCEEDED, RANK_LOST, UNDECIDED = range(8)
"""Values of `grasp::Code`."""
BALANCED, EXCEEDING, UNBALANCED, NOTHING = range(4)
"""The problem that an element's force solves: the original one; with elastic limits; with elastic limits and balance; none."""
EDGE = 0.1
"""Slack, in units of sqrt(lambda / omega), below which the elastic problems extend a limit's barrier quadratically."""
SOFTNESS = 1e-2
"""Softness of elastic balance [N^2] per unit of Phi: a residual costs |G f + w|^2 / (2 SOFTNESS)."""

_FIRST_EDGE, _LAST_EDGE = 8.0, 1e-6  # a limit that is exceeded at the last edge cannot be satisfied
_SOFTNESSES = (1e-3, 1e-6, 1e-9, 1e-12)  # the optimum of a small one is one step from a balanced force, if there is one
_SETTLED, _LOWER = 0.03, 0.25  # squared decrement, part of Phi, at which edge and softness are lowered; their factor
_REACH = 0.95  # largest part of the way to the boundary that a step goes
_HALVINGS = 60
_POLISH_STEPS = 2  # whole steps after convergence; each squares the error
_TIGHT, _DEAR = 0.1, 100.0  # slack over sqrt(lambda / omega), |nu| over omega: beyond them a problem is stiff
_HARDER, _STIFF_STEPS = 0.5, 300  # factor of the edge of elastic forces; most steps of a stiff problem
_LEAST, _ROUGH = 1e-13, 1e-6  # relative step of a force with all digits, and largest of a converged one
_SHORT = 1e-4  # relative step that is taken whole, and is rounding unless it is a quarter of the one before
_STAGE = 0.25  # relative step that ends a stage
_NOISE = 1e-14  # rounding of the objective, relative
_RANK = 1e-8  # smallest ratio of singular values of G that counts as rank 6


class Inputs(NamedTuple):
    """B problems of N contacts and J joints, float64, in one frame of the caller's choice; None where left out.

    Attributes:
        positions, normals, tangents: (B, N, 3) [m, -, -].
        friction: (B, N, 2) along o and t.
        torsional_friction: (B, N) [m].
        wrench: (B, 6) on the object [N, N m].
        jacobian: (B, N, 3 or 6, J).
        torque_limit, torque_bias: (B, J) [N m].
        min_normal, max_normal: (B, N) [N].
        force_weight, barrier_weight: (B, N).
    """

    positions: Tensor
    normals: Tensor
    friction: Tensor
    tangents: Tensor | None
    torsional_friction: Tensor | None
    wrench: Tensor
    jacobian: Tensor | None
    torque_limit: Tensor | None
    torque_bias: Tensor | None
    min_normal: Tensor | None
    max_normal: Tensor | None
    force_weight: Tensor
    barrier_weight: Tensor

    def map(self, change: Callable[[Tensor], Tensor]) -> Inputs:
        """Apply `change` to each given tensor."""
        return Inputs(*(None if a is None else change(a) for a in self))  # type: ignore[arg-type]


class Solved(NamedTuple):
    """Optima of B problems.

    Attributes:
        force: (B, N, 3) in the caller's frame [N].
        torsion: (B, N) [N m].
        multipliers: (B, 6) Lagrange multipliers nu of balance: grad Phi = G^T nu.
        facts: (B, 4) status (`grasp::Code`), certified gap, residual [N], iterations.
        state: (B, 4N + 7) input of `gradients`: z (N, 4), multipliers of balance in the unit frame, problem that was solved.
    """

    force: Tensor
    torsion: Tensor
    multipliers: Tensor
    facts: Tensor
    state: Tensor


def tails(count: int) -> tuple[tuple[int, ...], ...]:
    """Return the trailing dimensions of the tensors of `Solved`, for a number of contacts."""
    return (count, 3), (count,), (6,), (4,), (4 * count + 7,)


# --- the problem: differentiable in the inputs


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _unit(a: Tensor) -> Tensor:
    return a / _dot(a, a).sqrt().unsqueeze(-1)


def _pick(where: Tensor, a: Tensor, b: Tensor | float) -> Tensor:
    """Return `a` for the elements (B,) where the condition holds, else `b`."""
    return torch.where(where.view(-1, *(1,) * (a.ndim - 1)), a, b)


def _finite(*tensors: Tensor) -> Tensor:
    """Return (B,) True if all numbers of an element are finite."""
    return torch.stack([a.flatten(1).isfinite().all(1) for a in tensors]).all(0)


class _Problem(NamedTuple):
    """Contacts and limits in cone coordinates, and the current softness of limits and balance.

    A limit is a pair of rows a . z <= bounds[0], -a . z <= bounds[1]. Below the edge, its barrier is extended quadratically.
    """

    frames: Tensor  # (B, N, 3, 3) rows n, o, t
    per: Tensor  # (B, N, 4) force and torsion per z; 0 where none is transmitted
    centre: Tensor  # (B, 3)
    shrink: Tensor  # (B,) 1 / the contacts' spread
    balance: Tensor  # (B, 6, N, 4) of z, unit frame
    load: Tensor  # (B, 6) the wrench, unit frame
    omega: Tensor  # (B, N)
    lam: Tensor  # (B, N)
    soft: Tensor  # (B, N) bool
    rows: Tensor  # (B, M, N, 4) a of each limit
    bounds: Tensor  # (B, M, 2)
    weights: Tensor  # (B, M, 2) 0: there is no such limit, and its bound is 1e100
    scales: Tensor  # (B, M) sqrt(lambda / omega) of the contacts that a limit touches
    edge: Tensor  # (B,) in units of the scales; 0: the barriers themselves
    softness: Tensor  # (B,) missing balance costs |G f + w|^2 / (2 softness); 0: balance is exact

    def take(self, where: Tensor) -> _Problem:
        """Return the problems at these indices."""
        return _Problem(*(part[where] for part in self))

    def without_limits(self) -> _Problem:
        """Return the same problems without limits."""
        parts = {name: getattr(self, name)[:, :0] for name in ("rows", "bounds", "weights", "scales")}
        return self._replace(**parts)

    @property
    def floor(self) -> Tensor:
        """(B, M, 1) slack below which a barrier is extended."""
        return (self.edge.unsqueeze(-1) * self.scales).unsqueeze(-1)

    def along(self, z: Tensor) -> Tensor:
        """(B, M, 2) a . z and -a . z."""
        made = torch.einsum("bmna,bna->bm", self.rows, z)
        return torch.stack([made, -made], -1)

    def slack(self, z: Tensor) -> Tensor:
        """(B, M, 2) of the limits."""
        return self.bounds - self.along(z)

    def pulled(self, prices: Tensor) -> Tensor:
        """(B, N, 4) sum of prices * rows, the prices (B, M, 2)."""
        return torch.einsum("bmna,bm->bna", self.rows, prices[..., 0] - prices[..., 1])

    def missed(self, z: Tensor) -> Tensor:
        """(B, 6) G f + w, unit frame."""
        return torch.einsum("brna,bna->br", self.balance, z) + self.load

    def cost_of_missing(self, missed: Tensor) -> Tensor:
        """(B,) of balance (B, 6), 0 where the softness is 0."""
        exact = self.softness == 0.0
        return torch.where(exact, 0.0, _dot(missed, missed) / (2.0 * torch.where(exact, 1.0, self.softness)))

    def softened(self, z: Tensor, edge: float, softness: float) -> Tensor:
        """Return (B,) True if a limit at z, or balance, is softer than at the given edge and softness."""
        limits = (self.slack(z) < self.floor).flatten(1).any(1) & (self.edge > edge)
        return limits | (self.softness > softness)

    def value(self, z: Tensor) -> Tensor:
        """(B,) the objective, with the cost of missing balance; inf unless strictly inside the cones."""
        u, o, t, v = z.unbind(-1)
        d, p, q = u * u - o * o - t * t, u - v, u + v
        inside = ((u > 0.0) & (d > 0.0) & (p > 0.0) & (q > 0.0)).all(1)
        total = 3.0 * self.omega * u + self.lam * (1.0 / u + 2.0 * u / d)
        total = total + torch.where(self.soft, self.lam * 2.0 * u / (p * q), 0.0)
        slack = self.slack(z)
        c = torch.maximum(slack, self.floor)
        e = (slack - c) / c
        limits = self.weights / c * (1.0 - e + e * e)
        total = total.sum(1) + limits.sum((1, 2)) + self.cost_of_missing(self.missed(z))
        return torch.where(inside, total, math.inf)

    def axes(self) -> Tensor:
        """(B, N, 4) forces along the axes of the cones."""
        u = (self.lam / self.omega).sqrt()
        return torch.stack([u, *(torch.zeros_like(u),) * 3], -1)

    def answers(self, z: Tensor, nu: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return force, torsion and multipliers in the caller's frame and units."""
        made, moment = self.per * z, self.shrink.unsqueeze(-1) * nu[:, 3:]
        multipliers = torch.cat([nu[:, :3] - torch.linalg.cross(moment, self.centre), moment], -1)
        return torch.einsum("bna,bnax->bnx", made[..., :3], self.frames), made[..., 3], multipliers


def _sane(given: Inputs) -> Tensor:
    """Return (B,) True if the numbers are valid: finite, within range, directions not zero."""
    good = []
    for name, a in given._asdict().items():
        if a is None:
            continue
        fits = a.abs() <= LARGEST
        if name in ("normals", "tangents"):
            square = _dot(a, a)
            fits = (square > 1e-200) & (square < 1e200)
        elif name in ("friction", "torsional_friction"):
            fits &= a >= 0.0
        elif name in ("force_weight", "barrier_weight"):
            fits &= a > 0.0
        elif name in ("torque_limit", "min_normal", "max_normal"):
            fits |= a == math.inf
        good.append(fits.flatten(1).all(1))
    if given.tangents is not None:
        across = torch.linalg.cross(_unit(given.normals), _unit(given.tangents))
        good.append((_dot(across, across) > 1e-24).all(1))
    return torch.stack(good).all(0)


def _frames(given: Inputs) -> Tensor:
    n = _unit(given.normals)
    if given.tangents is None:
        axes = torch.eye(3, dtype=n.dtype, device=n.device)
        along = torch.where(n[..., :1].abs() > TANGENT_SWITCH, axes[1], axes[0])
    else:
        along = _unit(given.tangents)
    for _ in range(2):  # the second pass removes rounding for a tangent close to n
        along = _unit(along - _dot(along, n).unsqueeze(-1) * n)
    return torch.stack([n, along, torch.linalg.cross(n, along)], -2)


def _place(given: Inputs) -> _Problem:
    """Return contacts, wrench and limits in cone coordinates and in the unit frame."""
    frames = _frames(given)
    rough = (given.friction > 0.0).all(-1, keepdim=True)
    mu = torch.where(rough, given.friction, 1.0)
    mean = (mu[..., :1] * mu[..., 1:]).sqrt()
    gamma = torch.zeros_like(mean) if given.torsional_friction is None else given.torsional_friction.unsqueeze(-1)
    per = torch.cat([1.0 / mean, torch.where(rough, mu / mean, 0.0), gamma / mean], -1)

    centre = given.positions.mean(1)
    arms = given.positions - centre.unsqueeze(1)
    square = (arms * arms).sum(-1).mean(1)
    shrink = torch.where(square > 0.0, torch.where(square > 0.0, square, 1.0).rsqrt(), 1.0)
    normal = frames[:, :, :1]
    pushes = torch.cat([frames, torch.zeros_like(normal)], 2)
    moments = torch.cat([torch.linalg.cross(arms.unsqueeze(2).expand_as(frames), frames), normal], 2)
    balance = torch.cat([pushes, shrink.view(-1, 1, 1, 1) * moments], -1) * per.unsqueeze(-1)
    push, twist = given.wrench[:, :3], given.wrench[:, 3:]
    load = torch.cat([push, shrink.unsqueeze(-1) * (twist - torch.linalg.cross(centre, push))], -1)
    none = torch.zeros_like(shrink)
    return _Problem(
        frames, per, centre, shrink, balance.permute(0, 3, 1, 2), load, given.force_weight, given.barrier_weight,
        gamma.squeeze(-1) > 0.0, *_limits(given, frames, per), none + _FIRST_EDGE, none,
    )  # fmt: skip


def _limits(given: Inputs, frames: Tensor, per: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return unit rows, bounds, weights and scales of the limits of joints and normal forces; see `_Problem`."""
    rows, no_bounds = [per.new_zeros(len(per), 0, *per.shape[1:])], per.new_zeros(len(per), 0)
    high, low = [no_bounds], [no_bounds]
    if given.jacobian is not None and given.torque_limit is not None:
        push = torch.einsum("bnax,bnxj->bjna", frames, given.jacobian[:, :, :3])
        turn = torch.zeros_like(push[..., :1])
        if given.jacobian.shape[2] == 6:
            turn = torch.einsum("bnax,bnxj->bjna", frames[:, :, :1], given.jacobian[:, :, 3:])
        rows.append(torch.cat([push, turn], -1) * per.unsqueeze(1))
        bias = 0.0 if given.torque_bias is None else given.torque_bias
        high.append(given.torque_limit - bias)
        low.append(given.torque_limit + bias)
    if given.min_normal is not None or given.max_normal is not None:
        most, least = given.max_normal, given.min_normal
        none = torch.full_like(given.force_weight, math.inf)
        rows.append(torch.nn.functional.pad(torch.diag_embed(per[..., 0]).unsqueeze(-1), (0, 3)))
        high.append(none if most is None else most)
        low.append(none if least is None else torch.where(least > 0.0, -least, math.inf))
    row, bound = torch.cat(rows, 1), torch.stack([torch.cat(high, 1), torch.cat(low, 1)], -1)
    there = bound < math.inf
    # the norm is taken in (u, o, t, u - v), in which opposite sides of a soft contact's cone are symmetric
    skewed = torch.stack([row[..., 0] + row[..., 3], *row[..., 1:].unbind(-1)], -1)
    parts = _dot(skewed, skewed)
    square = parts.sum(-1, keepdim=True)
    size = torch.where(square > 0.0, square, 1.0).sqrt()
    touched = ((parts > 0.0) | (square == 0.0)).to(row.dtype)
    share = touched / touched.sum(-1, keepdim=True)
    lam, omega = (torch.einsum("bmn,bn->bm", share, a) for a in (given.barrier_weight, given.force_weight))
    weights = torch.where(there, lam.unsqueeze(-1), 0.0)
    bounds = torch.where(there, torch.where(there, bound, 1.0) / size, 1e100)
    return row / size.unsqueeze(-1), bounds, weights, (lam / omega).sqrt()


# --- Newton


class _NewtonSystem:
    """Factored Newton system at z.

    With H^-1 = L L^T contact by contact, and the rows of balance and of limits M = [A; sqrt(bend) R] L, the step L s solves
    s + M^T mu = -L^T gradient, M s - D mu = -(missed, 0), where D is the softness for balance and 1 for limits: one system
    (M M^T + D) mu of 6 + M unknowns.
    """

    def __init__(self, problem: _Problem, z: Tensor) -> None:
        u, o, t, v = z.unbind(-1)
        lam, soft = problem.lam, problem.soft
        slack = problem.slack(z)
        c = torch.maximum(slack, problem.floor)
        self.bend = 2.0 * problem.weights / c**3
        self.price = problem.weights / (c * c) - self.bend * (slack - c)

        # the cone's barrier is lambda (1/p + 1/q + 2/(p + q)), p = u - s, q = u + s; torsion's lambda (1/m + 1/n), m = u - v, n = u + v
        s = (o * o + t * t).sqrt()
        straight = s < 1e-140
        eo, et = torch.where(straight, 1.0, o / s), torch.where(straight, 0.0, t / s)
        p, q = u - s, u + s
        m, n = torch.where(soft, u - v, 1.0), torch.where(soft, u + v, 1.0)
        lam_v = torch.where(soft, lam, 0.0)
        across = 4.0 * lam * u / (p * q) ** 2
        squeeze = lam * (p**-2 + q**-2 + u**-2) + lam_v * (m**-2 + n**-2)
        gradient = [3.0 * problem.omega - squeeze, across * o, across * t, lam_v * (m**-2 - n**-2)]
        self.gradient = torch.stack(gradient, -1) + problem.pulled(self.price)

        # torsion v = lever * u + rest: the rest is a separate axis, and u gains curvature
        cubes = m**3 + n**3
        lever = torch.where(soft, (n**3 - m**3) / cubes, 0.0)
        rest = torch.where(soft, ((m * n) ** 3 / (2.0 * lam * cubes)).sqrt(), 0.0)
        # in (p, q) the Hessian is diag(hp, hq) + k: two axes, and one across both
        hp, hq, k = 2.0 * lam / p**3, 2.0 * lam / q**3, 0.5 * lam / u**3 + 2.0 * lam_v / cubes
        a = hp + k
        b = (hq + k * (hp / a)).sqrt()
        zero = torch.zeros_like(u)
        normal = torch.stack([0.5 / a.sqrt(), 0.5 * (hp / a) / b, zero, zero], -1)
        outward = torch.stack([-0.5 / a.sqrt(), 0.5 * (1.0 + k / a) / b, zero, zero], -1)
        around = torch.stack([zero, zero, across.rsqrt(), zero], -1)
        turn = torch.stack([zero, zero, zero, rest], -1)
        eo, et, lever = eo.unsqueeze(-1), et.unsqueeze(-1), lever.unsqueeze(-1)
        axes = [normal, eo * outward - et * around, et * outward + eo * around, lever * normal + turn]
        self.axes = torch.stack(axes, -2)  # (B, N, 4 coordinates, 4 axes)

        stiff = self.bend.sum(-1).sqrt()
        both = torch.cat([problem.balance, stiff.view(*stiff.shape, 1, 1) * problem.rows], 1)
        self.rows = torch.einsum("brna,bnak->brnk", both, self.axes).flatten(2)
        self.diagonal = torch.cat([problem.softness.unsqueeze(-1).expand(-1, 6), torch.ones_like(stiff)], -1)
        self._factor()

    def _factor(self) -> None:
        system = self.rows @ self.rows.mT + torch.diag_embed(self.diagonal)
        lower, failed = torch.linalg.cholesky_ex(system)
        self.sound = (failed == 0) & _finite(system)
        self.lower = _pick(self.sound, lower, torch.eye(system.shape[-1], dtype=system.dtype, device=system.device))

    def solve(self, pull: Tensor, push: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Solve [H -A^T; A softness] (x; nu) = (pull (B, N, 4); push (B, 6)) for (x, nu), and return (B,) True if they are finite."""
        right = torch.cat([push, torch.zeros_like(self.diagonal[:, 6:])], -1)
        s = torch.einsum("bnak,bna->bnk", self.axes, pull).flatten(1)
        mu = torch.zeros_like(self.diagonal)
        for _ in range(3):  # the latter two refine
            left = (self.rows @ s.unsqueeze(-1)).squeeze(-1) - self.diagonal * mu - right
            more = torch.cholesky_solve(left.unsqueeze(-1), self.lower)
            mu = mu + more.squeeze(-1)
            s = s - (self.rows.mT @ more).squeeze(-1)
        x = torch.einsum("bnak,bnk->bna", self.axes, s.view(pull.shape))
        return x, -mu[:, :6], self.sound & _finite(x, mu)


class _StiffSystem(_NewtonSystem):
    """The same system by orthogonal factors, for prices so high that it loses its digits.

    (s, -sqrt(D) mu) is the point nearest to (-L^T gradient, 0) among those with [M, sqrt(D)] (s, .) = -(missed, 0). Its error grows with the
    condition of M, that of the system above with its square. The largest rows come first, so that small ones keep their digits.
    """

    def _factor(self) -> None:
        tall = torch.cat([self.rows, torch.diag_embed(self.diagonal.sqrt())], -1).mT
        sizes = _dot(tall, tall)
        self.sound = _finite(tall)
        self.order = sizes.argsort(-1, descending=True)
        tall = _pick(self.sound, tall.gather(1, self.order.unsqueeze(-1).expand_as(tall)), 1.0)
        self.q, self.r = torch.linalg.qr(tall)
        heads = self.r.diagonal(dim1=-2, dim2=-1)
        self.sound &= (heads != 0.0).all(-1)
        self.r = torch.where(
            self.sound.view(-1, 1, 1), self.r, torch.eye(heads.shape[-1], dtype=heads.dtype, device=heads.device)
        )

    def solve(self, pull: Tensor, push: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Solve as the base class does."""
        right = torch.cat([push, torch.zeros_like(self.diagonal[:, 6:])], -1).unsqueeze(-1)
        s = torch.einsum("bnak,bna->bnk", self.axes, pull).flatten(1)
        near = torch.cat([s, torch.zeros_like(self.diagonal)], -1).gather(1, self.order).unsqueeze(-1)
        along = torch.linalg.solve_triangular(self.r.mT, right, upper=False)
        mu = torch.zeros_like(right)
        for _ in range(2):  # the second removes what rounding has left in the plane
            more = self.q.mT @ near - along
            near = near - self.q @ more
            mu = mu + torch.linalg.solve_triangular(self.r, more, upper=True)
        s = torch.zeros_like(near[..., 0]).scatter(1, self.order, near[..., 0])[:, : s.shape[1]]
        x = torch.einsum("bnak,bnk->bna", self.axes, s.view(pull.shape))
        return x, -mu[:, :6, 0], self.sound & _finite(x, mu)


def _way(z: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Return (B, N) the step across the way to the apex of each cone, and along it, relative to the distance from the surface."""
    u, o, t, _ = z.unbind(-1)
    du, do, dt, _ = step.unbind(-1)
    inverse = 1.0 / (u * u - o * o - t * t).sqrt()
    along = (u * du - o * do - t * dt) * inverse * inverse
    k = (du * inverse + along) / (1.0 + u * inverse)
    return inverse * ((do - k * o) ** 2 + (dt - k * t) ** 2).sqrt(), along


def _inverse_reach(problem: _Problem, z: Tensor, step: Tensor) -> Tensor:
    """(B,) 1 / (largest multiple of the step inside the cones)."""
    (u, v), (du, dv), (away, along) = z[..., ::3].unbind(-1), step[..., ::3].unbind(-1), _way(z, step)
    turn = torch.maximum((dv - du) / (u - v), -(dv + du) / (u + v))
    return torch.maximum(away - along, torch.where(problem.soft, turn, -math.inf)).amax(1)


def _relative_step(problem: _Problem, z: Tensor, step: Tensor) -> Tensor:
    """(B,) the step as a fraction of the largest force and, towards them or away, of the distances from the cones' surfaces."""
    (u, v), (du, dv), (away, along) = z[..., ::3].unbind(-1), step[..., ::3].unbind(-1), _way(z, step)
    turn = torch.maximum((dv - du).abs() / (u - v), (dv + du).abs() / (u + v))
    most = torch.maximum(away + along.abs(), torch.where(problem.soft, turn, 0.0)).amax(1)
    return torch.maximum(most, step[..., :3].abs().amax((1, 2)) / u.amax(1))


def _lower_bound(problem: _Problem, at: _NewtonSystem, z: Tensor, step: Tensor, nu: Tensor) -> Tensor:
    """(B,) a lower bound of the objective by duality, at multipliers and prices of Newton's model after the step; -inf: none.

    A barrier weight / x is at least 2 sqrt(weight * price) - price * x for every price >= 0. What is linear in z then cancels.
    """
    lam = problem.lam
    (u, _, _, v), (du, _, _, dv) = z.unbind(-1), step.unbind(-1)

    def price(x: Tensor, dx: Tensor) -> Tensor:
        return lam * ((1.0 - 2.0 * dx / x) / (x * x)).clamp(min=0.0)

    prices = (at.price + at.bend * problem.along(step)).clamp(min=0.0)
    y = torch.einsum("brna,br->bna", problem.balance, nu) - problem.pulled(prices)
    turn = y[..., 3]
    squeeze = torch.maximum(price(u - v, du - dv) + price(u + v, du + dv), turn.abs())
    torsion = (2.0 * lam).sqrt() * ((squeeze + turn).sqrt() + (squeeze - turn).sqrt())
    left = 3.0 * problem.omega - y[..., 0] - torch.where(problem.soft, squeeze, 0.0)
    across = (y[..., 1] ** 2 + y[..., 2] ** 2).sqrt()
    room = left - across
    some = room > 0.0
    room = torch.where(some, room, 1.0)
    height = torch.minimum(price(u, du), room / 1.5)  # at an optimum it is no more, since q <= 2 u
    low = 0.5 * (room - height)
    cone = 2.0 * lam.sqrt() * (height.sqrt() + low.sqrt() + (low + across).sqrt())

    there, floor = problem.weights > 0.0, problem.floor
    weight = torch.where(there, problem.weights, 1.0)
    inside = torch.minimum(prices, torch.where(floor > 0.0, weight / (floor * floor), math.inf))
    over = prices - inside
    limits = (
        2.0 * (weight * inside).sqrt() + over * floor - 0.25 * floor**3 / weight * over * over - prices * problem.bounds
    )
    total = (cone + torch.where(problem.soft, torsion, 0.0)).sum(1) + torch.where(there, limits, 0.0).sum((1, 2))
    total = total - _dot(nu, problem.load) - 0.5 * problem.softness * _dot(nu, nu)
    return torch.where(some.all(1) & total.isfinite(), total, -math.inf)


class _Descent(NamedTuple):
    """Result of a descent, each (B, ...); `status` as in `Solved`."""

    z: Tensor
    nu: Tensor
    value: Tensor
    bound: Tensor
    iterations: Tensor
    status: Tensor


def _descend(problem: _Problem, z: Tensor, edge: float, softness: float, tolerance: float, limit: int) -> _Descent:
    """Minimise by damped Newton steps from z, strictly inside the cones and balanced if `softness` is 0; finished elements leave the batch.

    The problem's edge is lowered to the given one, or until every slack is above it. If `edge` is 0 and no force is within the limits, the
    element ends with LIMITS_EXCEEDED. The softness starts where the residual of balance costs no more than Phi, and is lowered, too.
    """
    none = torch.zeros_like(z[:, 0, 0])
    if softness > 0.0:
        missed = problem.missed(z)
        begin = _dot(missed, missed) / (1.0 + problem.value(z))
        problem = problem._replace(softness=begin.clamp(min=softness))
    done = _Descent(z.clone(), torch.zeros_like(problem.load), none.clone(), none.clone(), none.clone(), none.clone())
    active, now = torch.arange(len(z), device=z.device), problem
    value, bound, steps = now.value(z), none - math.inf, none.clone()
    for taken in range(limit + 65):
        at = _NewtonSystem(now, z)
        missed = now.missed(z)
        step, nu, good = at.solve(-at.gradient, -missed)
        decrement = 2.0 * now.cost_of_missing(missed) + _dot(missed, nu) - (at.gradient * step).sum((1, 2))
        softened = now.softened(z, edge, softness)
        settled = good & softened & (decrement < _SETTLED * now.without_limits().value(z))
        going = good & ~settled

        alpha = torch.where(going, (_REACH / _inverse_reach(now, z, step).clamp(min=1e-300)).clamp(max=1.0), 0.0)
        flat = decrement < 1e-9 * value
        held, found, trial = going, value, z
        for _ in range(_HALVINGS):
            trial = z + _pick(good, alpha.view(-1, 1, 1) * step, 0.0)
            found = now.value(trial)
            fits = (found < value - 1e-4 * alpha * decrement) | (flat & (found <= value * (1.0 + 1e-13)))
            held = going & ~fits
            if not bool(held.any()):
                break
            alpha = torch.where(held, 0.5 * alpha, alpha)
        moved = going & ~held
        harder = settled | (held & softened)  # or only rounding is left
        lost = softened & (~good | (harder & (now.edge < _LAST_EDGE))) & (edge + softness == 0.0)
        steps = steps + moved
        bound = torch.where(good, torch.maximum(bound, _lower_bound(now, at, z, step, nu)), bound)
        z, value = _pick(moved, trial, z), torch.where(moved, found, value)

        closed = ~now.softened(z, edge, softness) & ~lost & (bound > 0.0) & (value - bound <= tolerance * bound)
        closed = closed & (flat | (decrement < math.sqrt(tolerance) * value))
        status = torch.where((steps >= limit) | (taken == limit + 64), LIMIT, none[active] - 1.0)
        status = torch.where(~moved & ~harder, STALLED, status)
        status = torch.where(closed, OPTIMAL, status)
        status = torch.where(lost, LIMITS_EXCEEDED, status)
        ended = status >= 0.0
        if bool(ended.any()):
            for whole, part in zip(done, (z, nu, value, bound, steps, status), strict=True):
                whole[active[ended]] = part[ended]
            if bool(ended.all()):
                break
        left = ~ended
        now = now._replace(
            edge=torch.where(harder, (_LOWER * now.edge).clamp(min=edge), now.edge),
            softness=torch.where(harder, (_LOWER * now.softness).clamp(min=softness), now.softness),
        ).take(left)
        active, z, value, bound, steps = (a[left] for a in (active, z, value, bound, steps))
        value = torch.where(harder[left], now.value(z), value)

    # whole steps, each of which squares the error
    now = problem._replace(edge=none + edge, softness=none + softness)
    z, nu = done.z, done.nu
    for _ in range(_POLISH_STEPS):
        at = _NewtonSystem(now, z)
        step, more, good = at.solve(-at.gradient, -now.missed(z))
        good = good & (_inverse_reach(now, z, step) < 0.5) & (done.status == OPTIMAL)
        z, nu = _pick(good, z + step, z), _pick(good, more, nu)
    return done._replace(z=z, nu=nu)


class _Finished(NamedTuple):
    """Result of `_finish`, each (B, ...)."""

    z: Tensor
    nu: Tensor
    iterations: Tensor
    converged: Tensor


def _finish(problem: _Problem, z: Tensor, nu: Tensor, edge: float, softness: float) -> _Finished:
    """Minimise with the stiff system, to the last digits.

    For elastic forces, `edge` > 0, the penalties grow by stages. Each starts close to its optimum, because a cone's surface is curved and a
    step along it is as short as the distance from it. For others take whole steps. Where the value no longer tells two points apart, the
    steps tell: each is much shorter than the one before.
    """
    none = torch.zeros_like(z[:, 0, 0])
    done = _Finished(z.clone(), nu.clone(), none.clone(), none > 0.0)
    active = torch.arange(len(z), device=z.device)
    now = problem._replace(edge=none + (_FIRST_EDGE if edge else 0.0), softness=none)

    def harden(now: _Problem, where: Tensor) -> _Problem:
        if not edge:
            return now
        edges = torch.where(where, (_HARDER * now.edge).clamp(min=edge), now.edge)
        return now._replace(edge=edges, softness=softness * (edges / edge) ** 3)

    now = harden(now, none > 0.0)
    value, before = now.value(z), none + math.inf
    for _ in range(_STIFF_STEPS if len(z) else 0):
        at = _StiffSystem(now, z)
        pull = torch.einsum("brna,br->bna", now.balance, nu) - at.gradient
        missed = now.missed(z)
        step, change, good = at.solve(pull, -(missed + now.softness.unsqueeze(-1) * nu))
        exact = (now.softness == 0.0).unsqueeze(-1)
        push = torch.where(exact, 0.0, missed / torch.where(exact, 1.0, now.softness.unsqueeze(-1)))
        decrement = -((at.gradient + torch.einsum("brna,br->bna", now.balance, push)) * step).sum((1, 2))
        moved, reach = _relative_step(now, z, step), _inverse_reach(now, z, step)
        good = good & moved.isfinite() & ((reach < 0.5) | (now.edge > 0.0))
        last = now.edge == edge
        close = last & (moved < _SHORT)
        rounding = good & close & ~(moved < 0.25 * before)
        trying = good & ~rounding
        alpha = torch.where(trying, (_REACH / reach.clamp(min=1e-300)).clamp(max=1.0), 0.0)
        found, high = value, trying
        for _ in range(_HALVINGS):
            found = now.value(z + _pick(trying, alpha.view(-1, 1, 1) * step, 0.0))
            high = trying & ~close & ~(found <= value + _NOISE * value - 1e-4 * alpha * decrement)
            if not bool(high.any()):
                break
            alpha = torch.where(high, 0.5 * alpha, alpha)
        else:
            alpha = torch.where(high, 0.0, alpha)
        going = trying & (~last | (alpha > 0.0))
        z = z + _pick(going, alpha.view(-1, 1, 1) * step, 0.0)
        nu, value = nu + _pick(going, change, 0.0), torch.where(alpha > 0.0, found, value)
        whole = alpha == 1.0
        converged = good & close & (rounding & (moved < _ROUGH) | (moved < _LEAST))
        before = torch.where(close, moved, math.inf)
        harder = going & ~last & ((whole & (moved < _STAGE)) | (alpha == 0.0))
        now = harden(now, harder)
        value, before = torch.where(harder, now.value(z), value), torch.where(harder, math.inf, before)
        done.z[active], done.nu[active] = z, nu
        done.iterations[active] += going
        done.converged[active] = converged
        left = going & ~converged
        if not bool(left.any()):
            break
        active, z, nu, value, before, now = active[left], z[left], nu[left], value[left], before[left], now.take(left)
    return done


def _stiff(problem: _Problem, z: Tensor, nu: Tensor) -> Tensor:
    """Return (B,) True for problems beside a limit, or with multipliers of a size that only a small slack has."""
    tight = (problem.slack(z) < _TIGHT * problem.scales.unsqueeze(-1)).flatten(1).any(1)
    return tight | (nu.abs().amax(1) > _DEAR * problem.omega.amin(1))


# --- starts


def _internal(problem: _Problem) -> tuple[Tensor, Tensor]:
    """Return an internal force strictly inside the cones, by infeasible-start Newton from their axes, and True where it exists."""
    free = problem.without_limits()._replace(load=torch.zeros_like(problem.load))
    z = free.axes()
    found = torch.zeros_like(z[:, 0, 0], dtype=torch.bool)
    going = ~found
    for _ in range(40):
        at, missed, size = _NewtonSystem(free, z), free.missed(z), z[..., 0].amax(1)
        step, _, good = at.solve(-at.gradient, -missed)
        going = going & good & (size < LARGEST)
        close = (missed.abs().amax(1) < 1e-9 * size) & (step[..., 0].abs().amax(1) < 1e-2 * size)
        found, going = found | (going & close), going & ~close
        if not bool(going.any()):
            break
        alpha = (0.9 / _inverse_reach(free, z, step).clamp(min=1e-300)).clamp(max=1.0)
        z = _pick(going, z + alpha.view(-1, 1, 1) * step, z)
    return z, found


def _from_internal(problem: _Problem) -> tuple[Tensor, Tensor]:
    """Return the least-norm balancing force plus enough of an internal force to be inside the cones, and True where it exists."""
    internal, found = _internal(problem)
    rows = problem.balance.flatten(2)
    lower, _ = torch.linalg.cholesky_ex(rows @ rows.mT)
    least = -(rows.mT @ torch.cholesky_solve(problem.load.unsqueeze(-1), lower)).view(internal.shape)
    needed = 1.1 * _inverse_reach(problem, internal, least) + 0.5
    z = least + needed.clamp(min=1.0).view(-1, 1, 1) * internal
    return z, found & (problem.value(z) < math.inf)


def _from_penalty(problem: _Problem) -> tuple[Tensor, Tensor, Tensor]:
    """Return a balanced force inside the cones without force closure, (B,) True if found, (B,) True if a bound excludes it."""
    free = problem.without_limits()
    # a thousand times the objective expected from load and barriers
    impossible = 3e3 * (free.omega.amax(1) * free.load.abs().amax(1) + (free.omega * free.lam).sqrt().sum(1))
    z = best = free.axes()
    found = hopeless = impossible < 0.0
    for softness in _SOFTNESSES:
        near = _descend(free, z, 0.0, softness, 1e-6, 100)
        z, (balanced, good) = near.z, _balanced(free, near.z)
        best, found = _pick(good & ~found, balanced, best), found | good
        hopeless = ~found & (near.bound > impossible)
        if bool((found | hopeless).all()):
            break
    return best, found, hopeless


def _from_force(problem: _Problem, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return the balanced force nearest to an earlier force (B, N, 3) in the caller's frame, and True if both are inside the cones."""
    free, per = problem.without_limits(), problem.per[..., :3]
    z = torch.einsum("bnx,bnax->bna", start.nan_to_num(), problem.frames) / torch.where(per > 0.0, per, math.inf)
    z = torch.cat([z, torch.zeros_like(z[..., :1])], -1)
    inside = free.value(z) < math.inf
    z, found = _balanced(free, _pick(inside, z, free.axes()))
    return z, found & inside


def _balanced(free: _Problem, z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the force after the smallest change in the Hessian that restores balance, and True if it is strictly inside the cones."""
    good = torch.ones_like(z[:, 0, 0], dtype=torch.bool)
    for _ in range(2):  # the second removes rounding
        step, _, sound = _NewtonSystem(free, z).solve(torch.zeros_like(z), -free.missed(z))
        good = good & sound & (free.value(z + step) < math.inf)
        z = _pick(good, z + step, z)
    size = free.load.abs().amax(1) + z[..., 0].amax(1)
    return z, good & (free.missed(z).abs().amax(1) <= 1e-9 * size)


def _full_rank(problem: _Problem) -> Tensor:
    """Return (B,) True if the contacts span all wrenches."""
    columns = problem.balance / torch.where(problem.per > 0.0, problem.per, 1.0).unsqueeze(1)
    sizes = torch.linalg.svdvals(columns.flatten(2))
    return (sizes[:, -1] > 0.0) & (sizes[:, -1] >= _RANK * sizes[:, 0]) & (sizes.shape[1] == 6)


# --- the two calls


@torch.no_grad()
def solve(given: Inputs, tolerance: float = 1e-10, max_iterations: int = 200, start: Tensor | None = None) -> Solved:
    """Return the optimal forces of all problems.

    The results of an element with invalid numbers are zeros; it never affects other elements. An element without a force inside the cones
    and limits gets the elastic force, see `GraspForces`. `start`: (B, N, 3) earlier forces in the caller's frame [N], used if a balanced
    force inside the cones is near.
    """
    batch, count = given.positions.shape[:2]
    whole = Solved(*(given.positions.new_zeros(batch, *tail) for tail in tails(count)))
    whole.state[:, -1], whole.facts[:, 0], whole.facts[:, 1] = NOTHING, REFUSED, math.inf
    sane = _sane(given).nonzero().flatten()
    if len(sane):
        part = _solve_sane(
            given.map(lambda a: a[sane]), tolerance, max_iterations, None if start is None else start[sane]
        )
        # numbers so far apart that the result overflows are refused, too
        finite = _finite(*part[:3], part.facts[:, 2:], part.state)
        for to, a in zip(whole, part, strict=True):
            to[sane[finite]] = a[finite]
    return whole


def _solve_sane(given: Inputs, tolerance: float, max_iterations: int, start: Tensor | None) -> Solved:
    problem = _place(given)
    none, full_rank = torch.zeros_like(problem.shrink), _full_rank(problem)
    z, begun = _from_internal(problem)
    if start is not None:
        warm, near = _from_force(problem, start)
        room = (problem.slack(warm) / problem.scales.unsqueeze(-1)).flatten(1)
        room = torch.cat([room, problem.edge.unsqueeze(-1)], 1).amin(1)
        problem = problem._replace(edge=torch.where(near & (room > _LAST_EDGE), room, problem.edge))
        z, begun = _pick(near, warm, z), begun | near
    begun &= full_rank
    lacking, hopeless = full_rank & ~begun, none > 0.0
    if bool(lacking.any()):
        z[lacking], begun[lacking], hopeless[lacking] = _from_penalty(problem.take(lacking))

    status = torch.where(hopeless, INFEASIBLE, torch.where(full_rank, UNDECIDED, none + RANK_LOST))
    z = _pick(begun, z, problem.axes())
    whole = _Descent(z.clone(), torch.zeros_like(problem.load), none.clone(), none.clone(), none.clone(), status)
    mode = none.clone()

    def descend(where: Tensor) -> None:
        if not bool(where.any()):
            return
        found = _descend(problem.take(where), z[where], 0.0, 0.0, tolerance, max_iterations)
        for to, a in zip(whole, found, strict=True):
            to[where] = a

    def finish(kind: int, where: Tensor) -> None:
        if not bool(where.any()):
            return
        edge, softness = 0.0 if kind == BALANCED else EDGE, SOFTNESS if kind == UNBALANCED else 0.0
        begin = whole.z if kind == BALANCED else z
        found = _finish(problem.take(where), begin[where], whole.nu[where], edge, softness)
        whole.z[where], whole.nu[where] = found.z, found.nu
        if kind != BALANCED:
            whole.iterations[where] += found.iterations
            mode[where] = torch.where(found.converged, float(kind), float(NOTHING)).to(mode.dtype)

    descend(begun)
    finish(BALANCED, begun & (whole.status == OPTIMAL) & _stiff(problem, whole.z, whole.nu))
    finish(EXCEEDING, whole.status == LIMITS_EXCEEDED)
    finish(UNBALANCED, ~begun)
    gap = torch.where(whole.bound > 0.0, (whole.value - whole.bound).clamp(min=0.0) / whole.bound, math.inf)
    gap = torch.where(whole.status <= STALLED, gap, math.inf)
    residual = problem.missed(whole.z).abs().amax(1)
    facts = torch.stack([whole.status, gap, residual, whole.iterations], -1)
    state = torch.cat([whole.z.flatten(1), whole.nu, mode.unsqueeze(-1)], -1)
    return Solved(*problem.answers(whole.z, whole.nu), facts, state)


def gradients(
    given: Inputs, state: Tensor, d_force: Tensor, d_torsion: Tensor, d_multipliers: Tensor, elastic: bool = False
) -> Inputs:
    """Return gradients of a loss with respect to all inputs, from those with respect to the results, by one adjoint solve.

    At the optimum R(x, nu; inputs) = (grad E - A^T nu, A x + w + softness nu) = 0. With the adjoint (p, q) of its Jacobian,
    [H -A^T; A softness] (p; q) = (dL/dx; -dL/dnu), the gradient is dL/dinputs = direct part - d ((p, -q) . R) / d inputs.

    Args:
        given, state: inputs and state of `solve`.
        d_force, d_torsion, d_multipliers: gradients of the loss, (B, N, 3), (B, N), (B, 6).
        elastic: True if elements without an optimum have the gradient of their elastic force, else zero.
    """
    made, mode = given.map(torch.zeros_like), state[:, -1]
    where = ((mode == BALANCED) | ((mode != NOTHING) & elastic)).nonzero().flatten()
    if not len(where):
        return made
    mode, count = mode[where], given.positions.shape[1]
    with torch.enable_grad():
        inputs = given.map(lambda a: a[where].detach().requires_grad_())
        leaves = [a for a in inputs if a is not None]
        z = state[where, : 4 * count].view(-1, count, 4).detach().requires_grad_()
        nu = state[where, 4 * count : -1].detach().requires_grad_()
        problem = _place(inputs)
        problem = problem._replace(edge=EDGE * (mode != BALANCED).to(z.dtype))
        losses = (a[where] for a in (d_force, d_torsion, d_multipliers))
        direct = sum(((d * a).sum() for d, a in zip(losses, problem.answers(z, nu), strict=True)), z.new_zeros(()))
        pull, push = torch.autograd.grad(direct, (z, nu), retain_graph=True)
        with torch.no_grad():
            soft = problem._replace(softness=SOFTNESS * (mode == UNBALANCED).to(z.dtype))
            p, q, good = _NewtonSystem(soft, z).solve(pull, -push)
            stiff = ((mode != BALANCED) | _stiff(problem, z, nu)).nonzero().flatten()
            if len(stiff):
                p[stiff], q[stiff], good[stiff] = _StiffSystem(soft.take(stiff), z[stiff]).solve(
                    pull[stiff], -push[stiff]
                )
            p, q = _pick(good, p, 0.0), _pick(good, q, 0.0)
        missed = problem.missed(z)
        (left,) = torch.autograd.grad(problem.value(z).sum() - (nu.detach() * missed).sum(), z, create_graph=True)
        found: Any = torch.autograd.grad(direct - (p * left).sum() + (q * missed).sum(), leaves, materialize_grads=True)
    good = good & _finite(*found)
    for to, a in zip((a for a in made if a is not None), found, strict=True):
        to[where] = _pick(good, a, 0.0)
    return made
