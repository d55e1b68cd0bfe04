"""Environments with a name of their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from grasp_env._spec import IDS
from grasp_env.config import EnvConfig
from grasp_env.env.named import PROBLEMS

NAMED = [name for name in IDS if name.removesuffix("-v0") in PROBLEMS]


def length(env: Any) -> int:
    """Return the number of steps of an episode with zero actions."""
    env.reset(seed=0)
    steps = 0
    ended = False
    while not ended:
        *_, lost, over, _ = env.step(np.zeros(env.action_space.shape, np.float32))
        ended = lost or over
        steps += 1
    return steps


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", NAMED)
def test_an_episode_and_its_specification(name):
    env: Any = gym.make(f"grasp_env:{name}")
    assert (gym.spec(name).max_episode_steps, env.spec.max_episode_steps) == (200, 200)
    assert type(env.unwrapped).__name__ == name.removesuffix("-v0")
    assert env.unwrapped.config.engine.rate == env.unwrapped.config.controller.rate == 1000
    assert length(env) == 200
    again: Any = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    again.close()
    env.close()


@pytest.mark.parametrize("name", NAMED)
@pytest.mark.parametrize("given", [{"duration": 0.2}, {"max_episode_steps": 10}])
def test_the_length_can_be_chosen(name, given):
    env: Any = gym.make(f"grasp_env:{name}", **given, **{"sensors.delay": 0.0})
    config = env.unwrapped.config
    assert (length(env), env.spec.max_episode_steps) == (10, 10)
    assert (config.sensors.delay, config.sensors.wrench) == (0.0, "estimated")
    env.close()


@pytest.mark.filterwarnings("ignore:.*render")
@pytest.mark.parametrize("name", NAMED)
def test_gymnasium_finds_no_fault(name):
    env: Any = gym.make(f"grasp_env:{name}", duration=0.1).unwrapped
    check_env(env, skip_render_check=True)
    env.close()


def test_a_config_replaces_the_problem():
    env: Any = gym.make("grasp_env:UncertainGrasp-v0", config=EnvConfig(), mass=0.3)
    assert not env.unwrapped.config.randomize
    assert env.unwrapped.config.object.mass == 0.3
    env.close()


def test_an_entry_under_another_name():
    """A user's own entry in the registry, made from ours."""
    ours = gym.spec("FourFingerGrasp-v0")
    env: Any = gym.make(replace(ours, id="Heavy-v0", kwargs={"mass": 0.3}, max_episode_steps=20))
    assert env.unwrapped.config.object.mass == 0.3
    assert (length(env), env.spec.max_episode_steps) == (20, 20)
    env.close()
