"""Errors of motors: how they are drawn, what they do to torques, and when they begin."""

from __future__ import annotations

import numpy as np
import pytest
from engines import needs_bullet

from grasp_env.config import EnvConfig
from grasp_env.env.env import FourFingerGrasp
from grasp_env.env.motors import Motors

COUNT = 2000
"""Number of joints, for statistics over them."""
ZERO = np.zeros(6, dtype=np.float32)


def delivered(ticks: int, rate: int = 1000, seed: int = 5, **motors: float) -> np.ndarray:
    """Return the torques (ticks, COUNT) of motors that are commanded 1 N m."""
    config = EnvConfig(
        controller={"rate": rate}, engine={"name": "bullet", "rate": 1000}, motors=motors
    )
    drive = Motors(config, np.full(COUNT, 10.0), seed)
    return np.array([drive([1.0] * COUNT) for _ in range(ticks)])


def correlation(torques: np.ndarray, ticks: int) -> float:
    """Return the correlation of errors that many ticks apart."""
    errors = torques - 1.0
    return float(np.mean(errors[ticks:] * errors[:-ticks]) / np.mean(errors**2))


@pytest.mark.parametrize("rate", [250, 1000])
def test_errors_have_their_size_and_correlation_time(rate):
    """0.05 of the torque, whatever the rate: 2000 joints give it to 5 %, and correlations to 0.1."""
    ticks = round(0.3 * rate)
    fast, slow, gain = (
        delivered(2 * ticks, rate, **motors)
        for motors in (
            {"noise": 0.05, "noise_time": 0.016},
            {"drift": 0.05, "drift_time": 0.3},
            {"gain_error": 0.05},
        )
    )
    for torques in (fast, slow, gain):
        assert torques.mean() == pytest.approx(1.0, abs=0.01)
        assert torques[0].std() == pytest.approx(0.05, rel=0.05)
        assert torques[-1].std() == pytest.approx(0.05, rel=0.05)
    assert correlation(fast, round(0.016 * rate)) == pytest.approx(0.0, abs=0.05)
    assert correlation(fast, round(0.008 * rate)) == pytest.approx(0.5, abs=0.1)
    assert correlation(slow, ticks) == pytest.approx(np.exp(-1.0), abs=0.1)
    assert correlation(gain, ticks) == pytest.approx(1.0)


def test_noise_without_a_time_is_drawn_at_every_tick():
    assert abs(correlation(delivered(20, noise=0.05, noise_time=0.0), 1)) < 0.05


def test_one_error_does_not_change_the_draws_of_another():
    one, other = delivered(3, noise=0.05), delivered(3, drift=0.05, gain_error=0.1)
    both = delivered(3, noise=0.05, drift=0.05, gain_error=0.1)
    np.testing.assert_allclose(both - 1.0, (one - 1.0) + (other - 1.0), atol=1e-12)
    assert not np.allclose(one, delivered(3, seed=6, noise=0.05))


def test_ideal_motors_deliver_what_is_commanded():
    drive = Motors(EnvConfig(motors={"friction": 0.1}), np.ones(3), 0)
    assert drive.ideal
    assert drive([0.5, -0.25, 2.0]) == [0.5, -0.25, 1.0]


@needs_bullet
def test_errors_begin_when_the_hand_holds_the_object():
    """Grasps settle without errors: a friction 25 % too high, joint friction and bad motors give the
    start of the episode without them."""
    starts = []
    for errors in (
        {},
        {
            "controller": {"friction_error": 0.25},
            "motors": {"noise": 0.3, "gain_error": 0.3, "drift": 0.3, "friction": 0.2},
        },
    ):
        env = FourFingerGrasp(mass=0.3, friction=0.5, randomize={"mass": (0.29, 0.3)}, **errors)
        for _ in range(2):  # the second episode is not changed by the first one
            _, info = env.reset(seed=3)
            look = env.scene.look()
            starts.append(np.concatenate([look.angles, look.position, look.forces.ravel()]))
            env.step(ZERO)
        env.close()
        assert info["object_mass"] > 0.29
    for start in starts[1:]:
        np.testing.assert_array_equal(start, starts[0])


@needs_bullet
def test_the_friction_of_the_episode_is_that_of_the_joints():
    """A given one changes how the fingers move under the same push; a drawn one reaches the engine."""
    angles = []
    for friction in (0.0, 0.2):
        env = FourFingerGrasp(motors={"friction": friction}, disturbance="random")
        env.reset(seed=1)
        for _ in range(5):
            env.step(ZERO)
        angles.append(env.scene.look().angles.copy())
        env.close()
    assert np.abs(angles[1] - angles[0]).max() > 1e-5
    env = FourFingerGrasp(randomize={"motors.friction": (0.1, 0.3)})
    env.reset(seed=1)
    assert 0.1 < env.episode.motors.friction < 0.3
    assert env.scene._joint_friction == env.episode.motors.friction
    env.close()


@needs_bullet
@pytest.mark.parametrize("kind", ["optimized", "constant_squeeze", "pd"])
@pytest.mark.parametrize("engine", ["bullet", "mujoco"])
def test_wrong_friction_starts_with_every_controller(kind, engine):
    """The friction is assumed 25 % too high; the squeeze of 40 N and the springs do not use it."""
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    controller = {"kind": kind, "friction_error": 0.25}
    env = FourFingerGrasp(mass=0.3, friction=0.5, controller=controller, engine=engine)
    env.reset(seed=0)
    assert env._loop.friction == pytest.approx(0.85 * 0.5 * 1.25)
    assert not env.step(ZERO)[2]
    env.close()
