"""The loop of an episode, once: what demos show, what trials record and what scores agents."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from policies.controllers import Policy


class Step(NamedTuple):
    """What a step of the environment gave; `last` where it ended the episode."""

    reward: float
    info: dict[str, Any]
    last: bool


def episode(env: gym.Env[Any, Any], seed: int, policy: Policy | None = None, most: int | None = None) -> Iterator[Step]:
    """Resets at once, and steps as it is asked for the steps.

    Args:
        env: of any kind; whoever made it closes it.
        seed: of the episode.
        policy: the agent, deterministic; None: zeros, which adjust nothing.
        most: steps, after which it ends all the same; None: the environment decides.
    """
    observation, _ = env.reset(seed=seed)
    return _steps(env, observation, policy, most)


def _steps(env: gym.Env[Any, Any], observation: Any, policy: Policy | None, most: int | None) -> Iterator[Step]:
    action: Any = np.zeros(env.action_space.shape or (1,), dtype=np.float32)
    for _ in count() if most is None else range(most):
        if policy is not None:
            action, _ = policy.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, info = env.step(action)
        last = bool(terminated or truncated)
        yield Step(float(reward), info, last)
        if last:
            return
