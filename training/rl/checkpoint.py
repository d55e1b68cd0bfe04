"""Checkpoints that a training continues from, in the format of `policies.agent_files`."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize

from grasp_env.errors import InvalidInputError
from policies.agent_files import (
    find_checkpoint,
    read_arrays,
    read_meta,
    read_tensors,
    write_checkpoint,
)
from training.evaluation.results import provenance
from training.rl.agent import arrays, first_seed, restore
from training.rl.rl_config import RLConfig

FOLDER = "checkpoints"
_TENSORS = ("policy", "optimiser")
"""Parts written as safetensors; the others are npz."""
_FREE = (
    "steps",
    "seed",
    "seeds",
    "episodes",
    "curve_points",
    "curve_episodes",
    "checkpoint_every",
    "quick",
)
"""Settings that a resumed training may change, since they do not affect learning."""
_SPARE = 50_000_000
"""Size of weights, logs and figures, without replay buffers [bytes]."""


@dataclass
class Training:
    """Agent in training; as a `Policy` it acts deterministically on raw observations.

    Attributes:
        folder: folder of its seed, with checkpoints and TensorBoard events.
        config: resolved settings.
        seed: seed of this training.
        agent: agent from `agent.build`.
        envs: its environments.
        spent: (wall, processor) time spent on training [s].
        curve: rows of the episodes that scored the agent so far, with "training_steps".
    """

    folder: Path
    config: RLConfig
    seed: int
    agent: PPO | SAC
    envs: VecNormalize
    spent: np.ndarray = field(default_factory=lambda: np.zeros(2))
    curve: list[dict[str, Any]] = field(default_factory=list)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """See `Policy`."""
        normalised: Any = self.envs.normalize_obs(np.asarray(observation))
        return self.agent.predict(normalised, deterministic=deterministic)[0], state

    def save(self) -> Path:
        """Write a complete checkpoint under `<folder>/checkpoints`."""
        agent, config = self.agent, self.config
        seconds, cpu_seconds = self.spent.round(2).tolist()
        meta = {
            "algorithm": config.algorithm,
            "action": config.action,
            **config.sizes,
            "seed": self.seed,
            "config": asdict(config),
            "env_settings": config.env_settings,
            "provenance": provenance(),
            "updates": agent._n_updates,
            "episodes": agent._episode_num,
            "seconds": seconds,
            "cpu_seconds": cpu_seconds,
            "curve": self.curve,
        }
        others = arrays(agent, self.envs)
        tensors = {stem: others.pop(stem) for stem in _TENSORS}
        return write_checkpoint(self.folder / FOLDER, agent.num_timesteps, meta, tensors, others)

    def resume(self) -> None:
        """Restore the newest checkpoint; new episodes start, with seeds not used before.

        Raises:
            ModelFileError: no complete checkpoint, or one that does not fit.
            InvalidInputError: it was trained with other settings.
        """
        path = find_checkpoint(self.folder)
        meta = check_settings(self.folder, self.config, self.seed)
        stems = ["normaliser", *(["replay"] if self.config.algorithm == "sac" else [])]
        saved = {stem: read_tensors(path, meta, stem) for stem in _TENSORS}
        saved |= {stem: read_arrays(path, meta, stem) for stem in stems}
        agent = self.agent
        restore(agent, self.envs, saved)
        agent.num_timesteps = meta["steps"]
        agent._n_updates = meta["updates"]
        agent._episode_num = meta["episodes"]
        agent.set_random_seed(first_seed(self.seed, meta["steps"]))  # seeds the environments, too
        self.spent = np.array([meta["seconds"], meta["cpu_seconds"]])
        self.curve = meta["curve"]


def check_settings(folder: Path, config: RLConfig, seed: int) -> dict[str, Any]:
    """Return the newest checkpoint's metadata, or raise what `Training.resume` would."""
    path = find_checkpoint(folder)
    meta = read_meta(path)
    now = {**asdict(config), "env_settings": config.env_settings}
    before = {**meta["config"], "env_settings": meta["env_settings"]}
    changed = {
        name: value
        for name, value in now.items()
        if name not in _FREE and before.get(name) != value
    }
    if changed or meta["seed"] != seed:
        changes = ", ".join(
            f"{name} {before.get(name)!r}, now {value!r}" for name, value in changed.items()
        )
        raise InvalidInputError(
            f"{path} was trained with other settings ({changes or 'another seed'}): give the same, or another --out"
        )
    return meta


def check_space(out: Path, config: RLConfig) -> None:
    """Check that the disk has room for the checkpoints, two for every seed.

    Raises:
        InvalidInputError: too little free space.
    """
    row = 4 * (2 * config.sizes["observation_size"] + config.sizes["action_size"] + 3)
    buffer = min(config.buffer, config.steps) * row if config.algorithm == "sac" else 0
    need = _SPARE + 2 * buffer * len(config.seeds)
    free = shutil.disk_usage(out).free
    if free < need:
        raise InvalidInputError(
            f"{out} has {free / 1e6:.0f} MB free, this training needs up to {need / 1e6:.0f} MB: free some, choose another --out, "
            "or a smaller --buffer"
        )
