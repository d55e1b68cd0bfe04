"""Formulas of one contact for a number and for registers of 2, 4 and 8: Phi and its derivatives,
the dual bound, the cone's boundary; of every kind of contact, in three and in four dimensions."""

from __future__ import annotations

from typing import NamedTuple

import _core_test as insides
import numpy as np
import pytest
from oracles import boundary
from oracles import phi as oracle

EPS = 2.0**-52
LONG = np.longdouble


class Kind(NamedTuple):
    """A kind of contacts in vectors of `wide` numbers: `parts` says which tangential ones it has."""

    wide: int
    parts: tuple[int, ...]

    @property
    def axial(self) -> float:
        return len(self.parts) - 1.0


KINDS = {
    "hard": Kind(3, (1, 2)),
    "soft": Kind(4, (1, 2, 3)),
    "frictionless": Kind(4, ()),
    "frictionless with torsion": Kind(4, (3,)),
    "hard among soft": Kind(4, (1, 2)),
}
each_kind = pytest.mark.parametrize("name", KINDS)
each_width = pytest.mark.parametrize("lanes", [1, 2, 4, 8])


def directions(rng: np.random.Generator, kind: Kind, number: int) -> np.ndarray:
    """(number, wide) unit vectors of tangential parts, zero where there are none; along the axes
    and next to them too, where orthonormal frames are made in other ways."""
    out = np.zeros((number, kind.wide))
    for k, part in enumerate(kind.parts):
        out[:, part] = rng.standard_normal(number)
        for j, sign in enumerate((1.0, -1.0)):
            near = slice(20 + 6 * k + 3 * j, 23 + 6 * k + 3 * j)
            out[near, 1:] = np.array([0.0, 1e-9, 1e-3])[:, None] * out[near, 1:]
            out[near, part] = sign
    length = np.sqrt((out**2).sum(axis=1))
    return out / np.where(length > 0.0, length, 1.0)[:, None]


class Points(NamedTuple):
    """x (n, wide) from the axis to close to the surface, 1e-6 to 1e6 N; weights (n, 3) over
    decades; depth 1 - s/u (n,)."""

    x: np.ndarray
    weights: np.ndarray
    depth: np.ndarray


def points(kind: Kind, number: int = 203, shallowest: float = 1e-10) -> Points:
    rng = np.random.default_rng(number)
    u = 10.0 ** rng.uniform(-6.0, 6.0, number)
    s = u * (1.0 - shallowest ** rng.uniform(0.0, 1.0, number))
    s[:20] = 0.0
    x = s[:, None] * directions(rng, kind, number)
    x[:, 0] = u
    weights = np.stack(
        [
            10.0 ** rng.uniform(-1.0, 1.0, number),
            10.0 ** rng.uniform(-8.0, 1.0, number),
            np.full(number, kind.axial),
        ],
        axis=1,
    )
    return Points(x, weights, 1.0 - tangential(x) / u)


def tangential(x: np.ndarray) -> np.ndarray:
    """(n,) lengths of the tangential parts."""
    return np.hypot.reduce(x[:, 1:], axis=1)


# The core computes u^2 - s^2 as it stands: a rounding of u^2, so 1 / depth roundings of the
# difference, and its square twice that.
POINTS = {name: points(kind) for name, kind in KINDS.items()}


def each(p: Points) -> zip[tuple[np.ndarray, np.ndarray]]:
    """x in long double and weights (1, 3) of every point."""
    return zip(p.x.astype(LONG), p.weights[:, None], strict=True)


@each_kind
@each_width
def test_phi_and_its_gradient(lanes, name):
    p = POINTS[name]
    found = insides.phi(lanes, p.x, p.weights)
    slope = insides.gradient(lanes, p.x, p.weights)
    expected = np.array([oracle.phi(x, w) for x, w in each(p)])
    assert (np.abs(found[:, 0] / expected - 1.0) <= EPS * (4.0 + 2.0 / p.depth)).all()
    gradient = np.array([oracle.gradient(x, w) for x, w in each(p)])
    # 3 omega and the barrier cancel in the first component: rounding of either
    size = 3.0 * p.weights[:, :1] + np.abs(gradient)
    assert (np.abs(slope - gradient) <= EPS * (8.0 + 4.0 / p.depth[:, None]) * size).all()


@each_kind
@each_width
def test_curvature_and_inverse_hessian(lanes, name):
    p = POINTS[name]
    wide = p.x.shape[1]
    moves = np.random.default_rng(1).standard_normal(p.x.shape) * p.x[:, :1]
    found = insides.along(lanes, p.x, moves, p.weights)
    inverse = insides.inverse_hessian(lanes, p.x, p.weights).reshape(-1, wide, wide)
    for (x, w), move, depth, (value, bend) in zip(each(p), moves, p.depth, found, strict=True):
        assert abs(value / oracle.phi(x, w) - 1.0) <= EPS * (8.0 + 4.0 / depth)
        hessian = oracle.hessian(x, w)
        # three powers of the difference: rounding of the largest
        size = np.abs(hessian).max() * np.abs(move).max() ** 2
        assert abs(bend - move @ hessian @ move) <= EPS * (32.0 + 16.0 / depth) * size
    for (x, w), depth, block in zip(each(p), p.depth, inverse, strict=True):
        expected = oracle.inverse_hessian(x, *w[0])
        assert np.abs(block - expected).max() <= 8.0 * EPS * np.abs(expected).max()
        if depth > 0.01:  # it is the inverse of the dense Hessian
            hessian = oracle.hessian(x, w)
            scale = np.sqrt(np.diag(hessian))
            unit = hessian / np.outer(scale, scale) @ (block * np.outer(scale, scale))
            np.testing.assert_allclose(unit, np.eye(wide), atol=1e-14 / depth**3)


@each_width
def test_contacts_without_friction_among_hard_ones(lanes):
    """Three numbers have the barrier of two tangential parts: a third of lambda is that of none,
    1/u, where there is no tangential force."""
    p = POINTS["frictionless"]
    x = np.ascontiguousarray(p.x[:, :3])
    moves = np.array([[1.0, 0.0, 0.0]]) * x[:, :1]
    phi, along = insides.phi(lanes, x, p.weights), insides.along(lanes, x, moves, p.weights)
    slope, inverse = (f(lanes, x, p.weights) for f in (insides.gradient, insides.inverse_hessian))
    for k, (full, w) in enumerate(each(p)):
        omega, lam, u = w[0, 0], w[0, 1], full[0]
        value = 3.0 * omega * u + lam / u
        for found in (phi[k, 0], along[k, 0]):
            assert abs(found / value - 1.0) <= 8.0 * EPS
        assert abs(slope[k, 0] - (3.0 * omega - lam / u**2)) <= 8.0 * EPS * (
            3.0 * omega + lam / u**2
        )
        assert abs(along[k, 1] / (2.0 * lam / u) - 1.0) <= 16.0 * EPS
        assert abs(inverse[k, 0] / (u**3 / (2.0 * lam)) - 1.0) <= 8.0 * EPS
        assert not slope[k, 1:].any()
        assert not inverse[k, 1:3].any()
    y = np.zeros((3, 3))
    y[:, 0] = -1.0, 0.0, 2.9
    value, room = insides.dual(lanes, y, np.tile([1.0, 0.01, -1.0], (3, 1))).T
    np.testing.assert_allclose(value, 2.0 * np.sqrt(0.01 * (3.0 - y[:, 0])), rtol=1e-14)
    np.testing.assert_allclose(room, 3.0 - y[:, 0], rtol=1e-14)


class Plane(NamedTuple):
    """One contact in p = u - s and q = u + s, in long double, where neither takes digits of the
    other: squeezing is 1.5 omega (p + q), the barrier lambda (2 axial/(p + q) + 1/p + 1/q).

    Its two axes are (p, q) vectors of length one in the metric of the Hessian, that along p and the
    one conjugate to it; `pulls` are their gradients of squeezing and of the barrier.
    """

    along: np.ndarray
    inward: np.ndarray
    pulls: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray, omega: float, lam: float, axial: float) -> Plane:
        s = np.hypot.reduce(x[1:])
        p, q = x[0] - s, x[0] + s
        both = 4.0 * axial / (p + q) ** 3
        pp, qq = lam * (2.0 / p**3 + both), lam * (2.0 / q**3 + both)
        tilt = lam * both / pp
        inward = np.array([1.0, 0.0]) / np.sqrt(pp)
        along = np.array([-tilt, 1.0]) / np.sqrt(qq - tilt * lam * both)
        squeeze = np.full(2, 1.5 * omega)
        barrier = -lam * (2.0 * axial / (p + q) ** 2 + 1.0 / np.array([p, q]) ** 2)
        pulls = np.array([[axis @ pull for axis in (along, inward)] for pull in (squeeze, barrier)])
        return cls(along, inward, pulls)


def from_plane(axis: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(wide,) of a (p, q) vector at x."""
    s = np.hypot.reduce(x[1:])
    out = 0.5 * (axis[1] - axis[0]) * (x / s if s > 0.0 else 0.0 * x)
    out[0] = 0.5 * (axis[0] + axis[1])
    return out


@each_kind
@each_width
def test_axes_are_a_root_of_the_inverse_hessian(lanes, name):
    """Sum a a^T is the inverse Hessian to its last digits, and each axis has the digits of u - s:
    at the depth d the largest and the least differ by d^1.5."""
    p = POINTS[name]
    wide = p.x.shape[1]
    found = insides.axes(lanes, p.x, p.weights)
    every = found[:, : wide * wide].reshape(-1, wide, wide).astype(LONG)
    for (x, w), depth, axes in zip(each(p), p.depth, every, strict=True):
        inverse = oracle.inverse_hessian(x, *w[0])
        assert np.abs(axes.T @ axes - inverse).max() <= 8.0 * EPS * np.abs(inverse).max()
        plane = Plane.of(x, *w[0])
        near = EPS * (4.0 + 2.0 / depth)
        s = np.hypot.reduce(x[1:])
        for axis, want in zip(axes, (plane.along, plane.inward), strict=False):
            if s == 0.0:  # any direction of the tangents will do
                axis = np.append(axis[0], np.hypot.reduce(axis[1:]) * np.sign(axis[1]))
                want = np.array([0.5 * (want[0] + want[1]), 0.5 * (want[1] - want[0])])
            else:
                want = from_plane(want, x)
            assert np.abs(axis - want).max() <= near * np.abs(want).max()
        # across: no normal part, as long as the inverse curvature says, and square to each other
        sides = axes[2:]
        assert (sides[:, 0] == 0.0).all()
        length = (x[0] - s) * (x[0] + s) / (2.0 * np.sqrt(w[0, 1] * x[0]))
        gram = sides @ sides.T / length**2
        assert np.abs(gram - np.eye(wide - 2)).max() <= 2.0 * near
        assert np.abs(sides @ x).max() <= 8.0 * EPS * length * s


@each_kind
@each_width
def test_gradients_along_the_axes(lanes, name):
    """The gradients of squeezing and of the barrier are computed separately, so neither loses
    digits to the other.

    The sum of the squares of their sums is the squared Newton decrement."""
    p = POINTS[name]
    found = insides.axes(lanes, p.x, p.weights)[:, -4:].reshape(-1, 2, 2)
    for k, (x, w) in enumerate(each(p)):
        plane = Plane.of(x, *w[0])
        near = EPS * (4.0 + 2.0 / p.depth[k])
        assert (np.abs(found[k] / plane.pulls - 1.0) <= near).all()
        if p.depth[k] > 1e-3:  # beyond, the dense ones lose more
            slope = oracle.gradient(x, w)
            decrement = float(slope @ oracle.inverse_hessian(x, *w[0]) @ slope)
            size = float((found[k] ** 2).sum())
            assert (found[k].sum(axis=0) ** 2).sum() == pytest.approx(decrement, abs=1e-10 * size)


# --- the dual bound: the least of the Lagrangian of one contact


class Pulls(NamedTuple):
    """y (n, wide) with (a - b)/(a + b) from 1 down to 1e-14, and weights (n, 3); the least of the
    Lagrangian and its ratio, by the oracle; and what rounding may leave of it.

    The core knows a - b to a rounding of its terms, which moves the value by sqrt(k) of its part of
    a + b.
    """

    y: np.ndarray
    weights: np.ndarray
    least: np.ndarray
    ratio: np.ndarray
    terms: np.ndarray
    rounding: np.ndarray
    clear: np.ndarray

    @property
    def finite(self) -> np.ndarray:
        return np.isfinite(self.least)


def pulls(kind: Kind, number: int = 1603) -> Pulls:
    rng = np.random.default_rng(number)
    omega = 10.0 ** rng.uniform(-1.0, 1.0, number)
    lam = 10.0 ** rng.uniform(-8.0, 1.0, number)
    k = 10.0 ** rng.uniform(-14.0, 0.0, number)
    high = 10.0 ** rng.uniform(-3.0, 3.0, number)
    k[:40] = 1.0
    if not kind.parts:
        k[:] = 1.0
    b = 0.5 * high * (1.0 - k)
    y = b[:, None] * directions(rng, kind, number)
    y[:, 0] = 3.0 * omega - 0.5 * high * (1.0 + k)
    y[-3:, 0] = 3.0 * omega[-3:] * [1.0, 1.0 + 1e-9, 2.0]  # no least: a <= b
    weights = np.stack([omega, lam, np.full(number, kind.axial)], axis=1)
    least, ratio = np.array(
        [oracle.least_of_lagrangian(each, *w) for each, w in zip(y, weights, strict=True)]
    ).T
    a = 3.0 * omega - y[:, 0]
    b = tangential(y)
    terms = 3.0 * omega + np.abs(y[:, 0]) + b
    some = np.maximum(a + b, 1e-300)
    rounding = 8.0 * EPS * np.maximum(1.0, terms / some)
    rounding /= np.sqrt(np.maximum((a - b) / some, 1e-16))
    return Pulls(y, weights, least, ratio, terms, rounding, np.abs(a - b) > 4.0 * EPS * terms)


PULLS = {name: pulls(kind) for name, kind in KINDS.items()}


@each_kind
@each_width
def test_dual_is_the_least_of_the_lagrangian(lanes, name):
    p = PULLS[name]
    value, room = insides.dual(lanes, p.y, p.weights).T
    assert ((room > 0.0) == p.finite)[p.clear].all()
    assert (~p.finite)[p.clear].sum() >= 1
    both = p.finite & p.clear
    assert both.sum() > 1000
    assert (np.abs(value / p.least - 1.0) <= p.rounding)[both].all()


def near_forces(rng: np.random.Generator, kind: Kind, p: Pulls, decades: float) -> np.ndarray:
    """x (n, wide) whose ratio (u - s)/(u + s) misses that of the optimum by up to so many decades,
    in any direction."""
    number = len(p.y)
    r = np.minimum(p.ratio * 10.0 ** rng.uniform(-decades, decades, number), 1.0)
    r[~p.finite] = 0.5
    u = 10.0 ** rng.uniform(-3.0, 3.0, number)
    x = (u * (1.0 - r) / (1.0 + r))[:, None] * directions(rng, kind, number)
    x[:, 0] = u
    return x


@pytest.mark.parametrize("tight", [1e-2, 1e-3, 3e-4])  # at tolerances 1e-4, 1e-8 and 1e-10
@each_kind
@each_width
def test_dual_near_claims_no_more_than_the_least(lanes, name, tight):
    kind, p = KINDS[name], PULLS[name]
    rng = np.random.default_rng(lanes)
    claimed = 0
    for decades in (0.0, 0.01, 0.05, 0.2, 1.0, 4.0):
        x = near_forces(rng, kind, p, decades)
        value, room = insides.dual_near(lanes, p.y, p.weights, x, tight).T
        good = (room > 0.0) & p.finite
        # a claim where the oracle has none is one of rounding: a - b is zero to its last digit
        assert not ((room > 4.0 * EPS * p.terms) & ~p.finite).any()
        excess = value[good] / p.least[good] - 1.0
        assert (excess <= p.rounding[good]).all()
        assert (excess >= -0.3 * tight**4 - 4.0 * p.rounding[good]).all()
        assert decades > 0.0 or good.sum() > 0.95 * p.finite.sum()
        claimed += good.sum()
    assert claimed > 2 * p.finite.sum()


@each_kind
def test_dual_near_is_a_bound_where_it_is_loosest(name):
    """The error of the value is largest if the last Newton change is just below `tight` r.

    It is of fourth order in that change: at most 0.14 tight^4 for soft contacts, and 0.19 for hard
    ones. The core must subtract more than that, for every ratio r of the optimum."""
    kind = KINDS[name]
    tight = 1e-2
    ratios = 10.0 ** np.linspace(-3.0, 0.0, 25)
    misses = np.concatenate([-np.geomspace(0.02, 0.9, 400), np.geomspace(0.02, 4.0, 400)])
    r, miss = (each.reshape(-1) for each in np.meshgrid(ratios, misses))
    if not kind.parts:
        r, miss = np.ones_like(r), np.zeros_like(miss)
    number = len(r)
    rng = np.random.default_rng(0)
    omega, lam, high = 1.0, 1e-2, 2.0
    m = 2.0 * kind.axial
    k = r**2 * ((1.0 + r) ** 2 + m) / ((1.0 + r) ** 2 + m * r**2)
    away = directions(rng, kind, number)
    y = 0.5 * high * (1.0 - k)[:, None] * away
    y[:, 0] = 3.0 * omega - 0.5 * high * (1.0 + k)
    start = np.clip(r * (1.0 + miss), 0.0, 1.0)
    x = ((1.0 - start) / (1.0 + start))[:, None] * away
    x[:, 0] = 1.0
    weights = np.tile([omega, lam, kind.axial], (number, 1))
    value, room = insides.dual_near(1, y, weights, x, tight).T
    least = np.array([oracle.least_of_lagrangian(each, omega, lam, kind.axial)[0] for each in y])
    good = room > 0.0
    assert good.sum() > 0.4 * number
    excess = value[good] / least[good] - 1.0
    assert excess.max() <= 1e-12  # rounding: 1e-16 of the pull, over the least ratio
    # it is tried: some claims lack nearly all of what is subtracted
    assert not kind.parts or excess.min() < -0.05 * tight**4


@each_kind
@each_width
def test_numbers_without_room_claim_nothing(lanes, name):
    kind = KINDS[name]
    part = np.eye(kind.wide)[kind.parts[-1] if kind.parts else 0]
    normal = np.eye(kind.wide)[0]
    y = np.array(
        [
            3.0 * normal,
            3.1 * normal,
            3.0 * part if kind.parts else 3.0 * normal,
            np.nan * normal,
            np.nan * part,
            0.5 * part - normal,
        ]
    )
    w = np.tile([1.0, 0.01, kind.axial], (6, 1))
    x = np.tile(normal + (0.2 * part if kind.parts else 0.0), (6, 1))
    for found in (insides.dual(lanes, y, w), insides.dual_near(lanes, y, w, x, 1e9)):
        assert ((found[:, 1] > 0.0) == [False] * 5 + [True]).all()
    for bad in (np.nan, np.inf, -1.0, 0.0):
        far = insides.dual_near(lanes, y, w, np.full((6, kind.wide), bad), 1e-2)
        assert not (far[:, 1] > 0.0).any()


# --- the longest step inside a cone


@pytest.mark.parametrize("shallow", [1.0, 1e-2, 1e-5])
@pytest.mark.parametrize("wide", [3, 4])
@each_width
def test_steps_end_on_the_surface(lanes, wide, shallow):
    rng = np.random.default_rng(lanes)
    number = 300
    x = rng.standard_normal((number, wide))
    x[:, 0] = tangential(x) * (1.0 + shallow * rng.uniform(0.1, 1.0, number))
    depth = 1.0 - tangential(x) / x[:, 0]
    move = rng.standard_normal((number, wide)) * x[:, :1]
    inward = rng.random(number) < 0.3
    move[inward, 0] = 1.5 * tangential(move[inward])
    away, along, per = insides.boundary(lanes, x, move).T
    # x . J x keeps 1 - EPS / depth of its digits, and 1 / step is of the order of move / (u depth)
    near = EPS * 40.0 * np.abs(move).max(axis=1) / x[:, 0] / depth**2
    for found, way in ((per, move), (away + along, -move)):
        longest = np.array([boundary.longest_step(p, d, wide) for p, d in zip(x, way, strict=True)])
        ends = longest < np.inf
        assert (np.abs(found[ends] - 1.0 / longest[ends]) <= near[ends]).all()
        assert (found[~ends] <= near[~ends]).all()
        assert ends.sum() > 60
        assert (~ends).sum() > 10
        # there it is on the surface, in all of its numbers
        edge = x[ends] + longest[ends, None] * way[ends]
        size = np.abs(x[ends]).max(axis=1) + longest[ends] * np.abs(way[ends]).max(axis=1)
        assert (np.abs(edge[:, 0] - tangential(edge)) <= 1e-12 * size / depth[ends]).all()
