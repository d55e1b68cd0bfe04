"""Contacts that move from call to call, in every layout: the optimum there, wherever the start came from."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from cases import CONVERGED, REFUSED
from oracles import geometry, newton, starts
from oracles.phi import phi
from samples import LAYOUTS, Sample, layouts, reference_of, sample, wrenches

from grasp_env.force.record import BOUND, CODE, FORCE, ITERATIONS, MARGIN, OBJECTIVE

CARRIED, REPAIRED, CLIPPED = range(3)


def pipeline(
    s: Sample, layout: tuple[int, int], remembers: bool = True, tolerance: float = 1e-8, limit: int = 500, flows: bool = False,
):  # fmt: skip
    given = s.placement, tolerance, limit, s.basis, s.frames, remembers, reference_of(s), flows
    return insides.AnyPipeline.make(*layout, *given)


def path(s: Sample, steps: int, size: float, seed: int = 0) -> list[tuple[Sample, np.ndarray]]:
    """Contacts and wrenches that wander: each (contacts there, wrench)."""
    rng = np.random.default_rng([s.count, seed])
    positions, normals, w, out = s.positions, s.normals, wrenches(rng, 1)[0], []
    for _ in range(steps):
        positions = positions + size * 0.05 * rng.standard_normal(positions.shape)
        normals = normals + size * rng.standard_normal(normals.shape)
        normals = normals / np.linalg.norm(normals, axis=1)[:, None]
        w = w + 10.0 * size * wrenches(rng, 1)[0]
        out.append((Sample(positions, normals, s.scale, s.weights), w))
    return out


def force_of(s: Sample, row: np.ndarray, initial: bool = False) -> np.ndarray:
    """Cone coordinates of a record, or of its start."""
    return row[FORCE + 3 * s.count * initial :][: 3 * s.count] * s.scale.reshape(-1)


@pytest.mark.parametrize(("count", "flows"), [*((n, k) for n in (3, 4, 5, 9) for k in (False, True)), (8, False)])
@pytest.mark.parametrize("remembers", [True, False])
def test_every_layout_finds_the_optimum_along_a_path(count: int, remembers: bool, flows: bool) -> None:
    s, tolerance = sample(count), 1e-4 if flows else 1e-8
    options = {"tolerance": tolerance, "limit": 20_000, "flows": flows}
    every = [(pipeline(s, at, remembers, **options), pipeline(s, at, False, **options)) for at in layouts(count)]
    for there, w in path(s, 8 if flows else 12, 3e-3):
        rest = newton.tangent_correction(s.rest, there.rows, np.zeros(6), s.weights)
        best, _ = newton.minimum(rest, there.rows, there.unit @ w, s.weights)
        least = phi(best, s.weights)
        for made, cold in every:
            row, plain = (each.solve(there.positions, there.normals, w) for each in (made, cold))
            # where it begins: never worse than the combination, but for the rounding of forces
            safe = phi(force_of(there, plain, True), s.weights)
            assert phi(force_of(there, row, True), s.weights) <= safe * (1.0 + 1e-12) < np.inf
            x = force_of(there, row)
            assert row[CODE] == CONVERGED
            assert row[MARGIN] > 0.0
            assert row[BOUND] <= least * (1.0 + 1e-11)
            assert row[OBJECTIVE] - row[BOUND] <= tolerance * row[BOUND] * (1.0 + 1e-6)
            assert least * (1.0 - 1e-12) <= phi(x, s.weights) <= least * (1.0 + 1.1 * tolerance)
            missed = np.abs(there.rows @ x + there.unit @ w).max()
            assert missed <= 1e-13 * count * (np.abs(x).max() + np.abs(there.unit @ w).max())
            np.testing.assert_allclose(made.last, x, rtol=1e-15)


@pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
@pytest.mark.parametrize("flows", [False, True])
@pytest.mark.parametrize(("count", "layout"), [(4, (4, 1)), (16, (8, 0))])
def test_nothing_is_allocated(count: int, layout: tuple[int, int], flows: bool) -> None:
    """Solves, adjusted every third time, and forces carried on in between; far enough that the basis is renewed, there and back."""
    s, away = sample(count), sample(count, "frictionless")
    made, walk = pipeline(s, layout, tolerance=1e-3 if flows else 1e-4, limit=100, flows=flows), path(s, 6, 3e-3)
    for part in np.linspace(0.0, 1.0, 40) if not flows else ():
        normals = (1.0 - part) * s.normals + part * away.normals
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        positions = (1.0 - part) * s.positions + part * away.positions
        walk.append((Sample(positions, normals, s.scale, s.weights), walk[0][1]))
        if made.solve(positions, normals, walk[0][1])[CODE] != CONVERGED or np.abs(made.basis - s.basis).max() > 0.0:
            break
    assert flows or np.abs(made.basis - s.basis).max() > 0.0
    walk += walk[:5:-1]
    points, normals = (np.array([getattr(there, name) for there, _ in walk]) for name in ("positions", "normals"))
    loads, rng = np.array([w for _, w in walk]), np.random.default_rng(1)
    adjust = rng.standard_normal((len(walk), 3 * count - 6))
    made.reset()
    # from the first call on
    assert made.allocations(points, normals, loads, adjust, 2_000 if flows else 20_000) == 0
    assert np.isfinite(made.last).all()
    made.reset()
    assert made.solve(points[0], normals[0], loads[0])[CODE] == CONVERGED or flows


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_remembered_optimum_saves_steps_and_resets_are_to_the_bit(layout: tuple[int, int]) -> None:
    s = sample(4)
    warm, cold = pipeline(s, layout), pipeline(s, layout, remembers=False)
    walk = path(s, 15, 1e-3)

    def rows(made) -> np.ndarray:
        return np.array([made.solve(there.positions, there.normals, w) for there, w in walk])

    first, other = rows(warm), rows(cold)
    assert first[:, ITERATIONS].sum() < 0.7 * other[:, ITERATIONS].sum()
    warm.reset()
    np.testing.assert_array_equal(rows(warm), first)
    warm.forget()
    np.testing.assert_array_equal(warm.solve(walk[0][0].positions, walk[0][0].normals, walk[0][1]), first[0])
    np.testing.assert_array_equal(rows(cold), other)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_far_move_renews_the_basis(layout: tuple[int, int]) -> None:
    s, there = sample(4), sample(4, "frictionless")
    away = Sample(there.positions, there.normals, s.scale, s.weights)
    made, before = pipeline(s, layout), s.basis
    w = wrenches(np.random.default_rng(4), 1)[0]
    rng, renewed = np.random.default_rng(5), 0
    for part in np.linspace(0.0, 1.0, 40):
        positions = (1.0 - part) * s.positions + part * away.positions
        normals = (1.0 - part) * s.normals + part * away.normals + 0.01 * rng.standard_normal((4, 3))
        normals = normals / np.linalg.norm(normals, axis=1)[:, None]
        row = made.solve(positions, normals, w)
        if row[CODE] == REFUSED:
            break
        assert row[CODE] == CONVERGED
        now = Sample(positions, normals, s.scale, s.weights)
        if np.abs(made.basis - before).max() > 0.0:
            renewed += 1
            before = made.basis
            for k, load in enumerate([*np.eye(6), *-np.eye(6), np.zeros(6)]):
                missed = np.abs(now.rows @ before[k] + now.unit @ load).max()
                assert missed <= 1e-11 * (np.abs(before[k]).max() + np.abs(now.unit @ load).max())
                assert phi(before[k], s.weights) < np.inf
    assert renewed > 0
    made.reset()
    np.testing.assert_array_equal(made.basis, s.basis)


@pytest.mark.parametrize("count", [4, 5])
def test_adjusted_starts_are_the_internal_force_repaired(count: int) -> None:
    s = sample(count)
    there, w = path(s, 1, 3e-3)[0]
    frames = np.einsum("nba,nbk->nak", there.frames, reference_of(s).reshape(count, 3, -1)).reshape(3 * count, -1)
    internal = geometry.polar_basis(frames, there.unit @ geometry.grasp_matrix(there.positions, there.frames))
    rng = np.random.default_rng(count)
    for size in (1e-3, 0.1, 3.0):
        for layout in layouts(count):
            made, a = pipeline(s, layout, remembers=False), size * rng.standard_normal(3 * count - 6)
            plain = made.solve(there.positions, there.normals, w)
            row = made.solve(there.positions, there.normals, w, a)
            safe, start = force_of(s, plain, True), force_of(s, row, True)
            x = safe + (internal @ a) * s.scale.reshape(-1)
            best, least = starts.least_on_segment(safe, x, s.weights)
            value, before = phi(start, s.weights), phi(safe, s.weights)
            assert value <= before * (1.0 + 1e-12)
            assert value - least <= 1e-3 * (before - least) + 1e-12 * value
            assert row[OBJECTIVE] == pytest.approx(plain[OBJECTIVE], rel=2e-8)
            if best == 1.0:
                np.testing.assert_allclose(start, x, rtol=0, atol=1e-11 * np.abs(x).max())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_carried_forces_are_balanced_or_inside(layout: tuple[int, int]) -> None:
    s, seen = sample(4), set()
    for size in (1e-4, 3e-3, 0.03, 0.3):
        for seed in range(6):
            made, walk = pipeline(s, layout), path(s, 3, size, seed)
            there, w = walk[0]
            if made.solve(there.positions, there.normals, w)[CODE] != CONVERGED:
                continue
            last = made.last
            now, load = walk[2]
            how, force = made.carry(now.positions, now.normals, load)
            np.testing.assert_array_equal(made.last, last)
            x = (force.reshape(-1, 3) * s.scale).reshape(-1)
            seen.add(how)
            assert phi(x, s.weights) < np.inf
            if how != CLIPPED:
                missed = np.abs(now.rows @ x + now.unit @ load).max()
                assert missed <= 1e-9 * (np.abs(x).max() + np.abs(now.unit @ load).max())
            if how == CARRIED:
                turned = starts.turned(last, there.frames, now.frames, s.divisor, s.scale)
                wanted = newton.tangent_correction(turned, now.rows, now.unit @ load, s.weights)
                np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-7 * np.abs(wanted).max())
    assert {CARRIED, REPAIRED} <= seen


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_is_none_is_refused_and_leaves_nothing_behind(layout: tuple[int, int]) -> None:
    s = sample(4)
    made, walk = pipeline(s, layout), path(s, 2, 3e-3)
    (first, w), (there, load) = walk
    made.solve(first.positions, first.normals, w)
    wanted = made.solve(there.positions, there.normals, load)
    made.reset()
    made.solve(first.positions, first.normals, w)
    last = made.last
    for bad in (np.nan, np.inf, -np.inf, 1e13):
        given = [there.positions.copy(), there.normals.copy(), load.copy()]
        for k, a in enumerate(given):
            if k == 0 and bad == 1e13:
                continue  # far away is no mistake by itself
            a.reshape(-1)[0], kept = bad, a.reshape(-1)[0]
            assert made.solve(*given)[CODE] == REFUSED
            a.reshape(-1)[0] = kept
        assert made.solve(there.positions, there.normals, load, np.array([bad] + [0.1] * 5))[CODE] == REFUSED
    line = np.outer(np.arange(4.0), [0.01, 0.02, 0.03])
    assert made.solve(line, there.normals, load)[CODE] == REFUSED
    np.testing.assert_array_equal(made.last, last)
    np.testing.assert_array_equal(made.solve(there.positions, there.normals, load), wanted)


@pytest.mark.parametrize("which", ["wrench", "normals", "a line"])
def test_carry_of_what_is_none_is_no_force_of_nan(which: str) -> None:
    s = sample(4)
    made = pipeline(s, LAYOUTS[0])
    made.solve(s.positions, s.normals, np.ones(6))
    normals = s.normals * (np.nan if which == "normals" else 1.0)
    positions = np.outer(np.arange(4.0), [0.01, 0.02, 0.03]) if which == "a line" else s.positions
    how, force = made.carry(positions, normals, np.full(6, np.nan if which == "wrench" else 2.0))
    assert np.isfinite(force).all()
    assert how == CLIPPED  # old contacts under the new wrench would be an answer to another question
