"""Bases of internal forces that follow moving contacts."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import geometry
from problems import GRASPS, random_grasp

from grasp_env.core import TANGENT_SWITCH
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis


def in_object_frame(grasp: Grasp, basis: np.ndarray) -> np.ndarray:
    return np.einsum("nij,njk->nik", grasp.frames, basis.reshape(grasp.n_contacts, 3, -1)).reshape(basis.shape)


def assert_basis(grasp: Grasp, basis: np.ndarray) -> None:
    assert basis.shape == (3 * grasp.n_contacts, grasp.null_dimension)
    np.testing.assert_allclose(grasp.matrix @ basis, 0.0, atol=1e-14)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)


def test_bases_are_orthonormal_and_internal() -> None:
    rng = np.random.default_rng(0)
    for grasp in (*GRASPS.values(), *(random_grasp(rng, 3 + k % 6) for k in range(20))):
        reference = reference_basis(grasp)
        np.testing.assert_allclose(reference.T @ reference, np.eye(grasp.null_dimension), atol=1e-12)
        forces = reference.reshape(grasp.n_contacts, 3, -1).transpose(0, 2, 1)
        moments = np.cross(grasp.positions[:, None], forces).sum(axis=0)
        np.testing.assert_allclose(np.concatenate([forces.sum(axis=0), moments]), 0.0, atol=1e-13)
        assert_basis(grasp, basis := null_space_basis(grasp, reference))
        np.testing.assert_allclose(in_object_frame(grasp, basis), reference, atol=1e-12)
    # another grasp's reference: the polar factor of its projection
    grasp, nominal = random_grasp(rng, 4), reference_basis(GRASPS["cuboid, 4"])
    here = np.einsum("nba,nbk->nak", grasp.frames, nominal.reshape(4, 3, -1)).reshape(nominal.shape)
    np.testing.assert_allclose(null_space_basis(grasp, nominal), geometry.polar_basis(here, grasp.matrix), atol=1e-9)


def rolled(angle: float) -> Grasp:
    """Four contacts on a sphere of 50 mm that roll with `angle`; the first normal sweeps from e_z to e_x and on."""
    s, c = np.sin(angle), np.cos(angle)
    out = np.array([[s, 0, c], [-0.8 * s, 0.6, -0.8 * c], [0.3 * c, -0.9, 0.2 + 0.1 * s], [-0.5, 0.4 * np.cos(2 * angle), -0.7]])  # fmt: skip
    out /= np.linalg.norm(out, axis=1)[:, None]
    return Grasp.from_contacts(0.05 * out, -out, 0.6)


def test_the_basis_is_smooth_where_the_tangents_switch() -> None:
    centre = float(np.arcsin(TANGENT_SWITCH))  # |n_x| = sin(angle) of the first contact
    reference = reference_basis(rolled(centre - 0.1))

    def moves(step: float) -> tuple[float, float]:
        a, b = rolled(centre - step), rolled(centre + step)
        x, y = null_space_basis(a, reference), null_space_basis(b, reference)
        assert_basis(a, x)
        return np.abs(in_object_frame(b, y) - in_object_frame(a, x)).max(), np.abs(y - x).max()

    (fine, jump), (coarse, _) = moves(1e-6), moves(1e-5)
    assert fine == pytest.approx(0.1 * coarse, rel=1e-3)  # differentiable
    assert jump > 0.1  # in contact frames
