"""What late measurements mean now: a snapshot carried forward against the scene some steps later."""

from __future__ import annotations

import numpy as np
from hands import controller_alone

from grasp_env import core
from grasp_env.sim import Scene, SceneConfig, Snapshot
from grasp_env.task.motion import resting_target


def test_carried_forward_is_what_comes() -> None:
    """A free object turns and drifts at constant speed, one joint moves slowly: what is seen 20 ms late is carried to now."""
    late = 5
    scene = Scene(SceneConfig(clearance=0.03, gravity=(0.0, 0.0, 0.0)))
    hand = scene.config.hand
    sensors = core.SensorSettings()
    sensors.tick, sensors.delay = scene.timestep, late
    controller = controller_alone(scene.core, sensors=sensors)
    controller.reset()
    torques, still = np.zeros(hand.joint_count), (np.zeros(6), np.zeros(3), resting_target(1)[0], np.zeros(15))
    torques[2] = 1e-4  # [N m]
    scene.step(torques, [0.5, -0.2, 0.3, 0.01, 0.02, -0.03])
    before = scene.look().points.copy()
    for _ in range(late):
        controller.see(None, *still)
        scene.step(np.zeros(hand.joint_count))
        scene.look()
    controller.see(None, *still)
    seen, now = Snapshot(**controller.seen()), scene.look()
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
