"""Loop over an episode, shared by demos, recordings and the scoring of agents."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from policies.controllers import Policy


class EpisodeStep(NamedTuple):
    """Result of an environment step; `last` is true if it ended the episode."""

    reward: float
    info: dict[str, Any]
    last: bool


def episode(
    env: gym.Env[Any, Any], seed: int, policy: Policy | None = None, most: int | None = None
) -> Iterator[EpisodeStep]:
    """Reset the environment at once and return an iterator that steps it.

    Args:
        env: any environment; the caller closes it.
        seed: seed of the episode.
        policy: the agent, acting deterministically; None: zero actions.
        most: largest number of steps; None: the environment ends the episode.
    """
    observation, _ = env.reset(seed=seed)
    return _steps(env, observation, policy, most)


def _steps(
    env: gym.Env[Any, Any], observation: Any, policy: Policy | None, most: int | None
) -> Iterator[EpisodeStep]:
    action: Any = np.zeros(env.action_space.shape or (1,), dtype=np.float32)
    for _ in count() if most is None else range(most):
        if policy is not None:
            action, _ = policy.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, info = env.step(action)
        last = bool(terminated or truncated)
        yield EpisodeStep(float(reward), info, last)
        if last:
            return
