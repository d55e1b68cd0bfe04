"""Desired motions: exact derivatives, at rest at both ends, within what the hand reaches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grasp_env.task.motion import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    LINEAR_ACCELERATION,
    MOTIONS,
    POSITION,
    QUATERNION,
    blend,
    motion_target,
    resting_target,
)

STEP = 1e-4
TIMES = np.arange(round(4.0 / STEP) + 1) * STEP


def difference(values: np.ndarray) -> np.ndarray:
    return (values[2:] - values[:-2]) / (2.0 * STEP)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("period", [0.7, 1.0, 3.0, 9.0])
def test_velocities_and_accelerations_are_the_derivatives(motion, period):
    target = motion_target(motion, TIMES, 0.3, period)
    # central differences miss by STEP^2 / 6 of the next derivative but one, and by STEP / 2 of the next where that jumps
    jerk = 0.3 * 60.0 * (3.0 / period) ** 3
    np.testing.assert_allclose(difference(target[:, POSITION]), target[1:-1, LINEAR], atol=STEP**2 * jerk)
    for value, rate in ((LINEAR, LINEAR_ACCELERATION), (ANGULAR, ANGULAR_ACCELERATION)):
        np.testing.assert_allclose(difference(target[:, value]), target[1:-1, rate], atol=STEP * jerk)
    rotation = Rotation.from_quat(target[:, QUATERNION])
    turned = (rotation[2:] * rotation[:-2].inv()).as_rotvec() / (2.0 * STEP)
    np.testing.assert_allclose(turned, target[1:-1, ANGULAR], atol=1e-4)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("period", [0.37, 1.0, 4.0])
def test_twice_continuously_differentiable_and_at_rest_at_both_ends(motion, period):
    target = motion_target(motion, TIMES, 0.05, period)
    np.testing.assert_allclose(target[[0, -1]], resting_target(2), atol=1e-12)
    steps = np.abs(np.diff(target[:, LINEAR.start :], axis=0)).max(axis=0)
    jerk = 0.05 * 3000.0 / period**3  # above the largest jerk of each
    assert steps.max() < jerk * STEP * max(1.0, period)


def test_sizes_are_reached():
    peak = {motion: np.abs(motion_target(motion, TIMES, 0.2, 1.0)) for motion in MOTIONS}
    assert peak["lift"][:, 1].max() == pytest.approx(0.2)
    assert peak["shake"][:, 0].max() == pytest.approx(0.2, rel=1e-6)
    assert 2.0 * np.arcsin(peak["rotate"][:, 5].max()) == pytest.approx(0.2)
    np.testing.assert_allclose(np.linalg.norm(peak["rotate"][:, QUATERNION], axis=1), 1.0)
    # only what moves moves
    assert not np.delete(peak["lift"], [1, 6, 8, 14], axis=1).any()
    assert not np.delete(peak["shake"], [0, 6, 7, 13], axis=1).any()
    assert not np.delete(peak["rotate"], [5, 6, 12, 18], axis=1).any()


def test_rests_after_the_last_whole_period():
    target = motion_target("lift", TIMES, 0.1, 1.5)  # 2 of them end at 3 s
    still = TIMES > 3.0
    np.testing.assert_array_equal(target[still], resting_target(int(still.sum())))
    assert target[round(2.25 / STEP), 1] == pytest.approx(0.1)


def test_blend_is_the_minimum_jerk_polynomial():
    u = np.linspace(0.0, 1.0, 11)
    polynomial = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    expected = [polynomial(u), polynomial.deriv()(u), polynomial.deriv(2)(u)]
    np.testing.assert_allclose(blend(u), expected, atol=1e-13)
    np.testing.assert_array_equal(blend(np.array([-3.0, 7.0])), [[0, 1], [0, 0], [0, 0]])
