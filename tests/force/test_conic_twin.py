"""The compiled conic solver, one to four iterations deep, against its dense twin `oracles.conic`."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from oracles import conic
from oracles.interior_point import per_boundary, scaling
from problems import GRASPS, PAPER_WRENCH, random_grasp

from grasp_env import core
from grasp_env.force import Objective, record
from grasp_env.force.basis import core_contacts
from grasp_env.force.record import LIMIT
from grasp_env.grasp import Grasp
from grasp_env.quality import feasibility

LOAD = np.array([0.7, -0.4, 0.9, 0.011, -0.007, 0.013])
CUBOID = GRASPS["cuboid, 4"]


# the twins themselves


def inside(rng: np.random.Generator, size: int) -> np.ndarray:
    x = rng.standard_normal(size)
    x[0] = np.linalg.norm(x[1:]) + rng.uniform(0.01, 1.0)
    return x


@pytest.mark.parametrize("size", [1, 3])
def test_the_scaling_takes_s_to_x_and_the_boundary_is_where_steps_end(size: int) -> None:
    rng = np.random.default_rng(size)
    bounded = 0
    for _ in range(50):
        x, s, d = inside(rng, size), inside(rng, size), rng.standard_normal(size)
        w = scaling(x, s)
        np.testing.assert_allclose(w @ w @ s, x, rtol=1e-10, atol=1e-10)
        j = np.array([1.0, -1.0, -1.0])[:size]
        form = w @ (j[:, None] * w)
        np.testing.assert_allclose(form, form[0, 0] * np.diag(j), atol=1e-10 * form[0, 0])
        inverse = per_boundary(x, d)
        if inverse > 0.0:
            end = x + d / inverse
            assert abs(end[0] - np.linalg.norm(end[1:])) < 1e-9 * (1.0 + np.abs(end).max())
            assert end[0] > -1e-9
            bounded += 1
        else:
            far = x + 1e6 * d
            assert far[0] >= np.linalg.norm(far[1:]) - 1e-6
    assert 10 < bounded < 50


# core.Conic: hard contacts


@cache
def closed_grasp(count: int, kind: str) -> tuple[Grasp, np.ndarray]:
    """A random grasp with force closure and an internal force strictly inside, cone coordinates."""
    rng = np.random.default_rng(100 + count)
    while True:
        grasp = random_grasp(rng, count)
        if kind == "elliptic":
            both = np.column_stack([grasp.friction, rng.uniform(0.3, 1.0, count)])
            grasp = Grasp.from_contacts(grasp.positions, grasp.normals, both)
        elif kind == "last one frictionless":
            models = ["hard"] * (count - 1) + ["frictionless"]
            grasp = Grasp.from_contacts(grasp.positions, grasp.normals, grasp.friction, contact_model=models)
        found = feasibility(grasp, np.zeros(6))
        if found.force is not None and found.margin > 0.02:
            return grasp, grasp.to_cone(found.force)


def inverse_of(grasp: Grasp) -> np.ndarray:
    """(3N, 6) of the unit frame: the least change of the force, not of the cone coordinates; G^+ of the columns in newtons."""
    scale = grasp.models.cone_scale.reshape(-1)
    return scale[:, None] * np.linalg.pinv(grasp.unit_frame @ grasp.cone_matrix * scale)


@pytest.mark.parametrize(
    ("count", "kind"),
    [*((count, kind) for count in (3, 4, 5, 8, 9) for kind in ("round", "elliptic")), (8, "last one frictionless")],
)
def test_conic_takes_the_twins_steps(count: int, kind: str) -> None:
    grasp, rest = closed_grasp(count, kind)
    contacts = core_contacts(grasp, Objective())
    divisor = grasp.models.cone_divisor
    for load in (LOAD, 20.0 * PAPER_WRENCH):
        loaded = grasp.unit_frame @ load
        size = float(np.abs(loaded).max())
        program = conic.of_grasp(grasp.unit_frame @ grasp.cone_matrix, loaded / size, divisor)
        at = conic.start(program, inverse_of(grasp), rest)
        first = size * at.x[: 3 * count].reshape(count, 3) / divisor
        seen = [first]
        for k in range(1, 5):
            at = conic.iteration(program, at)
            row = np.zeros(record.record_size(count))
            assert core.Conic.make(contacts, 1e-15, k, rest).solve(load, None, row) == LIMIT
            assert (row[record.CODE], row[record.ITERATIONS]) == (LIMIT, k)
            x = at.x[: 3 * count].reshape(count, 3)
            force, start = row[record.FORCE : record.FORCE + 6 * count].reshape(2, count, 3)
            near = 1e-9 * np.abs(force).max()
            np.testing.assert_allclose(start, first, rtol=0, atol=1e-11 * np.abs(first).max())
            np.testing.assert_allclose(force, size * x / divisor, rtol=0, atol=near)
            # y of the record is scaled onto the boundary of its set, and has the other sign
            pull = -(program.matrix.T @ at.y).reshape(-1, 3)
            theta = 1.0 / ((pull[:, 0] + np.hypot(pull[:, 1], pull[:, 2])) / program.cost[0::3]).max()
            nu = -theta * grasp.unit_frame.T @ at.y
            multipliers = row[record.MULTIPLIERS : record.MULTIPLIERS + 6]
            np.testing.assert_allclose(multipliers, nu, rtol=0, atol=1e-9 * np.abs(nu).max())
            assert row[record.BOUND] == pytest.approx(max(-nu @ load, 0.0), rel=1e-8, abs=near)
            assert conic.certified_bound(program, at.y)[0] * size == pytest.approx(max(-nu @ load, 0.0), rel=1e-9)
            seen.append(force)
        # every iteration moved: equal iterates would prove nothing
        assert all(np.abs(b - a).max() > 1e-6 * np.abs(b).max() for a, b in pairwise(seen))
