from __future__ import annotations

import numpy as np
import pytest
from problems import GRASPS, PAPER_WRENCH, random_grasp
from scipy.spatial.transform import Rotation

from grasp_env.errors import InvalidInputError
from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp, presets
from grasp_env.grasp.transforms import checked_rotation, gravity_wrench, transform_wrench, transformed, wrench_about


def _pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3)


def _skew(p: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])


def test_wrenches_transform_by_the_adjoint() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        turn, shift = _pose(rng)
        adjoint = np.block([[turn, np.zeros((3, 3))], [_skew(shift) @ turn, turn]])
        wrench = rng.standard_normal((4, 6))
        made = transform_wrench(wrench, turn, shift)
        np.testing.assert_allclose(made, wrench @ adjoint.T, atol=1e-14)
        np.testing.assert_allclose(transform_wrench(wrench[1], turn, shift), made[1], atol=1e-15)
        np.testing.assert_allclose(transform_wrench(made, turn.T, -turn.T @ shift), wrench, atol=1e-14)


def test_power_does_not_depend_on_the_frame() -> None:
    """A body turning with omega_A about the origin of A: power from velocities of points, no adjoint."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        turn, shift = _pose(rng)
        force, moment, speed, spin = rng.standard_normal((4, 3))  # force, moment in B; twist of the body in A
        at_b = speed + np.cross(spin, shift)  # velocity of B's origin
        in_a = transform_wrench(np.concatenate([force, moment]), turn, shift)
        power = force @ (turn.T @ at_b) + moment @ (turn.T @ spin)
        assert in_a[:3] @ speed + in_a[3:] @ spin == pytest.approx(power, abs=1e-13)


@pytest.mark.parametrize("name", GRASPS)
def test_contact_forces_keep_their_numbers(name: str) -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        turn, shift = _pose(rng)
        moved = transformed(GRASPS[name], turn, shift)
        force = rng.standard_normal((moved.n_contacts, 3))
        expected = transform_wrench(GRASPS[name].wrench(force), turn, shift)
        np.testing.assert_allclose(moved.wrench(force), expected, atol=1e-13)
        np.testing.assert_array_equal(moved.models.cone_scale, GRASPS[name].models.cone_scale)
        assert moved.length == pytest.approx(GRASPS[name].length, rel=1e-12)


def test_models_and_torsions_travel_along() -> None:
    rng = np.random.default_rng(3)
    plain = random_grasp(rng, 5)
    grasp = Grasp.from_contacts(
        plain.positions, plain.normals, [[0.5, 0.4], [0.3, 0.7], [0.2, 0.1], [0.4, 0.4], [0.5, 0.2]],
        contact_model=["hard", "soft", "hard", "frictionless", "soft"], torsional_friction=0.01,
    )  # fmt: skip
    turn, shift = _pose(rng)
    moved = transformed(grasp, turn, shift)
    assert moved.models.names == grasp.models.names
    np.testing.assert_array_equal(moved.models.friction, grasp.models.friction)
    np.testing.assert_array_equal(moved.models.torsional_friction, grasp.models.torsional_friction)
    force, torsion = rng.standard_normal((5, 3)), rng.standard_normal(5)
    expected = transform_wrench(grasp.wrench(force, torsion), turn, shift)
    np.testing.assert_allclose(moved.wrench(force, torsion), expected, atol=1e-13)


def test_the_optimum_is_the_same_in_every_frame() -> None:
    grasp = presets.paper_cuboid()
    turn, shift = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([0.02, -0.01, 0.03])
    here = optimize_force(grasp, PAPER_WRENCH, method="newton", tolerance=1e-10)
    there = optimize_force(
        transformed(grasp, turn, shift), transform_wrench(PAPER_WRENCH, turn, shift), method="newton", tolerance=1e-10
    )
    assert there.objective == pytest.approx(here.objective, rel=1e-9)
    np.testing.assert_allclose(there.force, here.force, atol=1e-4)


def test_identity_changes_no_bit() -> None:
    grasp = presets.paper_cuboid()
    same = transformed(grasp, np.eye(3), np.zeros(3))
    np.testing.assert_array_equal(same.matrix, grasp.matrix)
    np.testing.assert_array_equal(transform_wrench(PAPER_WRENCH, np.eye(3), np.zeros(3)), PAPER_WRENCH)


def test_moment_about_a_point() -> None:
    rng = np.random.default_rng(4)
    wrench, point = rng.standard_normal(6), rng.standard_normal(3)
    np.testing.assert_allclose(wrench_about(wrench, point), transform_wrench(wrench, np.eye(3), -point), atol=1e-15)
    through = np.concatenate([wrench[:3], np.cross(point, wrench[:3])])  # a force that acts at the point
    np.testing.assert_allclose(wrench_about(np.stack([through, through]), point)[:, 3:], 0.0, atol=1e-15)
    np.testing.assert_allclose(wrench_about(wrench_about(wrench, point), -point), wrench, atol=1e-15)


def test_weight() -> None:
    np.testing.assert_allclose(gravity_wrench(2.0), [0, 0, -19.62, 0, 0, 0])
    # turned by a quarter about x: the object's y axis points up, so its weight pulls along -y
    upright = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(gravity_wrench(2.0, [0.1, 0, 0], upright), [0, -19.62, 0, 0, 0, -1.962], atol=1e-14)
    rng = np.random.default_rng(5)
    turn, _ = _pose(rng)
    com, g = rng.standard_normal((2, 3))
    weight = gravity_wrench(0.7, com, turn, g)
    np.testing.assert_allclose(turn @ weight[:3], 0.7 * g, atol=1e-14)
    np.testing.assert_allclose(wrench_about(weight, com)[3:], 0.0, atol=1e-14)


def test_single_precision_rotations_are_made_exact() -> None:
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix().astype(np.float32)
    off = np.abs(turn.T.astype(float) @ turn.astype(float) - np.eye(3)).max()
    exact = checked_rotation(turn)
    assert off > 1e-9
    assert np.abs(exact.T @ exact - np.eye(3)).max() < 1e-14
    np.testing.assert_allclose(exact, turn, atol=1e-7)


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.eye(2), r"rotation must have shape \(3, 3\), got \(2, 2\)"),
        (1.01 * np.eye(3), "R\\^T R misses the identity by 0.0201, at most 1e-06 is allowed"),
        (np.zeros((3, 3)), "misses the identity by 1"),
        (np.diag([1.0, -1.0, 1.0]), r"is a reflection \(determinant -1\)"),
        (np.full((3, 3), np.nan), "must be finite"),
    ],
)
def test_matrices_that_are_no_rotations(rotation: np.ndarray, message: str) -> None:
    for call in (
        lambda: transform_wrench(np.zeros(6), rotation, np.zeros(3)),
        lambda: transformed(presets.tripod(), rotation, np.zeros(3)),
        lambda: gravity_wrench(1.0, rotation=rotation),
    ):
        with pytest.raises(InvalidInputError, match=message):
            call()


@pytest.mark.parametrize("wrench", [np.zeros(5), 1.0, np.full(6, np.nan), [[1.0], [1.0, 2.0]], ["a"] * 6])
def test_wrong_wrenches(wrench: object) -> None:
    with pytest.raises(InvalidInputError, match="wrench must"):
        transform_wrench(wrench, np.eye(3), np.zeros(3))  # type: ignore[arg-type]


def test_wrong_vectors() -> None:
    with pytest.raises(InvalidInputError, match=r"translation must have shape \(3,\)"):
        transform_wrench(np.zeros(6), np.eye(3), np.zeros(2))
    with pytest.raises(InvalidInputError, match=r"point must have shape \(3,\)"):
        wrench_about(np.zeros(6), 0.0)
    with pytest.raises(InvalidInputError, match="mass must be finite and > 0, got 0"):
        gravity_wrench(0.0)
