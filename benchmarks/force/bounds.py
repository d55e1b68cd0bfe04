"""Bounds and proofs from a force, multipliers or a witness, computed from the problem alone.

`Measure` holds every formula, for floats and for object arrays of mpmath's numbers. Forces and
moments are compared in N: moments are taken about the centre of the contacts that touch and divided
by their root mean square distance from it.

The multipliers are (nu, p), those of balance (6,) and of the limits (L,) >= 0. The gradient of an
objective is G^T nu - B^T p plus a part that the cones carry, and d objective / d wrench = -nu. This
module needs numpy only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.force.problems import BARRIER_WEIGHT, Array, Problem

Numbers = NDArray[Any]
"""Floats, or numbers of mpmath in an object array."""
REACH = 10**6
"""A witness excludes forces whose normal forces total up to this many times the wrench."""
ROUNDING = 1e-15
"""Rounding of a sum of a few products, relative to their sizes."""


def least(low: Numbers, high: Numbers, weight: Any) -> tuple[Numbers, Numbers, Numbers]:
    """Minimise (low p + high q) / 2 + weight (2 / (p + q) + 1 / p + 1 / q) over a cone.

    Here p = u + s and q = u - s. At a fixed ratio r = q / p the least over p is 2 sqrt(weight c1 c2), c1 = (low + high r) / 2, c2
    = 1 + 1 / r + 2 / (1 + r). Over r it is stationary where r^2 ((1 + r)^2 + 2) = k ((1 + r)^2 + 2
    r^2), k = low / high.

    Args:
        low: (N,) >= 0.
        high: (N,) >= low; both include the cost of u.
        weight: lambda.

    Returns:
        (least, p, r), each (N,).
    """
    tiny = 1 / (0 * high + 10**150)
    k = np.maximum(low, 0) / np.maximum(high, tiny)
    r = np.sqrt(k)
    for _ in range(4):  # each contracts the error to less than 0.16 of it
        r = np.sqrt(k / (1 + 2 * (1 - k) / (1 + r) ** 2))
    r = np.maximum(r, tiny)
    for _ in range(6):  # Newton's steps: from 1e-3 to 1e-60
        q = 1 + r
        wide = q * q + 2
        r = r - (r * r * wide - k * (q * q + 2 * r * r)) / (
            2 * r * wide + 2 * r * r * q - k * (2 * q + 4 * r)
        )
        r = np.maximum(r, tiny)
    c1 = (low / r + high) / 2
    c2 = 1 + r + 2 * r / (1 + r)  # the one divided by r, the other times r
    return 2 * np.sqrt(weight * c1 * c2), np.sqrt(weight * c2 / np.maximum(c1, tiny)) / r, r


@dataclass(frozen=True, eq=False)
class Measure:
    """A problem in units of N, moments about `centre` and divided by `length`.

    Attributes:
        problem: the problem.
        matrix: (6, N, k), zero where a contact does not touch.
        load: (6,) the wrench.
        friction, spin: (N,) shares of Coulomb coefficients and torsional friction [m] that count;
            spin is 0 where a contact transmits no torsion.
        preload: (N,) normal forces that do not count for friction [N].
        rows, bound, size: (L, N, k), (L,), (L,) the limits.
        touching: (N,).
        centre: (3,) m.
        length: m.
        weight: lambda of `phi`.
    """

    problem: Problem
    matrix: Numbers
    load: Numbers
    friction: Numbers
    spin: Numbers
    preload: Numbers
    rows: Numbers
    bound: Numbers
    size: Numbers
    touching: NDArray[np.bool_]
    centre: Numbers
    length: Any
    weight: Any

    @classmethod
    def of(
        cls,
        problem: Problem,
        number: Callable[[Any], Numbers] = np.asarray,
        frames: Numbers | None = None,
    ) -> Measure:
        """Build the measure with arrays converted by `number` (float64 or mpmath).

        `frames` replace those of the problem.
        """
        n, k = problem.n_contacts, problem.width
        touching = problem.active
        spin = np.zeros(n) if problem.torsional_friction is None else problem.torsional_friction
        positions = number(problem.positions)
        wrench = number(problem.wrench)
        centre = positions[touching].sum(axis=0) / int(touching.sum())
        arms = positions - centre
        length = np.sqrt((arms[touching] ** 2).sum(axis=0).sum() / int(touching.sum()))
        # one column per row
        columns = (number(problem.frames) if frames is None else frames).transpose(0, 2, 1)
        matrix = np.concatenate([columns, np.cross(arms[:, None] / length, columns)], axis=2)
        if k == 4:
            turning = np.concatenate([0 * columns[:, :1], columns[:, :1] / length], axis=2)
            matrix = np.concatenate([matrix, turning], axis=1)
        return cls(
            problem,
            matrix.transpose(2, 0, 1) * touching[:, None],
            np.concatenate([wrench[:3], (wrench[3:] - np.cross(centre, wrench[:3])) / length]),
            number(problem.friction) * number(problem.share)[()],
            number(spin) * number(problem.share)[()],
            number(problem.shift),
            number(problem.limit_matrix.reshape(-1, n, k)),
            number(problem.limit_bound),
            number(problem.limit_size),
            touching,
            centre,
            length,
            number(BARRIER_WEIGHT)[()],
        )

    def twist(self, nu: Numbers) -> Numbers:
        """Convert multipliers nu (6,) about the origin to those about the centre [N per N]."""
        return np.concatenate([nu[:3] + np.cross(nu[3:], self.centre), nu[3:] * self.length])

    def about_origin(self, twist: Numbers) -> Numbers:
        """Invert `twist`."""
        turn = twist[3:] / self.length
        return np.concatenate([twist[:3] - np.cross(turn, self.centre), turn])

    def cost(self, name: str) -> Numbers:
        """Return the costs (N,) of a newton of normal force without the barrier."""
        return 3 * self.friction if name == "phi" else 1 + 0 * self.friction

    def objective(self, name: str, force: Numbers) -> Any:
        """Return the objective at a force (N k,) [N]; `phi` is inf unless it is inside all cones."""
        f = force.reshape(len(self.friction), -1)[self.touching]
        if name == "sum":
            return f[:, 0].sum()
        u = self.friction[self.touching] * (f[:, 0] - self.preload[self.touching])
        s = np.sqrt(f[:, 1] ** 2 + f[:, 2] ** 2)
        if not ((u > 0) & (u > s)).all():
            return np.inf
        return (3 * u + self.weight * (1 / u + 2 * u / ((u - s) * (u + s)))).sum()

    def missed(self, force: Numbers) -> Numbers:
        """Return G f + w (6,) [N]."""
        return self.matrix.reshape(6, -1) @ force + self.load

    def over(self, force: Numbers) -> Numbers:
        """Return B f - b (L,) [N, N m]."""
        return (self.rows.reshape(len(self.bound), len(force)) * force).sum(axis=1) - self.bound

    def sideways(self, f: Numbers) -> Numbers:
        """Return what friction has to hold of forces (N, k), (N,) [N].

        It is sqrt(o^2 + t^2 + (friction torsion / torsional_friction)^2), without torsion that a
        contact cannot transmit.
        """
        square = f[:, 1] ** 2 + f[:, 2] ** 2
        if f.shape[1] == 4:
            spins = self.spin > 0
            turning = self.friction * f[:, 3] / np.where(spins, self.spin, 1)
            square = square + np.where(spins, turning, 0) ** 2
        return np.sqrt(square)

    def inside(self, force: Numbers) -> Numbers:
        """Raise normal forces into the cones and drop components that a contact cannot transmit."""
        f = force.reshape(len(self.friction), -1) * self.touching[:, None]
        if f.shape[1] == 4:
            f[:, 3] *= self.spin > 0
        f[:, 0] = np.maximum(f[:, 0], self.preload + self.sideways(f) / self.friction)
        return f.reshape(-1)

    def upper(self, name: str, force: Numbers, multipliers: Numbers) -> Any:
        """Return an upper bound of the optimum from a force with small residuals.

        Normal forces are raised into the cones first. Then the absolute residuals of balance and
        limits are added times the multipliers. By convexity this is a bound if the multipliers are
        optimal.
        """
        f = self.inside(force) if name == "sum" else force
        balance = np.abs(self.twist(multipliers[:6])) @ np.abs(self.missed(f))
        limits = (np.abs(multipliers[6:]) * np.maximum(self.over(f), 0)).sum()
        return self.objective(name, f) + balance + limits

    def pull(self, twist: Numbers, p: Numbers) -> tuple[Numbers, Numbers]:
        """Return what G^T v - B^T p gains for a newton of normal force, along and across the normal.

        With g = G^T v - B^T p these are g_n and sqrt((friction g_o)^2 + (friction g_t)^2 +
        (torsional_friction g_tau)^2), (N,) each. A force in the cone gains at most their sum times
        its normal force.
        """
        g = np.einsum("rnk,r->nk", self.matrix, twist) - np.einsum("lnk,l->nk", self.rows, p)
        square = (self.friction * g[:, 1]) ** 2 + (self.friction * g[:, 2]) ** 2
        if g.shape[1] == 4:
            square = square + (self.spin * g[:, 3]) ** 2
        return g[:, 0], np.sqrt(square)

    def lower(self, name: str, multipliers: Numbers) -> Any:
        """Return a lower bound of the optimum from any multipliers (6 + L,).

        It is the least of the Lagrangian over the cones. With a = cost - G^T nu + B^T p, the
        Lagrangian is a . f - nu . w - p . b plus the barrier of `phi`. It has a least value where
        a_n >= sqrt((friction a_o)^2 + (friction a_t)^2 + (torsional_friction a_tau)^2) at every
        contact: the multipliers are multiplied by the largest theta <= 1 for which that holds. The
        cost of a newton of normal force is 1, or 3 friction for `phi`, whose barrier adds its least
        value (`least`). The cones begin at the preload s, which adds a . s, or for `phi`, which has
        no cost of s, -(G^T nu - B^T p) . s.
        """
        twist = self.twist(multipliers[:6])
        p = np.maximum(multipliers[6:], 0)
        cost = self.cost(name)
        along, across = self.pull(twist, p)
        most = ((along + across) / cost)[self.touching].max()
        theta = 1 / most if most > 1 else most * 0 + 1
        work = twist @ self.load + (p * self.bound).sum() + along @ self.preload
        bound = -(theta * work)
        if name == "sum":
            bound += self.preload.sum()
        else:
            low = np.maximum(cost - theta * (along + across), 0) / self.friction
            high = (cost - theta * (along - across)) / self.friction
            bound += least(low[self.touching], high[self.touching], self.weight)[0].sum()
        return bound

    def balance(self, force: Array) -> float:
        """Return the largest |component| of G f + w of a force (N k,) over that of the wrench.

        Without a wrench it is relative to the largest |component| of the force, torsion divided by
        the length.
        """
        size = np.abs(self.load).max() or np.abs(self._in_newtons(force)).max()
        return _relative(np.abs(self.missed(force)).max(), size)

    def violation(self, force: Array) -> float:
        """Return the distance of a force (N k,) from the cones over the largest |normal force|.

        It is the largest of sqrt(o^2 + t^2 + (friction torsion / torsional_friction)^2) - friction
        * inner and -inner over contacts that touch, and of |components| of the others, where inner
        is normal - preload. Torsion that a contact cannot transmit counts, divided by the length.
        """
        f = self._in_newtons(force)
        normal = f[:, 0]
        inner = normal - self.preload
        sideways = self.sideways(np.reshape(force, f.shape))
        outside = np.maximum(sideways - self.friction * inner, -inner)
        if f.shape[1] == 4:
            outside = np.maximum(outside, np.where(self.spin > 0.0, 0.0, np.abs(f[:, 3])))
        outside = np.where(self.touching, outside, np.abs(f).max(axis=1))
        return _relative(max(outside.max(), 0.0), np.abs(normal).max())

    def excess(self, force: Array) -> float:
        """Return the largest excess of a force (N k,) over a limit, relative to that limit, or 0."""
        return float((self.over(force) / self.size).max(initial=0.0))

    def witness(self, multipliers: Array) -> float:
        """Return the margin by which multipliers (v, p) prove that no force exists.

        It is at most 1, and <= 0 without proof. Where G^T v + B^T p is in the dual cone of every contact, a force would give 0 <= f . (G^T v
        + B^T p) <= p . b - v . w. The result is v . w - p . b over |v| |w| + p . |b|, with moments
        in the units of this module, so it does not depend on the scale of (v, p). If a contact is
        outside its dual cone, `ROUNDING` included, its normal force could gain that distance. It is
        subtracted, times the largest normal force: that contact's limit, or `REACH` times the
        wrench (or the largest least normal force or preload, if that is larger) for all contacts
        without a limit together. So the proof is complete if every contact has a limit or lies
        inside its dual cone, and else holds up to that total of normal forces. Preloads s add s .
        (G^T v + B^T p) to the result, because f - s n is in the cones.
        """
        if not np.isfinite(multipliers).all():
            return -np.inf
        twist = self.twist(multipliers[:6])
        p = np.maximum(multipliers[6:], 0.0)
        length = float(np.linalg.norm(twist))
        load = float(np.linalg.norm(self.load))
        sizes = (1.0 + self.friction + self.spin / self.length) * (
            length + np.einsum("lnk,l->n", np.abs(self.rows), p)
        )
        along, across = self.pull(-twist, p)
        gained = np.maximum(along + across + ROUNDING * sizes, 0.0) * self.touching
        least = self.problem.min_normal
        most = self.problem.max_normal
        most = np.full(len(gained), np.inf) if most is None else most
        limited = np.isfinite(most)
        largest = max(load, self.preload.max(), 0.0 if least is None else least.max())
        unlimited = REACH * largest * gained[~limited].max(initial=0.0)
        repair = gained[limited] @ most[limited] + unlimited
        size = length * load + p @ np.abs(self.bound) + sizes @ self.preload
        if not size > 0.0:
            return 0.0
        work = twist @ self.load - p @ self.bound - along @ self.preload
        return float((work - repair) / size) - ROUNDING

    def _in_newtons(self, force: Array) -> Array:
        """Return the force (N, k) with torsion divided by the length."""
        f = np.array(force, dtype=float).reshape(len(self.friction), -1)
        f[:, 3:] /= self.length
        return f


def _relative(value: float, size: float) -> float:
    """Return value / size; 0 / 0 is 0."""
    return float(value / size) if size > 0.0 else (0.0 if value == 0.0 else np.inf)
