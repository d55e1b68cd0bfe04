"""Control loops allocate nothing: a hundred thousand calls each, a million where it is slow."""

from __future__ import annotations

import _core_test as insides
import numpy as np
import pytest
from samples import Sample, sample, wrenches
from test_learned import learned
from test_pipeline import path, pipeline

from grasp_env.force.record import FORCE
from grasp_env.force.step_size import AdaptiveStep

COUNTED = pytest.mark.skipif(not insides.counts_allocations, reason="the sanitizers have an operator new of their own")
CALLS = [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)]
LAYOUTS = {4: (4, 1), 16: (8, 0)}
many = pytest.mark.parametrize("calls", CALLS)
counts = pytest.mark.parametrize("count", LAYOUTS)


@COUNTED
def test_allocations_are_seen() -> None:
    assert insides.known_allocations(0) == 0
    assert insides.known_allocations(5) == 10


@COUNTED
@many
@counts
@pytest.mark.parametrize("form", ["newton", "full", "paper", "reduced"])
def test_descents(count: int, calls: int, form: str) -> None:
    """From the basis, carried over, and from a given force."""
    s = sample(count)
    made = insides.AnyNewton.make(*LAYOUTS[count], s.placement, 1e-4, 50)
    if form != "newton":
        if form == "full" and count > 8:
            pytest.skip("the full flow is dense")
        calls //= 1000 if form == "full" else 50
        number = ("full", "paper", "reduced").index(form)
        made = insides.AnyNewton.flow(*LAYOUTS[count], s.placement, 1e-3, 100, number, AdaptiveStep().parameters())
    made.set_basis(s.basis)
    loads = wrenches(np.random.default_rng(count), 12, 3.0)
    forces = np.array([made.solve(load)[FORCE : FORCE + 3 * count] for load in loads])
    assert made.allocations(loads, forces, calls) == 0


@COUNTED
@many
@counts
def test_learned_starts(count: int, calls: int) -> None:
    s = sample(count)
    made = learned(s, LAYOUTS[count], 1, 0.1, 1e-4)
    loads = wrenches(np.random.default_rng(count), 12, 3.0)
    forces = np.array([made.solve(load)[FORCE : FORCE + 3 * count] for load in loads])
    assert made.allocations(loads, forces, calls // 5) == 0


@COUNTED
@many
@counts
def test_conic(count: int, calls: int) -> None:
    s = sample(count)
    made = insides.AnyConic.make(*LAYOUTS[count], s.placement, 1e-6, 60, s.rest)
    assert made.allocations(wrenches(np.random.default_rng(count), 12), calls) == 0


@COUNTED
@many
@counts
def test_moving_contacts(count: int, calls: int) -> None:
    """Solves, adjusted every third time, and forces carried on in between; far enough that the basis is renewed, there and back."""
    s, away = sample(count), sample(count, "frictionless")
    made, walk = pipeline(s, LAYOUTS[count], tolerance=1e-4), path(s, 6, 3e-3)
    for part in np.linspace(0.0, 1.0, 40):
        normals = (1.0 - part) * s.normals + part * away.normals
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        positions = (1.0 - part) * s.positions + part * away.positions
        walk.append((Sample(positions, normals, s.scale, s.weights), walk[0][1]))
        if made.solve(positions, normals, walk[0][1])[0] != 0.0 or np.abs(made.basis - s.basis).max() > 0.0:
            break
    assert np.abs(made.basis - s.basis).max() > 0.0
    walk += walk[:5:-1]
    points, normals = (np.array([getattr(there, name) for there, _ in walk]) for name in ("positions", "normals"))
    adjust = np.random.default_rng(1).standard_normal((len(walk), 3 * count - 6))
    made.reset()
    # the first time round it takes the room that adjusted starts work in: see the next test
    made.allocations(points, normals, np.array([w for _, w in walk]), adjust, len(walk))
    assert made.allocations(points, normals, np.array([w for _, w in walk]), adjust, calls // 5) == 0
    assert np.abs(made.basis - s.basis).max() > 0.0
    # and what was left is a solver
    assert made.solve(points[0], normals[0], walk[0][1])[0] == 0.0


@COUNTED
@many
@counts
def test_moving_contacts_by_the_flow(count: int, calls: int) -> None:
    s = sample(count)
    made, walk = pipeline(s, LAYOUTS[count], tolerance=1e-3, limit=100, flows=True), path(s, 20, 3e-3)
    points, normals = (np.array([getattr(there, name) for there, _ in walk]) for name in ("positions", "normals"))
    loads, adjust = np.array([w for _, w in walk]), np.zeros((len(walk), 3 * count - 6))
    made.allocations(points, normals, loads, adjust, len(walk))  # the room that adjusted starts work in
    assert made.allocations(points, normals, loads, adjust, calls // 20) == 0
    assert np.isfinite(made.last).all()


@COUNTED
def test_the_first_call() -> None:
    s = sample(4)
    made, (there, w) = pipeline(s, (4, 1)), path(s, 1, 3e-3)[0]
    points, normals = there.positions.reshape(1, -1), there.normals.reshape(1, -1)
    assert made.allocations(points, normals, w[None], np.full((1, 6), 0.1), 3) == 0
