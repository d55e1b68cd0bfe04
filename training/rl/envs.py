"""Training environments: several hands in one process, monitored, with a running normaliser.

One process, because a process each was no faster on two cores (steps/s: 4 environments 912 in one process, 844 in four; 8
environments 737 and 820, another program running beside them; a step took 1 ms then): sending what it shows costs not much less.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from policies.agent_files import ENV_ID

KEYWORDS = ("is_success",)
"""What `Monitor` keeps of an episode's last info; stable-baselines3 logs its success rate."""


def make_envs(settings: dict[str, Any], count: int, gamma: float) -> VecNormalize:
    """Environments side by side behind a normaliser of observations and rewards; to be seeded with `first_seed`.

    Args:
        settings: of the environment.
        count: how many.
        gamma: discount of the return whose deviation scales rewards.
    """
    return VecNormalize(DummyVecEnv([_maker(settings)] * count), gamma=gamma)


def first_seed(seed: int, steps: int) -> int:
    """In [2**30, 2**31): of the first environment, where so many steps are taken; the next ones follow.

    A resumed training sees other episodes than those before, and no training sees those that score agents.
    """
    state = int(np.random.SeedSequence([seed, steps]).generate_state(1)[0])
    return 2**30 + state % (2**30 - 2**10)


def _maker(settings: dict[str, Any]) -> Callable[[], gym.Env[Any, Any]]:
    def make() -> gym.Env[Any, Any]:
        return Monitor(gym.make(f"grasp_env:{ENV_ID}", **settings), info_keywords=KEYWORDS)

    return make
