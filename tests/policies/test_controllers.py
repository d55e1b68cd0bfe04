"""Controllers run under stable-baselines3's own evaluator."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from policies import ZeroPolicy


def test_zero_policy_under_evaluate_policy():
    env = Monitor(gym.make("grasp_env:FourFingerGrasp-v0", max_episode_steps=10))
    mean, deviation = evaluate_policy(ZeroPolicy(), env, n_eval_episodes=2)  # type: ignore[arg-type]
    assert 0.0 < mean < 10.0  # ten steps of at most one
    assert deviation == 0.0  # the constant wrench is deterministic
    env.close()


def test_shapes():
    action, state = ZeroPolicy().predict(np.zeros(59))
    assert action.shape == (6,)
    assert state is None
    assert ZeroPolicy().predict(np.zeros((3, 59)))[0].shape == (3, 6)
