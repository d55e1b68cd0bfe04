"""Changes of frame."""

from __future__ import annotations

import numpy as np
import pytest
from problems import GRASPS, PAPER_WRENCH, random_grasp
from scipy.spatial.transform import Rotation

from grasp_env.grasp import Grasp
from grasp_env.grasp.transforms import (
    checked_rotation,
    gravity_wrench,
    transform_wrench,
    transformed,
    wrench_about,
)


def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3)


def test_wrenches_transform_by_the_adjoint():
    rng = np.random.default_rng(0)
    for _ in range(20):
        turn, shift = pose(rng)
        skew = np.cross(np.eye(3), shift)
        adjoint = np.block([[turn, np.zeros((3, 3))], [skew @ turn, turn]])
        wrench = rng.standard_normal((4, 6))
        point = rng.standard_normal(3)
        made = transform_wrench(wrench, turn, shift)
        np.testing.assert_allclose(made, wrench @ adjoint.T, atol=1e-14)
        np.testing.assert_allclose(
            transform_wrench(made, turn.T, -turn.T @ shift), wrench, atol=1e-14
        )
        # power in both frames, from the velocity of B's origin
        speed, spin = rng.standard_normal((2, 3))
        power = wrench[0, :3] @ (turn.T @ (speed + np.cross(spin, shift))) + wrench[0, 3:] @ (
            turn.T @ spin
        )
        assert made[0] @ np.concatenate([speed, spin]) == pytest.approx(power, abs=1e-13)
        np.testing.assert_allclose(
            wrench_about(wrench, point), transform_wrench(wrench, np.eye(3), -point), atol=1e-14
        )
    np.testing.assert_array_equal(
        transform_wrench(PAPER_WRENCH, np.eye(3), np.zeros(3)), PAPER_WRENCH
    )


def test_contact_forces_keep_their_numbers_in_another_frame():
    rng = np.random.default_rng(3)
    plain = random_grasp(np.random.default_rng(3), 5)
    models = ["hard", "soft", "hard", "frictionless", "soft"]
    mixed = Grasp.from_contacts(
        plain.positions,
        plain.normals,
        rng.uniform(0.2, 0.7, (5, 2)),
        contact_model=models,
        torsional_friction=0.01,
    )
    for grasp in (*GRASPS.values(), mixed):
        turn, shift = pose(rng)
        moved = transformed(grasp, turn, shift)
        force = rng.standard_normal((moved.n_contacts, 3))
        torsion = rng.standard_normal(moved.n_contacts)
        expected = transform_wrench(grasp.wrench(force, torsion), turn, shift)
        np.testing.assert_allclose(moved.wrench(force, torsion), expected, atol=1e-13)
        for name in ("friction", "torsional_friction", "cone_scale"):
            np.testing.assert_array_equal(getattr(moved.models, name), getattr(grasp.models, name))
        assert moved.models.names == grasp.models.names


def test_weight():
    np.testing.assert_allclose(gravity_wrench(2.0), [0, 0, -19.62, 0, 0, 0])
    # a quarter turn about x: the object's y axis points up, so its weight pulls along -y
    upright = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(
        gravity_wrench(2.0, [0.1, 0, 0], upright), [0, -19.62, 0, 0, 0, -1.962], atol=1e-14
    )
    rng = np.random.default_rng(5)
    (turn, _), (com, gravity) = pose(rng), rng.standard_normal((2, 3))
    weight = gravity_wrench(0.7, com, turn, gravity)
    np.testing.assert_allclose(turn @ weight[:3], 0.7 * gravity, atol=1e-14)
    np.testing.assert_allclose(wrench_about(weight, com)[3:], 0.0, atol=1e-14)


def test_single_precision_rotations_are_made_exact():
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix().astype(np.float32)
    exact = checked_rotation(turn)
    np.testing.assert_allclose(exact.T @ exact, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(exact, turn, atol=1e-7)
