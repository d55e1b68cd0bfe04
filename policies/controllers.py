"""Controllers with stable-baselines3's `predict`, so that one evaluator scores all of them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from grasp_env.inputs.arguments import as_array, whole


class Policy(Protocol):
    """Protocol of `stable_baselines3.common.evaluation.evaluate_policy`: a `predict` method."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action(s) for an `observation`, and the `state` of a recurrent policy.

        `episode_start` marks the environments that were reset, and `deterministic` selects the mean
        action instead of a random one.
        """
        ...


class ZeroPolicy:
    """Policy that leaves the initial force to the environment's start rule, by default the paper's.

    Args:
        action_size: size of an action, `env.action_space.shape[0]`.

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
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return zeros, one row for each environment if `observation` is batched, and `state`.

        `episode_start` and `deterministic` have no effect.
        """
        shape = as_array(observation, None, "observation", finite=False).shape[:-1]
        return self._actions((*shape, self.action_size)), state

    def _actions(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        return np.zeros(shape, dtype=np.float32)


class RandomPolicy(ZeroPolicy):
    """Policy with uniform actions; its generator begins anew with each instance."""

    def __init__(self, action_size: int = 6) -> None:
        super().__init__(action_size)
        self._rng = np.random.default_rng(0)

    def _actions(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)
