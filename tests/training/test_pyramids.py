"""The linear program against enumeration of all vertices, and against the cones."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from problems import CONIC_LEAST, GRASPS, PAPER_WRENCH

from grasp_env.errors import NotConvergedError
from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.wrench import sample_ball
from training.pyramids import pyramid_forces


def by_enumeration(grasp: Grasp, wrench: np.ndarray, facets: int) -> float:
    """Least sum of normals over all bases of six edges: an optimum of a linear program is at one of them."""
    angles = 2.0 * np.pi * np.arange(facets) / facets
    columns = np.concatenate(
        [
            grasp.matrix[:, 3 * k : 3 * k + 3] @ np.stack([np.ones(facets), mu * np.cos(angles), mu * np.sin(angles)])
            for k, mu in enumerate(grasp.friction)
        ],
        axis=1,
    )
    columns[3:] /= 0.05
    right = -wrench / [1, 1, 1, 0.05, 0.05, 0.05]
    bases = np.array(list(combinations(range(columns.shape[1]), 6)))
    matrices = columns[:, bases].transpose(1, 0, 2)
    regular = np.abs(np.linalg.det(matrices)) > 1e-9
    weights = np.linalg.solve(matrices[regular], np.broadcast_to(right[:, None], (int(regular.sum()), 6, 1)))[..., 0]
    feasible = (weights >= -1e-9).all(axis=1)
    return float(weights[feasible].sum(axis=1).min(initial=np.inf))


@pytest.mark.parametrize(("name", "facets"), [("tripod", 8), ("tripod, uneven", 5), ("cuboid, 4", 4), ("cuboid, 4", 5)])
def test_no_vertex_is_better(name: str, facets: int) -> None:
    grasp = GRASPS[name]
    for wrench in sample_ball(np.random.default_rng(0), 3):
        force = pyramid_forces(grasp, wrench, facets)
        assert force[:, 0].sum() == pytest.approx(by_enumeration(grasp, wrench, facets), rel=1e-8)
        assert grasp.residual(force, wrench) < 1e-9
        assert grasp.cone_margin(force) > -1e-9


def test_pyramids_cost_more_than_cones() -> None:
    costs = [pyramid_forces(presets.paper_cuboid(), PAPER_WRENCH, n)[:, 0].sum() for n in (4, 8, 16, 32, 256)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == pytest.approx(CONIC_LEAST, rel=1e-4)
    rng = np.random.default_rng(4)
    excess = [
        pyramid_forces(grasp, wrench)[:, 0].sum() / pyramid_forces(grasp, wrench, 64)[:, 0].sum() - 1.0
        for name, grasp in GRASPS.items()
        if "uneven" not in name
        for wrench in sample_ball(rng, 20)
    ]
    assert min(excess) > -1e-9  # the edges of 8 facets are among those of 64
    assert 0.02 < np.median(excess) < 0.04
    assert max(excess) < 1.0 / np.cos(np.pi / 8.0) - 1.0  # 8.2 %


def test_forces_jump_where_phi_moves_smoothly() -> None:
    """Four fingers around an object carry its weight by friction: which pair does costs the same."""
    positions = 0.04 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    weight = np.array([0, 0, -1.0, 0, 0, 0])
    one, other = (
        Grasp.from_contacts(positions, -positions / 0.04, 0.5 + 1e-6 * np.array([s, s, -s, -s])) for s in (1.0, -1.0)
    )
    assert np.abs(pyramid_forces(one, weight) - pyramid_forces(other, weight)).max() > 0.9
    smooth = [optimize_force(grasp, weight, method="newton", tolerance=1e-10).force for grasp in (one, other)]
    assert np.abs(smooth[0] - smooth[1]).max() < 1e-3


def test_no_force_is_an_error() -> None:
    floor = Grasp.from_contacts(0.03 * np.eye(3), [[0.0, 0.0, 1.0]] * 3, 0.4)
    with pytest.raises(NotConvergedError, match="found no force"):
        pyramid_forces(floor, np.array([0, 0, 2.0, 0, 0, 0]))
