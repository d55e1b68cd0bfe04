"""Checkpoints of a training: everything that going on from them needs, in `policies.agent_files`' format."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize

from grasp_env.errors import InvalidInputError
from policies.agent_files import (
    ACTION_SIZES,
    OBSERVATION_SIZE,
    find_checkpoint,
    read_arrays,
    read_meta,
    read_tensors,
    write_checkpoint,
)
from training.rl.agent import arrays, restore, tensors
from training.rl.envs import first_seed
from training.rl.settings import RLConfig
from training.runs import provenance

FOLDER = "checkpoints"
_FREE = ("steps", "seed", "seeds", "episodes", "curve_points", "curve_episodes", "checkpoint_every", "quick")
"""Settings in which a resumed training may differ from its checkpoint: they do not change what is learned."""
_SPARE = 50_000_000
"""[bytes] of weights, logs and figures, besides the replay buffers."""


@dataclass
class Training:
    """One agent in training.

    Attributes:
        folder: of its seed: checkpoints and TensorBoard events.
        config: resolved.
        seed: of this training.
        agent: as `agent.build` makes it.
        envs: what it sees.
        seconds, cpu_seconds: spent on training.
        curve: of held-out scores so far.
    """

    folder: Path
    config: RLConfig
    seed: int
    agent: PPO | SAC
    envs: VecNormalize
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    curve: list[dict[str, Any]] = field(default_factory=list)

    def save(self) -> Path:
        """Writes a whole checkpoint under `<folder>/checkpoints`."""
        agent, config = self.agent, self.config
        meta = {
            "algorithm": config.algorithm,
            "action": config.action,
            "observation_size": OBSERVATION_SIZE,
            "action_size": ACTION_SIZES[config.action],
            "seed": self.seed,
            "config": asdict(config),
            "env_settings": config.env_settings,
            "provenance": provenance(),
            **{name: getattr(self, name) for name in _FACTS},
        }
        return write_checkpoint(
            self.folder / FOLDER, agent.num_timesteps, meta, tensors(agent), arrays(agent, self.envs)
        )

    def resume(self) -> None:
        """Restores the newest checkpoint of the folder; episodes start anew, from seeds not used before.

        Raises:
            ModelFileError: no whole checkpoint, or one that does not fit.
            InvalidInputError: it was trained with other settings.
        """
        found = find_checkpoint(self.folder)
        meta = check_settings(self.folder, self.config, self.seed)
        saved = {stem: read_tensors(found, meta, stem) for stem in ("policy", "optimiser")}
        stems = ("normaliser", "state", *(("replay",) if self.config.algorithm == "sac" else ()))
        saved |= {stem: read_arrays(found, meta, stem) for stem in stems}
        restore(self.agent, self.envs, saved, first_seed(self.seed, meta["steps"]))
        self.envs.seed(first_seed(self.seed, meta["steps"]))
        for name in _FACTS:
            setattr(self, name, meta[name])


_FACTS = ("seconds", "cpu_seconds", "curve")


def check_settings(folder: Path, config: RLConfig, seed: int) -> dict[str, Any]:
    """What the newest checkpoint of `folder` says of itself; raises as `Training.resume` does, before anything is changed."""
    found = find_checkpoint(folder)
    meta = read_meta(found)
    now = {**asdict(config), "env_settings": config.env_settings}
    before = {**meta["config"], "env_settings": meta["env_settings"]}
    wrong = {
        name: (before.get(name), value)
        for name, value in now.items()
        if name not in _FREE and before.get(name) != value
    }
    if wrong or meta["seed"] != seed:
        told = ", ".join(f"{name} {old!r}, now {new!r}" for name, (old, new) in wrong.items())
        raise InvalidInputError(
            f"{found} was trained with other settings ({told or 'another seed'}): give the same, or another --out"
        )
    return meta


def check_space(out: Path, config: RLConfig) -> None:
    """Refuses to start where the disk cannot take the checkpoints: two of the seed in training, one of each other.

    Raises:
        InvalidInputError: too little free space.
    """
    row = 4 * (2 * OBSERVATION_SIZE + ACTION_SIZES[config.action] + 3)
    buffer = min(config.buffer, config.steps) * row if config.algorithm == "sac" else 0
    need = _SPARE + buffer * (len(config.seeds) + 1)
    free = shutil.disk_usage(out).free
    if free < need:
        raise InvalidInputError(
            f"{out} has {free / 1e6:.0f} MB free, this training needs up to {need / 1e6:.0f} MB: free some, choose another --out, "
            "or a smaller --buffer"
        )
