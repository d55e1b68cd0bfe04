"""`TrainedAgent`: a saved reinforcement-learning agent as a `Policy`, run by numpy without torch."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grasp_env.errors import InvalidInputError, ModelFileError
from grasp_env.inputs.arguments import as_array, generator
from policies.agent_files import find_checkpoint, read_arrays, read_meta, read_tensors

NAMES = {
    "ppo": ("mlp_extractor.policy_net", "action_net", np.tanh),
    "sac": ("actor.latent_pi", "actor.mu", lambda x: np.maximum(x, 0.0)),
}
"""Hidden layers, last layer and activation of stable-baselines3's policies, by algorithm."""


class TrainedAgent:
    """An agent trained by `grasp rl`: predict(observation of the environment) -> (action, state).

    Observations are normalised with the running means and variances of training. The agent
    requires the extra "sim", but neither torch nor stable-baselines3, whose `evaluate_policy`
    accepts it as a model.

    Attributes:
        meta: algorithm, action mode, steps, seed, versions, and `env_settings`, the `config` of its
            environment.

    Args:
        meta: description of the checkpoint.
        weights: arrays of the policy, by stable-baselines3's names.
        normaliser: "mean", "var" (observation,), "epsilon", "clip".
        seed: seed of random actions.

    Example:
        >>> import tempfile
        >>> import gymnasium as gym
        >>> from training.rl.rl_config import RLConfig
        >>> from training.rl.train import train_seed  # what `grasp rl` does for each of its seeds
        >>> config = RLConfig(steps=64, envs=2, rollout=32, curve_points=1, curve_episodes=1).resolved()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = train_seed(config, Path(folder) / "seed-0", seed=0, resume=False)
        ...     agent = TrainedAgent.load(f"{folder}/seed-0")
        >>> agent.meta["algorithm"], agent.meta["action"], agent.meta["steps"]
        ('ppo', 'initial_force', 64)
        >>> env = gym.make("grasp_env:FourFingerGrasp-v0", config=agent.meta["env_settings"])
        >>> observation, info = env.reset(seed=0)
        >>> action, _ = agent.predict(observation)
        >>> action.shape, bool(abs(action).max() <= 1.0)
        ((6,), True)
        >>> env.close()
    """

    def __init__(
        self,
        meta: dict[str, Any],
        weights: dict[str, np.ndarray],
        normaliser: dict[str, np.ndarray],
        seed: int = 0,
    ) -> None:
        self.meta = meta
        self._rng = generator(seed)
        self._mean = normaliser["mean"]
        self._scale = 1.0 / np.sqrt(normaliser["var"] + float(normaliser["epsilon"]))
        self._clip = float(normaliser["clip"])
        hidden, last, self._activation = NAMES[meta["algorithm"]]
        self._squashed = meta["algorithm"] == "sac"
        layers = [name for name in weights if name.startswith(hidden) and name.endswith(".weight")]
        layers.sort(key=lambda name: int(name.split(".")[-2]))
        self._hidden = [
            (weights[name].T, weights[name.removesuffix("weight") + "bias"]) for name in layers
        ]
        self._last = weights[f"{last}.weight"].T, weights[f"{last}.bias"]
        if self._squashed:
            self._deviation: Any = weights["actor.log_std.weight"].T, weights["actor.log_std.bias"]
        else:
            self._deviation = weights["log_std"]
        sizes = [len(self._mean), *(bias.shape[0] for _, bias in (*self._hidden, self._last))]
        shapes = [weight.shape for weight, _ in (*self._hidden, self._last)]
        ends = meta["observation_size"], meta["action_size"]
        if shapes != list(pairwise(sizes)) or (sizes[0], sizes[-1]) != ends:
            raise ValueError(
                f"layer shapes {shapes} do not chain from {ends[0]} observations to {ends[1]} actions"
            )
        if not all(np.isfinite(a).all() for layer in (*self._hidden, self._last) for a in layer):
            raise ValueError("weights are not finite")

    def __repr__(self) -> str:
        return f"TrainedAgent({self.meta['algorithm']}, {self.meta['observation_size']} numbers to {self.meta['action_size']} actions)"

    @classmethod
    def load(cls, folder: str | Path, seed: int = 0) -> TrainedAgent:
        """Load the newest checkpoint of a seed's folder of `grasp rl`, or a checkpoint folder.

        Raises:
            ModelFileError: files are missing, damaged, or for another schema or environment.
        """
        folder = find_checkpoint(folder)
        meta = read_meta(folder)
        weights = read_tensors(folder, meta, "policy")
        normaliser = read_arrays(folder, meta, "normaliser")
        try:
            return cls(meta, weights, normaliser, seed)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ModelFileError(
                f"agent {folder}: incomplete or malformed ({error}): train anew with `grasp rl`"
            ) from None

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action(s) in [-1, 1] for observations (size,) or (n, size), and `state`.

        Args:
            observation: observation of the environment.
            state: returned unchanged, because an agent has no memory.
            episode_start: ignored.
            deterministic: True for the mean action, False for a random one, as in training.

        Raises:
            InvalidInputError: the observation has another size.
        """
        values = as_array(observation, None, "observation")
        if values.shape[-1:] != self._mean.shape or values.ndim not in (1, 2):
            raise InvalidInputError(
                f"observation must be ({len(self._mean)},) or (n, {len(self._mean)}), got shape {values.shape}"
            )
        x = np.clip((values - self._mean) * self._scale, -self._clip, self._clip).astype(np.float32)
        for weight, bias in self._hidden:
            x = self._activation(x @ weight + bias)
        action = x @ self._last[0] + self._last[1]
        if not deterministic:
            log = self._deviation
            log = np.clip(x @ log[0] + log[1], -20.0, 2.0) if self._squashed else log
            action = action + np.exp(log) * self._rng.standard_normal(action.shape)
        action = np.tanh(action) if self._squashed else np.clip(action, -1.0, 1.0)
        return action.astype(np.float32), state
