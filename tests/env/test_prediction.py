"""What late measurements mean now: a snapshot carried forward against the scene some steps later."""

from __future__ import annotations

import numpy as np

from grasp_env.prediction import carry_forward
from grasp_env.sim import Scene, SceneConfig
from grasp_env.sim.snapshot import split


def test_carried_forward_is_what_comes() -> None:
    """A free object turns and drifts at constant speed, one joint moves slowly: after 20 ms the prediction is the scene."""
    scene = Scene(SceneConfig(clearance=0.03, gravity=(0.0, 0.0, 0.0)))
    hand = scene.config.hand
    torques = np.zeros(hand.joint_count)
    torques[2] = 1e-4  # [N m]
    scene.step(torques, [0.5, -0.2, 0.3, 0.01, 0.02, -0.03])
    scene.look()
    buffer = scene.buffer.copy()
    seen = split(buffer, hand.finger_count, hand.joint_count)
    before = seen.points.copy()
    for _ in range(5):
        scene.step(np.zeros(hand.joint_count))
    time = 5 * scene.timestep
    carry_forward(*scene.observed, time, buffer)
    now = scene.look()
    # the cube's three moments of inertia are equal: it turns at constant velocity; Bullet's quaternion steps are exact to 1e-6
    np.testing.assert_allclose(seen.rotation, now.rotation, atol=1e-6)
    np.testing.assert_allclose(seen.position, now.position, atol=1e-12)
    # the joint's own speed changes by Coriolis torques only: (0.05 rad/s)^2 * 0.02 s
    np.testing.assert_allclose(seen.angles, now.angles, atol=1e-5)
    np.testing.assert_allclose(seen.points, now.points, atol=1e-5)
    np.testing.assert_allclose(seen.touch, now.touch, atol=1e-5)
    np.testing.assert_allclose(seen.gaps, now.gaps, atol=1e-5)
    assert np.abs(now.points - before).max() > 1e-4  # and something did move
    scene.close()
