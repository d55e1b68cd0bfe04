"""The compiled factors against the numpy code that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from problems import GRASPS, random_grasp

from grasp_env.force.factor_kernels import flow_lanes, orthonormal_rows
from grasp_env.force.flow import fastest_form, matrices
from grasp_env.grasp import Grasp, presets

RANDOM = {f"random, {k}": random_grasp(np.random.default_rng(k), 3 + k % 6) for k in range(12)}
ALL = {**GRASPS, **RANDOM}


def factors(grasp: Grasp) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    matrix = grasp.unit_frame @ grasp.matrix
    rows, lower = np.empty_like(matrix), np.empty((6, 6))
    assert orthonormal_rows(matrix, rows, lower)
    return matrix, rows, np.tril(lower)


@pytest.mark.parametrize("name", ALL)
def test_rows(name: str) -> None:
    matrix, rows, lower = factors(ALL[name])
    np.testing.assert_allclose(rows @ rows.T, np.eye(6), atol=1e-14)
    np.testing.assert_allclose(lower @ rows, matrix, atol=1e-13)


@pytest.mark.parametrize("name", ALL)
def test_matrices_of_the_flow(name: str) -> None:
    grasp = ALL[name]
    first = flow_lanes(grasp.unit_frame @ grasp.cone_matrix)
    expected, _, _ = matrices(grasp, fastest_form(grasp.n_contacts))
    assert first.shape == expected.shape
    if grasp.n_contacts > 4:  # rows are unique up to a rotation among themselves: compare their projector
        first, expected = (np.einsum("bzrl,czsm->brlcsm", *([_rows(m)] * 2)) for m in (first, expected))
    np.testing.assert_allclose(first, expected, atol=1e-12)


def _rows(table: np.ndarray) -> np.ndarray:
    """(blocks, 6, 3, 4) rows, coordinates, lanes."""
    return table.reshape(-1, 3, 6, 4).transpose(0, 2, 1, 3)


def test_what_has_no_factors() -> None:
    grasp = presets.tripod()
    matrix = grasp.unit_frame @ grasp.matrix
    rows, lower = np.empty_like(matrix), np.empty((6, 6))
    matrix[5] = 0.0
    assert not orthonormal_rows(matrix, rows, lower)
    assert len(flow_lanes(matrix)) == 0
