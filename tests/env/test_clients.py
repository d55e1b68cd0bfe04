"""What other people's code asks of the environment: Gymnasium's wrappers, stable-baselines3's checker, torchrl, videos."""

from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import SimulationError

ID = "grasp_env:FourFingerGrasp-v0"
ZERO = np.zeros(6, dtype=np.float32)


def test_sb3_check_with_rendering() -> None:
    env = FourFingerGrasp(render_mode="rgb_array", pictures={"size": (64, 48)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=False)  # closes it and goes on
    env.close()


def test_a_closed_environment_opens_anew() -> None:
    env = FourFingerGrasp(render_mode="rgb_array", pictures={"size": (64, 48)}, disturbance="random")
    fresh = env.reset(seed=3)[0], env.step(ZERO)[0], env.render()
    env.close()
    with pytest.raises(SimulationError, match=r"closed: call reset\(\)"):
        env.step(ZERO)
    again = env.reset(seed=3)[0], env.step(ZERO)[0], env.render()
    for one, other in zip(fresh, again, strict=True):
        np.testing.assert_array_equal(one, other)
    env.close()


@pytest.mark.parametrize(("settings", "steps"), [({}, 100), ({"duration": 0.2}, 10), ({"task": "payload"}, 200)])
def test_the_spec_says_how_long_an_episode_is(settings: dict[str, object], steps: int) -> None:
    env = gym.make(ID, **settings)
    assert env.spec is not None
    assert env.spec.max_episode_steps == steps
    assert not isinstance(env, gym.wrappers.TimeLimit)
    env.close()


def test_what_remains_of_an_episode_can_be_observed() -> None:
    env = gym.wrappers.TimeAwareObservation(gym.make(ID, duration=0.2), normalize_time=True)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    for step in range(10):
        observed, _, terminated, truncated, _ = env.step(ZERO)
        assert observed[-1] == pytest.approx((step + 1) / 10)
        assert (terminated, truncated) == (False, step == 9)
    env.close()


def test_made_again_from_its_spec() -> None:
    made = gym.make(ID, duration=0.1)
    assert made.spec is not None
    made.close()
    env = gym.make(made.spec)
    env.reset(seed=0)
    assert [env.step(ZERO)[3] for _ in range(5)] == [False] * 4 + [True]
    env.close()


def test_videos(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env = gym.make(ID, duration=0.1, render_mode="rgb_array", pictures={"size": (64, 48)})
    env = gym.wrappers.RecordVideo(env, str(tmp_path / "videos"), disable_logger=True)
    env.reset(seed=0)
    for _ in range(5):
        env.step(ZERO)
    env.close()
    (video,) = (tmp_path / "videos").glob("*.mp4")
    assert video.stat().st_size > 500


def test_torchrl() -> None:
    gym_env = pytest.importorskip("torchrl.envs.libs.gym").GymEnv
    env = gym_env(ID, frame_skip=2, duration=0.2)
    assert env.rollout(20).batch_size[0] == 5
    env.close()
