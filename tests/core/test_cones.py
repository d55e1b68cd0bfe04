"""What solvers ask of a force on all contacts at once, and the linear system of Newton, whatever the registers."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from oracles import boundary, newton
from oracles import phi as oracle
from problems import OUTSIDE
from samples import EACH, Sample, depths, sample, wrenches

from grasp_env.force.record import FORCE

KINDS = ("hard", "frictionless")
EPS = 2.0**-52
SOME = (3, 4, 5, 8, 9, 16)
each = pytest.mark.parametrize(("lanes", "count"), [*product(EACH, SOME)])
each_kind = pytest.mark.parametrize("kind", KINDS)


def inside(s: Sample, seed: int, shallow: float = 0.3) -> np.ndarray:
    """(3N,) strictly inside; what is not transmitted is zero."""
    return depths(np.random.default_rng([s.count, seed]), s.count, shallow) * (s.scale > 0.0).reshape(-1)


@each_kind
@each
def test_sums_over_contacts(lanes: int, kind: str, count: int) -> None:
    s = sample(count, kind)
    cones = EACH[lanes](s.placement)
    rng = np.random.default_rng(count)
    for seed in range(5):
        x, w = inside(s, seed), rng.standard_normal(6)
        step = rng.standard_normal(3 * count) * (s.scale > 0.0).reshape(-1)
        value = oracle.phi(x, s.weights)
        assert cones.phi(x) == pytest.approx(value, rel=1e-13)
        size = np.abs(s.rows).max() * np.abs(x).max() * count
        np.testing.assert_allclose(cones.wrench(x), s.rows @ x, rtol=0, atol=1e-14 * size)
        slack = x[0::3] - np.hypot(x[1::3], x[2::3])
        assert cones.margin(x) == pytest.approx(slack.min(), abs=4 * EPS * x.max())
        longest = boundary.longest_step(x, step)
        assert cones.reach(x, step) == pytest.approx(1.0 / longest, rel=1e-10, abs=1e-12)
        assert cones.reach(x, x) <= 1e-12
        alpha = 0.5 * min(1.0, longest)
        value, slope = cones.along(x, step, alpha)
        end = x + alpha * step
        assert value == pytest.approx(oracle.phi(end, s.weights), rel=1e-12)
        gradient = oracle.gradient(end, s.weights)
        near = 1e-11 * np.abs(gradient).max() * np.abs(step).max()
        assert slope == pytest.approx(gradient @ step, rel=1e-9, abs=near)
        assert cones.along(x, step, 1.001 * longest)[0] == np.inf
        balanced = cones.balance(x, w)
        np.testing.assert_allclose(balanced, x - s.inverse @ (s.rows @ x + w), rtol=0, atol=1e-12 * size)
        row = cones.certified(x, w)
        residual = np.abs(s.rows @ x + w).max()
        assert (row[5], row[6]) == (pytest.approx(residual, rel=1e-12), pytest.approx(slack.min(), rel=1e-12))
        np.testing.assert_allclose(row[FORCE : FORCE + 3 * count], x / s.divisor.reshape(-1), rtol=2 * EPS)


@each
def test_phi_is_infinite_where_any_contact_is_not_inside(lanes: int, count: int) -> None:
    s = sample(count)
    cones, x = EACH[lanes](s.placement), inside(s, 0)
    for k in range(count):
        for outside in (*OUTSIDE, [1.0, np.nan, 0.0], [1.0, 0.0, np.nan]):
            wrong = x.copy()
            wrong[3 * k : 3 * k + 3] = outside
            assert cones.phi(wrong) == np.inf
    assert cones.phi(1e-170 * x) == np.inf  # squares vanish: refused, not divided by


@each
def test_no_multipliers_beat_the_optimum(lanes: int, count: int) -> None:
    s = sample(count)
    cones, rng = EACH[lanes](s.placement), np.random.default_rng(count)
    finite = 0
    for wrench in wrenches(rng, 3):
        w = s.unit @ wrench
        best, nu = s.minimum(wrench)
        least = oracle.phi(best, s.weights)
        assert cones.lower_bound(nu, w) == pytest.approx(least, rel=1e-11)
        assert cones.lower_bound_near(nu, w, best, 1e-3) == pytest.approx(least, rel=1e-11)
        for size in (1e-9, 1e-6, 1e-3, 0.03, 0.3):
            for x in (best, best * rng.uniform(0.9, 1.1), inside(s, 1)):
                other = nu + size * np.abs(nu).max() * rng.standard_normal(6)
                true = oracle.lower_bound(other, s.rows, w, s.weights)
                full, near = cones.lower_bound(other, w), cones.lower_bound_near(other, w, x, 1e-3)
                # sums of terms of the size of Phi and of nu . w
                rounding = 1e-12 * (least + np.abs(other) @ np.abs(w))
                assert full == pytest.approx(true, abs=rounding)
                if true == -np.inf:
                    assert near == -np.inf
                    continue
                assert near <= true + rounding + 0.25e-12 * abs(true)
                assert max(full, near) <= least * (1.0 + 1e-12)
                assert near == -np.inf or near == pytest.approx(true, rel=1e-9, abs=rounding)
                finite += np.isfinite(near)
    assert finite > 5
    for k in range(6):
        bad = np.where(np.arange(6) == k, np.nan, nu)
        assert cones.lower_bound(bad, w) == cones.lower_bound(nu, bad) == -np.inf
        assert cones.lower_bound_near(bad, w, best, 1e-2) == -np.inf


@each_kind
@each
def test_the_system_is_the_dense_one(lanes: int, kind: str, count: int) -> None:
    s = sample(count, kind)
    cones, rng = EACH[lanes](s.placement), np.random.default_rng(count)
    for shallow in (0.5, 1e-2, 1e-4):
        x, w, missed = inside(s, 3, shallow), *rng.standard_normal((2, 6))
        inverse, gradient = np.zeros((3 * count, 3 * count)), oracle.gradient(x, s.weights)
        for k, (p, (omega, lam)) in enumerate(zip(x.reshape(-1, 3), s.weights, strict=True)):
            inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = oracle.inverse_hessian(p.astype(np.longdouble), omega, lam)
        spread = inverse @ s.rows.T
        schur = s.rows @ spread
        good, pull, made, nu, step, moved = cones.system(x, w)
        assert good
        # close to the surface the gradient is large and H^-1 small across it: the terms that cancel, to their roundings
        part = 20.0 * EPS / shallow
        terms = np.abs(s.rows) @ (np.abs(inverse) @ np.abs(gradient))
        assert (np.abs(pull - spread.T @ gradient) <= part * terms).all()
        np.testing.assert_allclose(made, s.rows @ x, rtol=0, atol=1e-14 * count * np.abs(x).max())
        wanted = np.linalg.solve(schur, spread.T @ gradient - s.rows @ x - w)
        lost = np.abs(np.linalg.inv(schur)) @ (part * (terms + np.abs(schur) @ np.abs(wanted)))
        assert (np.abs(nu - wanted) <= lost).all()
        slack = np.abs(inverse) @ (np.abs(s.rows.T) @ lost + part * (np.abs(s.rows.T) @ np.abs(nu) + np.abs(gradient)))
        slack += EPS * np.abs(wanted).max()  # entries of G that are rounding themselves, along the axes
        assert (np.abs(step - inverse @ (s.rows.T @ wanted - gradient)) <= slack).all()
        np.testing.assert_allclose(moved, s.rows @ step, rtol=0, atol=1e-13 * count * np.abs(step).max())
        if shallow == 0.5:  # where the dense KKT system has digits left
            dense, multipliers, _ = newton.newton_step(x, s.rows, w, s.weights)
            np.testing.assert_allclose(nu, multipliers, rtol=0, atol=1e-8 * np.abs(multipliers).max())
            np.testing.assert_allclose(step, dense, rtol=0, atol=1e-8 * np.abs(dense).max())
        assert not cones.system(np.where(np.arange(3 * count) == count, np.nan, x), w)[0]
        corrected, after = cones.restore(x, missed, x)
        change = spread @ np.linalg.solve(schur, missed)
        near = 100.0 * EPS * np.linalg.cond(schur) * np.abs(change).max()
        np.testing.assert_allclose(corrected, x - change, rtol=0, atol=near)
        np.testing.assert_allclose(after, s.rows @ corrected, rtol=0, atol=1e-13 * count * np.abs(corrected).max())


@each
def test_squeeze_is_the_best_multiple(lanes: int, count: int) -> None:
    s = sample(count)
    cones = EACH[lanes](s.placement)
    for seed, size in enumerate((1e-3, 1.0, 1e3, 1e9)):
        x = size * inside(s, seed)
        best = cones.squeezed(x)
        values = [oracle.phi(k * best * x, s.weights) for k in (0.999, 1.0, 1.001)]
        assert min(values) == values[1]
        # the barrier is the small difference of Phi and the force where that is large
        assert cones.squeezed(best * x) == pytest.approx(1.0, rel=min(1e-6, 1e-13 * max(1.0, size) ** 2))


@each
def test_the_interval_of_all_contacts(lanes: int, count: int) -> None:
    s = sample(count)
    cones, rng = EACH[lanes](s.placement), np.random.default_rng(count)
    for seed in range(40):
        ray = inside(s, seed)
        point = rng.standard_normal(3 * count) * 10.0 ** rng.uniform(-2, 2)
        if seed % 2:
            ray = ray + rng.standard_normal(3 * count) * 0.3
            point = 4.0 * inside(s, seed + 100)
        low, high = cones.inside(point, ray)
        wanted = boundary.ray_interval(point, ray)
        assert (low < high) == (wanted[0] < wanted[1])
        if low < high:
            assert (low, high) == (pytest.approx(wanted[0], rel=1e-6, abs=1e-9), pytest.approx(wanted[1], rel=1e-6))
