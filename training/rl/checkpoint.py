"""Checkpoints of a training: everything that going on from them needs, in `policies.agent_files`' format."""

from __future__ import annotations

import shutil
from dataclasses import asdict
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


def save(
    folder: Path, agent: PPO | SAC, envs: VecNormalize, config: RLConfig, seed: int, facts: dict[str, Any]
) -> Path:
    """Writes a whole checkpoint under `<folder>/checkpoints`.

    Args:
        folder: of this seed.
        agent, envs: what is saved.
        config: resolved.
        seed: of this training.
        facts: "seconds" and "cpu_seconds" spent and the "curve" so far.
    """
    meta = {
        "algorithm": config.algorithm,
        "action": config.action,
        "observation_size": OBSERVATION_SIZE,
        "action_size": ACTION_SIZES[config.action],
        "seed": seed,
        "config": asdict(config),
        "env_settings": config.env_settings,
        "provenance": provenance(),
        **facts,
    }
    return write_checkpoint(folder / FOLDER, agent.num_timesteps, meta, tensors(agent), arrays(agent, envs))


def resume(folder: Path, agent: PPO | SAC, envs: VecNormalize, config: RLConfig, seed: int) -> dict[str, Any]:
    """Restores the newest checkpoint of `folder`; episodes start anew, from seeds not used before.

    Returns:
        What the checkpoint says of itself.

    Raises:
        ModelFileError: no whole checkpoint, or one that does not fit.
        InvalidInputError: it was trained with other settings.
    """
    found = find_checkpoint(folder)
    meta = check_settings(folder, config, seed)
    saved = {stem: read_tensors(found, meta, stem) for stem in ("policy", "optimiser")}
    stems = ("normaliser", "state", *(("replay",) if config.algorithm == "sac" else ()))
    saved |= {stem: read_arrays(found, meta, stem) for stem in stems}
    restore(agent, envs, saved, first_seed(seed, meta["steps"]))
    envs.seed(first_seed(seed, meta["steps"]))
    return meta


def check_settings(folder: Path, config: RLConfig, seed: int) -> dict[str, Any]:
    """What the newest checkpoint of `folder` says of itself; raises as `resume` does, before anything is changed."""
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
