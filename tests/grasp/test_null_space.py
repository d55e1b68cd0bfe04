from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from problems import GRASPS, random_grasp

from grasp_env.core import TANGENT_SWITCH
from grasp_env.grasp import Grasp, null_space_basis, presets, reference_basis


def _in_object_frame(grasp: Grasp, basis: np.ndarray) -> np.ndarray:
    blocks = basis.reshape(grasp.n_contacts, 3, -1)
    return np.einsum("nij,njk->nik", grasp.frames, blocks).reshape(basis.shape)


def _check_basis(grasp: Grasp, basis: np.ndarray) -> None:
    assert basis.shape == (3 * grasp.n_contacts, grasp.null_dimension)
    # unit columns, forces of order one: what is left is the rounding of two projections
    np.testing.assert_allclose(grasp.matrix @ basis, 0.0, atol=1e-14)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)


@pytest.mark.parametrize("name", GRASPS)
def test_basis_of_named_grasps(name: str) -> None:
    _check_basis(GRASPS[name], null_space_basis(GRASPS[name]))


def test_basis_of_random_grasps() -> None:
    rng = np.random.default_rng(0)
    for k in range(60):
        grasp = random_grasp(rng, 3 + k % 6)
        _check_basis(grasp, null_space_basis(grasp))


def test_reference_is_orthonormal_and_internal() -> None:
    for grasp in GRASPS.values():
        reference = reference_basis(grasp)
        np.testing.assert_allclose(reference.T @ reference, np.eye(grasp.null_dimension), atol=1e-12)
        forces = reference.reshape(grasp.n_contacts, 3, -1)
        np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-13)
        moments = np.cross(grasp.positions[:, None], forces.transpose(0, 2, 1)).sum(axis=0)
        np.testing.assert_allclose(moments, 0.0, atol=1e-14)


def _grasp_on_sphere(angle: float) -> Grasp:
    """Four contacts on a sphere of 50 mm that roll with `angle`; the first normal sweeps from e_z to e_x and on."""
    directions = np.array(
        [
            [np.sin(angle), 0.0, np.cos(angle)],
            [-np.sin(angle) * 0.8, 0.6, -np.cos(angle) * 0.8],
            [0.3 * np.cos(angle), -0.9, 0.2 + 0.1 * np.sin(angle)],
            [-0.5, 0.4 * np.cos(2.0 * angle), -0.7],
        ]
    )
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return Grasp.from_contacts(0.05 * directions, -directions, 0.6)


def test_basis_moves_continuously_through_the_switch_of_the_tangents() -> None:
    angles = np.linspace(0.2, 1.5, 1301)
    grasps = [_grasp_on_sphere(angle) for angle in angles]
    reference = reference_basis(grasps[len(grasps) // 2])
    bases = [null_space_basis(grasp, reference) for grasp in grasps]
    for grasp, basis in zip(grasps, bases, strict=True):
        _check_basis(grasp, basis)
    moves = [
        float(np.abs(_in_object_frame(b, y) - _in_object_frame(a, x)).max())
        for a, x, b, y in zip(grasps[:-1], bases[:-1], grasps[1:], bases[1:], strict=True)
    ]
    # a step of 1 mrad turns forces by about 1 mrad; the projection may amplify it, a jump would be of order one
    assert max(moves) < 0.02
    # and the switch was crossed: the same steps jump in contact frames
    crossed = [abs(grasp.normals[0, 0]) > TANGENT_SWITCH for grasp in grasps]
    assert any(crossed)
    assert not all(crossed)
    jumps = [float(np.abs(y - x).max()) for x, y in pairwise(bases)]
    assert max(jumps) > 0.1


def test_refined_steps_move_the_basis_in_proportion() -> None:
    # exactly at the switch of the first contact: |n_x| = sin(angle) = 0.9
    centre = float(np.arcsin(TANGENT_SWITCH))
    reference = reference_basis(_grasp_on_sphere(centre - 0.1))

    def move(step: float) -> float:
        a, b = _grasp_on_sphere(centre - step), _grasp_on_sphere(centre + step)
        difference = _in_object_frame(b, null_space_basis(b, reference))
        return float(np.abs(difference - _in_object_frame(a, null_space_basis(a, reference))).max())

    # differentiable: a tenth of the step gives a tenth of the move, to the step's own order
    assert move(1e-6) == pytest.approx(0.1 * move(1e-5), rel=1e-3)


def test_own_reference_is_kept() -> None:
    """Projecting a basis of the same null space changes nothing."""
    grasp = presets.paper_cuboid()
    reference = reference_basis(grasp)
    np.testing.assert_allclose(_in_object_frame(grasp, null_space_basis(grasp, reference)), reference, atol=1e-13)
