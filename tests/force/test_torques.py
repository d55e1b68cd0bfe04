from __future__ import annotations

import numpy as np
import pytest
from problems import random_grasp

from grasp_env.errors import InvalidInputError
from grasp_env.force.torques import joint_torques
from grasp_env.grasp import presets


def _hand(rng: np.random.Generator, count: int, joints: int) -> np.ndarray:
    """(N, 6, J) object-frame Jacobian of fingers that share all joints: nothing about it is special."""
    return rng.standard_normal((count, 6, joints))


def test_torques_do_the_power_of_the_forces() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        grasp = random_grasp(rng, 4)
        jac = _hand(rng, 4, 5)
        force, torsion, speed = rng.standard_normal((4, 3)), rng.standard_normal(4), rng.standard_normal(5)
        in_object = np.einsum("nij,nj->ni", grasp.frames, force)
        power = sum(float(in_object[k] @ (jac[k, :3] @ speed)) for k in range(4))
        assert joint_torques(jac[:, :3], in_object) @ speed == pytest.approx(power, rel=1e-12)
        twisting = sum(float(torsion[k] * grasp.normals[k] @ (jac[k, 3:] @ speed)) for k in range(4))
        tau = joint_torques(jac, in_object, moment=torsion[:, None] * grasp.normals)
        assert tau @ speed == pytest.approx(power + twisting, rel=1e-11, abs=1e-12)


def test_a_wrench_seen_from_the_joints() -> None:
    """Fingers carried by one base: six base 'joints' feel the whole wrench, G f."""
    grasp = presets.paper_cuboid()
    base = np.zeros((4, 3, 6))
    base[:, :, :3] = np.eye(3)
    for k, (x, y, z) in enumerate(grasp.positions):
        base[k, :, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]  # omega x p
    force = np.random.default_rng(1).standard_normal((4, 3))
    np.testing.assert_allclose(joint_torques(base, grasp.to_object_frame(force)), grasp.wrench(force), atol=1e-14)


def test_shapes_and_bias() -> None:
    rng = np.random.default_rng(2)
    jac, force, bias = rng.standard_normal((4, 3, 2)), rng.standard_normal((4, 3)), np.array([1.0, -2.0])
    plain = joint_torques(jac, force)
    np.testing.assert_array_equal(joint_torques(jac.reshape(12, 2), force), plain)
    np.testing.assert_allclose(plain, jac.reshape(12, 2).T @ force.reshape(-1), atol=1e-14)
    np.testing.assert_array_equal(joint_torques(jac, force, bias), plain + bias)
    six = np.concatenate([jac, rng.standard_normal((4, 3, 2))], axis=1)
    np.testing.assert_array_equal(joint_torques(six, force), plain)  # no moment, no torque of it


@pytest.mark.parametrize(
    ("jacobian", "message"),
    [
        (np.zeros((3, 3, 2)), r"jacobian must have shape \(4, 3, J\), \(12, J\) or \(4, 6, J\) .*got \(3, 3, 2\)"),
        (np.zeros((4, 4, 2)), r"got \(4, 4, 2\)"),
        (np.zeros((4, 3, 0)), r"got \(4, 3, 0\)"),
        (np.zeros((11, 2)), r"got \(11, 2\)"),
        (np.zeros(12), r"got \(12,\)"),
        (np.full((4, 3, 2), np.inf), "jacobian must be finite"),
        ([[1.0], [1.0, 2.0]], "jacobian must be numbers"),
    ],
)
def test_wrong_jacobians(jacobian: object, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        joint_torques(jacobian, np.zeros((4, 3)))  # type: ignore[arg-type]


def test_wrong_vectors() -> None:
    jac = np.zeros((4, 3, 2))
    with pytest.raises(InvalidInputError, match=r"force must have shape \(N, 3\)"):
        joint_torques(jac, np.zeros(12))
    with pytest.raises(InvalidInputError, match=r"bias must have shape \(2,\), got \(3,\)"):
        joint_torques(jac, np.zeros((4, 3)), np.zeros(3))
    with pytest.raises(InvalidInputError, match=r"moment needs a jacobian of shape \(N, 6, J\)"):
        joint_torques(jac, np.zeros((4, 3)), moment=np.zeros((4, 3)))
    with pytest.raises(InvalidInputError, match=r"moment must have shape \(4, 3\)"):
        joint_torques(np.zeros((4, 6, 2)), np.zeros((4, 3)), moment=np.zeros(4))
