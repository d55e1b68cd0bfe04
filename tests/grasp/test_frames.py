"""Changes of frame, and the bases of internal forces that follow moving contacts."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import geometry
from problems import GRASPS, PAPER_WRENCH, random_grasp
from scipy.spatial.transform import Rotation

from grasp_env.core import TANGENT_SWITCH
from grasp_env.grasp import Grasp
from grasp_env.grasp.null_space import null_space_basis, reference_basis
from grasp_env.grasp.transforms import checked_rotation, gravity_wrench, transform_wrench, transformed, wrench_about


def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3)


def test_wrenches_transform_by_the_adjoint() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        turn, shift = pose(rng)
        skew = np.cross(np.eye(3), shift)
        adjoint = np.block([[turn, np.zeros((3, 3))], [skew @ turn, turn]])
        wrench, point = rng.standard_normal((4, 6)), rng.standard_normal(3)
        made = transform_wrench(wrench, turn, shift)
        np.testing.assert_allclose(made, wrench @ adjoint.T, atol=1e-14)
        np.testing.assert_allclose(transform_wrench(made, turn.T, -turn.T @ shift), wrench, atol=1e-14)
        # power in both frames, from the velocity of B's origin
        speed, spin = rng.standard_normal((2, 3))
        power = wrench[0, :3] @ (turn.T @ (speed + np.cross(spin, shift))) + wrench[0, 3:] @ (turn.T @ spin)
        assert made[0] @ np.concatenate([speed, spin]) == pytest.approx(power, abs=1e-13)
        np.testing.assert_allclose(wrench_about(wrench, point), transform_wrench(wrench, np.eye(3), -point), atol=1e-14)
    np.testing.assert_array_equal(transform_wrench(PAPER_WRENCH, np.eye(3), np.zeros(3)), PAPER_WRENCH)


def test_contact_forces_keep_their_numbers_in_another_frame() -> None:
    rng, plain = np.random.default_rng(3), random_grasp(np.random.default_rng(3), 5)
    models = ["hard", "soft", "hard", "frictionless", "soft"]
    mixed = Grasp.from_contacts(
        plain.positions, plain.normals, rng.uniform(0.2, 0.7, (5, 2)), contact_model=models, torsional_friction=0.01
    )
    for grasp in (*GRASPS.values(), mixed):
        turn, shift = pose(rng)
        moved = transformed(grasp, turn, shift)
        force, torsion = rng.standard_normal((moved.n_contacts, 3)), rng.standard_normal(moved.n_contacts)
        expected = transform_wrench(grasp.wrench(force, torsion), turn, shift)
        np.testing.assert_allclose(moved.wrench(force, torsion), expected, atol=1e-13)
        for name in ("friction", "torsional_friction", "cone_scale"):
            np.testing.assert_array_equal(getattr(moved.models, name), getattr(grasp.models, name))
        assert moved.models.names == grasp.models.names


def test_weight() -> None:
    np.testing.assert_allclose(gravity_wrench(2.0), [0, 0, -19.62, 0, 0, 0])
    # a quarter turn about x: the object's y axis points up, so its weight pulls along -y
    upright = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(gravity_wrench(2.0, [0.1, 0, 0], upright), [0, -19.62, 0, 0, 0, -1.962], atol=1e-14)
    rng = np.random.default_rng(5)
    (turn, _), (com, gravity) = pose(rng), rng.standard_normal((2, 3))
    weight = gravity_wrench(0.7, com, turn, gravity)
    np.testing.assert_allclose(turn @ weight[:3], 0.7 * gravity, atol=1e-14)
    np.testing.assert_allclose(wrench_about(weight, com)[3:], 0.0, atol=1e-14)


def test_single_precision_rotations_are_made_exact() -> None:
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix().astype(np.float32)
    exact = checked_rotation(turn)
    np.testing.assert_allclose(exact.T @ exact, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(exact, turn, atol=1e-7)


# internal forces


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
