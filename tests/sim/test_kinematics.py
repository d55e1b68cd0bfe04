"""The compiled kinematics against PyBullet's own and against finite differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from grasp_env.errors import InvalidInputError
from grasp_env.sim import Client, FingerDescription, HandDescription, HandKinematics, Scene
from grasp_env.sim.client import bullet
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.kinematics import trace_finger, write_gravity_torques, write_point_jacobian
from grasp_env.sim.urdf import hand_urdf

TURNED = HandDescription(
    fingers=(
        FingerDescription("skew", (0.2, 0.1, 0.0), (2 / 3, 2 / 3, 1 / 3), (-2 / 3, 1 / 3, 2 / 3)),
        FingerDescription("up", (0.0, 0.1, 0.2), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        FingerDescription("down", (0.0, 0.1, -0.2), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    ),
    link_lengths=(0.02, 0.09, 0.05),
    link_masses=(0.05, 0.01, 0.04, 0.03),
)
GRAVITY = np.array([1.0, -9.0, 2.0])


class Loaded:
    """A hand in PyBullet beside its compiled twin, both at the same random angles."""

    def __init__(self, hand: HandDescription, path: Path) -> None:
        path.write_text(hand_urdf(hand))
        self.client, self.hand, self.kinematics = Client(), hand, HandKinematics(hand)
        number = self.client.number
        self.body = bullet.loadURDF(
            str(path), useFixedBase=True, flags=bullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=number
        )
        self.angles = np.random.default_rng(3).uniform(-0.6, 1.1, hand.joint_count)
        for joint, angle in enumerate(self.angles):
            bullet.resetJointState(self.body, joint, angle, physicsClientId=number)

    def traced(self, finger: int) -> tuple[np.ndarray, np.ndarray]:
        kinematics, origins, axes = self.kinematics, np.empty((4, 3)), np.empty((3, 3))
        trace_finger(
            kinematics.bases[finger],
            kinematics.rotations[finger],
            kinematics.lengths,
            self.angles[3 * finger : 3 * finger + 3],
            origins,
            axes,
        )
        return origins, axes


@pytest.fixture(params=["four_finger", "turned"])
def loaded(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Loaded]:
    hand = HandDescription.four_finger() if request.param == "four_finger" else TURNED
    made = Loaded(hand, tmp_path / "hand.urdf")
    yield made
    made.client.close()


def test_joint_positions_match_pybullet(loaded: Loaded) -> None:
    for finger in range(len(loaded.hand.fingers)):
        origins, _ = loaded.traced(finger)
        for k in range(3):
            link = bullet.getLinkState(
                loaded.body,
                3 * finger + k,
                computeForwardKinematics=1,
                physicsClientId=loaded.client.number,
            )
            # getLinkState rounds to single precision; the Jacobians below do not
            np.testing.assert_allclose(origins[k], link[4], atol=3e-8)


def test_jacobians_match_pybullet(loaded: Loaded) -> None:
    count, jacobian = loaded.hand.joint_count, np.empty((3, 3))
    for finger in range(len(loaded.hand.fingers)):
        origins, axes = loaded.traced(finger)
        write_point_jacobian(origins, axes, origins[3], jacobian)
        full, _ = bullet.calculateJacobian(
            loaded.body,
            3 * finger + 2,
            [loaded.hand.link_lengths[2], 0.0, 0.0],
            loaded.angles.tolist(),
            [0.0] * count,
            [0.0] * count,
            physicsClientId=loaded.client.number,
        )
        expected = np.zeros((3, count))
        expected[:, 3 * finger : 3 * finger + 3] = jacobian
        np.testing.assert_allclose(full, expected, atol=1e-12)


def test_jacobians_match_finite_differences(loaded: Loaded) -> None:
    jacobian, step = np.empty((3, 3)), 1e-6
    for finger in range(len(loaded.hand.fingers)):
        origins, axes = loaded.traced(finger)
        write_point_jacobian(origins, axes, origins[3], jacobian)
        for k in range(3):
            shift = np.zeros(loaded.hand.joint_count)
            shift[3 * finger + k] = step
            ahead = loaded.kinematics.tips(loaded.angles + shift)
            behind = loaded.kinematics.tips(loaded.angles - shift)
            slope = (ahead - behind)[finger] / (2 * step)
            np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-9)


def test_gravity_torques_match_pybullet(loaded: Loaded) -> None:
    kinematics, count = loaded.kinematics, loaded.hand.joint_count
    torques = np.empty(count)
    for finger in range(len(loaded.hand.fingers)):
        own = torques[3 * finger : 3 * finger + 3]
        write_gravity_torques(*loaded.traced(finger), kinematics.masses, kinematics.fractions, GRAVITY, own)
    bullet.setGravity(*GRAVITY, physicsClientId=loaded.client.number)
    zero = [0.0] * count
    expected = bullet.calculateInverseDynamics(
        loaded.body, loaded.angles.tolist(), zero, zero, physicsClientId=loaded.client.number
    )
    np.testing.assert_allclose(torques, expected, atol=1e-12)


def test_inverse_kinematics_reaches_the_nominal_contacts() -> None:
    config = SceneConfig()
    kinematics, tips = HandKinematics(config.hand), config.nominal_tips()
    angles = kinematics.solve(tips)
    np.testing.assert_allclose(kinematics.tips(angles), tips, atol=1e-12)
    assert np.array_equal(angles, kinematics.solve(tips))
    lower, upper = np.tile(config.hand.joint_lower, 4), np.tile(config.hand.joint_upper, 4)
    assert np.minimum(angles - lower, upper - angles).min() > 0.3  # far from every limit


def test_nominal_pose_is_far_from_singular(make_scene: Callable[..., Scene]) -> None:
    for jacobian in make_scene().jacobians():
        assert np.linalg.cond(jacobian) < 4.0


def test_out_of_reach_names_the_finger() -> None:
    kinematics = HandKinematics(HandDescription.four_finger())
    tips = SceneConfig().nominal_tips()
    tips[2, 1] = -0.2
    with pytest.raises(InvalidInputError, match=r"'left' cannot reach.*allowed are 0\.0100 to 0\.1500"):
        kinematics.solve(tips)


def test_beyond_a_joint_limit_is_refused() -> None:
    kinematics = HandKinematics(HandDescription.four_finger())
    tips = SceneConfig().nominal_tips()
    tips[0] = (0.13, 0.13, -0.08)
    with pytest.raises(InvalidInputError, match="'thumb' needs angles"):
        kinematics.solve(tips)


def _points_along(origins: np.ndarray) -> np.ndarray:
    steps = np.linspace(0.0, 1.0, 41)[:, None]
    return np.vstack([a + steps * (b - a) for a, b in pairwise(origins)])


def test_links_clear_one_another_and_the_object() -> None:
    config = SceneConfig()
    hand, kinematics = config.hand, HandKinematics(config.hand)
    angles, lines = kinematics.solve(config.nominal_tips()), []
    for i in range(4):
        origins, axes = np.empty((4, 3)), np.empty((3, 3))
        own = angles[3 * i : 3 * i + 3]
        trace_finger(kinematics.bases[i], kinematics.rotations[i], kinematics.lengths, own, origins, axes)
        lines.append(_points_along(origins))
    for i, line in enumerate(lines):
        outside = np.maximum(np.abs(line) - config.half_extents, 0.0)
        assert np.linalg.norm(outside, axis=1).min() > hand.link_radius + 0.002
        for other in lines[:i]:
            gaps = np.linalg.norm(line[:, None] - other[None], axis=2)
            assert gaps.min() > 2 * hand.link_radius + 0.003


def test_descriptions_refuse_nonsense() -> None:
    with pytest.raises(InvalidInputError, match="orthogonal unit"):
        FingerDescription("bent", (0.0, 0.0, 0.0), press=(0.0, -1.0, 0.1))
    fingers = HandDescription.four_finger().fingers
    with pytest.raises(InvalidInputError, match="link_masses"):
        HandDescription(fingers, link_masses=(0.02, 0.03, 0.0, 0.01))
    with pytest.raises(InvalidInputError, match="joint_lower"):
        HandDescription(fingers, joint_lower=(2.0, 0.0, 0.0))
    with pytest.raises(InvalidInputError, match="empty"):
        HandDescription(())
