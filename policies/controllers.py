"""Controllers with stable-baselines3's `predict`, so that one evaluator scores the paper, a learned start, an agent."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import as_array, whole


class Policy(Protocol):
    """What `stable_baselines3.common.evaluation.evaluate_policy` needs: `predict`, as its agents have."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """The action(s) for an `observation`, and the `state` of recurrent ones.

        `episode_start` says which of several environments have begun anew, `deterministic` asks for the mean instead of a draw.
        """
        ...


class ZeroPolicy:
    """No adjustment of the initial force: the environment's own start rule, the paper's by default.

    Args:
        action_size: numbers of an action, `env.action_space.shape[0]`.

    Example:
        >>> action, _ = ZeroPolicy(6).predict(np.zeros(83))
        >>> action
        array([0., 0., 0., 0., 0., 0.], dtype=float32)
    """

    def __init__(self, action_size: int = 6) -> None:
        self.action_size = whole(action_size, "action_size", 1, 10_000)

    def __repr__(self) -> str:
        return f"ZeroPolicy({self.action_size})"

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], Any]:
        """Zeros of the action's shape, one row per environment where `observation` is batched, and `state`.

        `episode_start` and `deterministic` change nothing.
        """
        shape = as_array(observation, None, "observation", finite=False).shape[:-1]
        return np.zeros((*shape, self.action_size), dtype=np.float32), state
