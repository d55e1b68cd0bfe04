"""Optima in 60-digit arithmetic, for hard contacts without limits, by two algorithms: `primal` and `dual`.

The problem is defined by its doubles, without their rounding: n is the first column of a frame at unit length, o the second column at
unit length across n, t = n x o; moments are exact. Positions, friction and wrench are the doubles themselves.

Contact forces are in cone coordinates x = (u, o, t), u = friction * normal, in units in which wrench and lengths are about one, and
A x = b is balance. Both algorithms follow minimisers of `linear . x + barrier(x, t)` for t -> 0 on an affine space by damped Newton
steps (`_follow`):

    sum, primal   c . x - t sum log det x                       over A x = b, in the null space of A
    sum, dual     x0 . z - t sum log det z                      over z = c - A^T nu, in the six nu, with A x0 = b; x = -barrier'(z)
    phi, primal   3 sum u + t^2 sum (1 / u + 2 u / det x)       over A x = b
    phi, dual     x0 . z - sum least of phi - t sum log det z   over z = c - A^T nu; x = -(what is added to x0 . z)'

with det x = u^2 - o^2 - t^2; the least is that of z . x + lambda sum (1 / u + 2 u / det x), c . x being the 3 sum u of `phi`. The primal
`phi` ends at t = sqrt(lambda), the others where the gap 2 N t is `GAP` of the optimum. The primal algorithm starts from a phase one, the
dual one from nu = 0. Their results are bounds by `bounds.Measure`, for any accuracy.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Context, Decimal, localcontext
from typing import Any

import numpy as np

from benchmarks.force.bounds import Measure, Numbers, least
from benchmarks.force.problems import Array, Problem

CONTEXT = Context(prec=60, Emin=-(10**6), Emax=10**6)
GAP = Decimal("1e-18")
"""Relative gap between the bounds at which an algorithm ends; the primal `phi` leaves none but Newton's."""
NEWTON = Decimal("1e-26")
"""A Newton decrement, in units of t, below which a step is the last."""
CLOSE = Decimal("0.1")
"""The same, for the next t."""
STEPS, HALVINGS = 2000, 200
"""Most Newton steps of an algorithm, which takes 20 to 200, and most halvings of one."""

Parts = tuple[Numbers, Numbers]
"""Gradient (N, 3) and Hessian (N, 3, 3) of a barrier."""
Barrier = Callable[[Numbers, Any], "Parts | None"]
"""A barrier as a function of x (N, 3) and t; None outside."""


Optimum = tuple[Any, Any, Numbers, Numbers]
"""Lower and upper bound of the optimum [N], force (3 N,) [N] in the frames of the problem, and multipliers (6,) about the origin, in Decimals."""


class _Scaled:
    """Problem in dimensionless units: A, b, prices c, and x0 with A x0 = b."""

    def __init__(self, problem: Problem, name: str) -> None:
        self.name, self.measure = name, measure(problem)
        m, self.kept = self.measure, np.flatnonzero(self.measure.touching)
        self.mu = m.friction[self.kept]
        self.count = len(self.kept)
        matrix = m.matrix[:, self.kept]
        matrix[:, :, 0] = matrix[:, :, 0] / self.mu
        self.matrix: Numbers = matrix.reshape(6, -1)
        self.unit = np.abs(m.load).max()
        if name == "phi":
            self.unit = max(self.unit, m.weight.sqrt())
        if not self.unit > 0:
            raise ValueError("no wrench: the optimum of `sum` is zero")
        self.root = m.weight.sqrt() / self.unit
        self.target = -m.load / self.unit
        self.costs = _decimals(np.zeros((self.count, 3)))
        self.costs[:, 0] = (m.price(name)[self.kept]) / self.mu
        self.square = self.matrix @ self.matrix.T
        self.start = (self.matrix.T @ _solved(self.square, self.target)).reshape(-1, 3)

    def optimum(self, x: Numbers, gradient: Numbers) -> Optimum:
        """Bounds from forces x (N, 3) and the gradient of the Lagrangian's smooth part there (N, 3), which is A^T nu up to errors."""
        nu = self.measure.about_origin(_solved(self.square, self.matrix @ gradient.reshape(-1)))
        force = _decimals(np.zeros((len(self.measure.friction), 3)))
        force[self.kept] = x * self.unit
        force[self.kept, 0] = force[self.kept, 0] / self.mu
        force = force.reshape(-1)
        return self.measure.lower(self.name, nu), self.measure.upper(self.name, force, nu), force, nu

    def share(self, value: Any) -> Any:
        """The t at which the gap 2 N t is `GAP` of an optimum."""
        return max(value, GAP) * GAP / (2 * self.count)


def measure(problem: Problem) -> Measure:
    """The problem in Decimals; soft contacts and limits are a `ValueError`."""
    if problem.width != 3 or len(problem.limit_bound):
        raise ValueError("exact optima are those of hard contacts without limits")
    with localcontext(CONTEXT):
        normal, along = (_decimals(problem.frames[:, :, k]) for k in (0, 1))
        normal = normal / _norm(normal)
        along = along - normal * (normal * along).sum(axis=1)[:, None]
        along = along / _norm(along)
        return Measure.of(problem, _decimals, np.stack([normal, along, np.cross(normal, along)], axis=2))


def primal(problem: Problem, name: str) -> Optimum:
    """The optimum by forces in the null space of A, or an `ArithmeticError` if no force strictly inside the cones was found."""
    with localcontext(CONTEXT):
        p = _Scaled(problem, name)
        basis = _null_space(p.matrix)
        barrier, last = (_phi, lambda _: p.root) if name == "phi" else (_log, lambda x: p.share((p.costs * x).sum()))
        x, gradient = _follow(barrier, p.costs, _phase_one(p, basis), basis, Decimal(1), last)
        return p.optimum(x, p.costs + gradient)


def dual(problem: Problem, name: str) -> Optimum:
    """The optimum by the six multipliers of balance."""
    with localcontext(CONTEXT):
        p = _Scaled(problem, name)
        largest = max(Decimal(1), np.abs(p.start).max())

        def smoothed(z: Numbers, t: Any) -> Parts | None:
            """`_conjugate` and the barrier of `sum`, without which Newton's steps go astray near the surface."""
            first, second = _log(z, t), _conjugate(z, p.root)
            return None if first is None or second is None else (first[0] + second[0], first[1] + second[1])

        barrier, least_value = (smoothed, p.root) if name == "phi" else (_log, 0)
        z, gradient = _follow(
            barrier, p.start, p.costs, p.matrix.T, largest,
            lambda z: p.share(abs((p.start * (p.costs - z)).sum()) + least_value),
        )  # fmt: skip
        return p.optimum(-gradient, p.costs - z)


def measured(problem: Problem, name: str, force: Numbers, multipliers: Numbers) -> tuple[Any, Any, Any]:
    """Lower bound, upper bound and objective by `bounds.Measure`, in Decimals, of a force (3 N,) and multipliers (6,) in Decimals or floats."""
    with localcontext(CONTEXT):
        m, f, nu = measure(problem), _decimals(force), _decimals(multipliers)
        return m.lower(name, nu), m.upper(name, f, nu), m.objective(name, f)


def split(values: Numbers) -> tuple[Array, Array]:
    """Decimals as two floats: the nearest ones, and what they leave."""
    with localcontext(CONTEXT):
        high = values.astype(float)
        return high, (values - _decimals(high)).astype(float)


def joined(high: Array, low: Array) -> Numbers:
    """The inverse of `split`."""
    with localcontext(CONTEXT):
        return _decimals(high) + _decimals(low)


def _decimals(values: Any) -> Numbers:
    """An object array of Decimals, exactly."""
    array = np.asarray(values)
    flat = [each if isinstance(each, Decimal) else Decimal(float(each)) for each in array.reshape(-1)]
    made = np.empty(len(flat), dtype=object)
    made[:] = flat
    return made.reshape(array.shape)


def _norm(vectors: Numbers) -> Numbers:
    """(N, 1) lengths of (N, 3)."""
    return np.sqrt((vectors**2).sum(axis=1))[:, None]


def _log(x: Numbers, t: Any) -> Parts | None:
    """-t sum log det x."""
    u, o, s = x.T
    det = u * u - o * o - s * s
    if not ((u > 0) & (det > 0)).all():
        return None
    flipped = x * np.array([1, -1, -1], dtype=object)  # J x, half the gradient of det
    half = flipped / det[:, None]
    hessian = 4 * half[:, :, None] * half[:, None] - 2 * np.diag([1, -1, -1]).astype(object) / det[:, None, None]
    return -2 * t * half, t * hessian


def _phi(x: Numbers, t: Any) -> Parts | None:
    """t^2 sum (1 / u + 2 u / det x)."""
    u, o, s = x.T
    side = o * o + s * s
    det = u * u - side
    if not ((u > 0) & (det > 0)).all():
        return None
    weight, d2, d3 = t * t, det**2, det**3
    gradient = np.stack([-1 / u**2 - 2 * (u * u + side) / d2, 4 * u * o / d2, 4 * u * s / d2], axis=1)
    hessian = 16 * (u / d3)[:, None, None] * x[:, :, None] * x[:, None]  # right but for the diagonal and what u is in
    for k in (1, 2):
        hessian[:, k, k] += 4 * u / d2
        hessian[:, 0, k] = hessian[:, k, 0] = -4 * x[:, k] * (3 * u * u + side) / d3
    hessian[:, 0, 0] = 2 / u**3 + 4 * u * (u * u + 3 * side) / d3
    return weight * gradient, weight * hessian


def _conjugate(z: Numbers, root: Any) -> Parts | None:
    """-sum of the least over a cone of z . x + root^2 (1 / u + 2 u / det x), as a function of z; its gradient is -x."""
    sideways = np.sqrt(z[:, 1] ** 2 + z[:, 2] ** 2)
    low, high = z[:, 0] - sideways, z[:, 0] + sideways
    if not (low > 0).all():
        return None
    _, p, r = least(low, high, root * root)
    turned = z[:, 1:] / np.where(sideways > 0, sideways, 1)[:, None]
    x = np.concatenate([(p * (1 + r) / 2)[:, None], (r - 1)[:, None] * p[:, None] * turned / 2], axis=1)
    parts = _phi(x, root)
    return None if parts is None else (-x, np.stack([_solved(each, _decimals(np.eye(3))) for each in parts[1]]))


def _follow(
    barrier: Barrier, linear: Numbers, x: Numbers, basis: Numbers, t: Any, last: Callable[[Numbers], Any],
    done: Callable[[Numbers], bool] = lambda _: False,
) -> tuple[Numbers, Numbers]:  # fmt: skip
    """Minimisers of `linear . x + barrier(x, t)` over x + basis y for decreasing t.

    Args:
        barrier: of x (N, K).
        linear, x: (N, K), x inside.
        basis: (N K, d).
        t: to begin with.
        last: the t to end with, from the minimiser before.
        done: stops at once.

    Returns:
        x and the barrier's gradient there.
    """
    size, near, tried = basis.shape[1], False, 0
    blocks, parts = basis.reshape(*x.shape, size), barrier(x, t)
    for _ in range(STEPS):
        if parts is None:
            raise ArithmeticError("the start is not inside")
        gradient, hessian = parts
        slope = basis.T @ (linear + gradient).reshape(-1)
        step = -_solved(basis.T @ np.matmul(hessian, blocks).reshape(-1, size), slope)
        fall, move = -(slope @ step), (basis @ step).reshape(x.shape)
        for _ in range(HALVINGS):
            parts = barrier(x + move, t)
            if parts is not None and ((linear + parts[0]) * move).sum() * 4 <= fall:
                break
            move, fall = move / 2, fall / 2
        else:
            raise ArithmeticError(f"no step goes down at t = {t:.1e}")
        x, tried, end = x + move, tried + 1, last(x)
        if done(x):
            break
        if fall <= (NEWTON if t <= end else CLOSE) * t:
            if t <= end:
                break
            t, near = max(t / 10, end), True
        elif not near and tried % 20 == 0:
            t = 10 * t  # far from the first minimiser
        else:
            continue
        parts = barrier(x, t)
    else:
        raise ArithmeticError(f"{STEPS} Newton steps have not been enough: t = {t:.1e}")
    assert parts is not None
    return x, parts[0]


def _phase_one(p: _Scaled, basis: Numbers) -> Numbers:
    """Forces (N, 3) strictly inside the cones with A x = b: the least s for which x + s e is inside, e = (1, 0, 0), until it is negative."""
    up = 0 * p.start
    up[:, 0] += 1
    lifted, e = p.start + (1 + 2 * np.abs(p.start).sum()) * up, up.reshape(-1)
    pull = p.matrix @ e
    square = pull @ pull
    if square < Decimal("1e-90"):  # e balances itself
        return lifted
    linear = (p.matrix.T @ pull / square).reshape(-1, 3)

    def level(x: Numbers) -> Any:
        return (linear * x).sum() - pull @ p.target / square

    wide = np.concatenate([basis, e[:, None]], axis=1)
    x, _ = _follow(_log, linear, lifted, wide, Decimal(1), lambda _: Decimal("1e-30"), lambda x: level(x) < 0)
    if not level(x) < 0:
        raise ArithmeticError("no force strictly inside the cones balances the wrench")
    return x - level(x) * up


def _null_space(matrix: Numbers) -> Numbers:
    """(K, K - 6) orthonormal: the rows of A, then the unit vectors farthest from what is spanned, one after the other."""
    spanned: list[Numbers] = []
    for row in matrix:
        spanned.append(_across(row, spanned))
    rows = np.stack(spanned)
    left = _decimals(np.eye(matrix.shape[1])) - rows.T @ rows
    while len(spanned) < matrix.shape[1]:
        spanned.append(_across(left[int(np.argmax((left**2).sum(axis=1)))], spanned))
        left = left - np.outer(spanned[-1], spanned[-1])
    return np.stack(spanned[len(matrix) :], axis=1)


def _across(vector: Numbers, spanned: list[Numbers]) -> Numbers:
    """The unit vector across orthonormal ones. It is made twice: once loses the digits by which the rest is shorter."""
    for _ in range(2):
        for each in spanned:
            vector = vector - (each @ vector) * each
        vector = vector / np.sqrt(vector @ vector)
    return vector


def _solved(matrix: Numbers, right: Numbers) -> Numbers:
    """The solution of a symmetric positive definite system, by elimination; `right` is (d,) or (d, e)."""
    size = len(matrix)
    rows = np.concatenate([matrix, right.reshape(size, -1)], axis=1)
    for k in range(size):
        if not rows[k, k] > 0:
            raise ArithmeticError("a matrix is singular to 60 digits")
        rows[k + 1 :, k:] = rows[k + 1 :, k:] - np.outer(rows[k + 1 :, k] / rows[k, k], rows[k, k:])
    found = rows[:, size:]
    for k in reversed(range(size)):
        found[k] = (found[k] - rows[k, k + 1 : size] @ found[k + 1 :]) / rows[k, k]
    return found.reshape(right.shape)
