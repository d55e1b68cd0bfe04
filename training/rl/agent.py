"""stable-baselines3 agents that start as the zero policy, and their state as plain arrays, both ways."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from grasp_env.errors import ModelFileError
from training.rl.settings import RLConfig

_WIDTHS = [64, 64]
_MEAN_GAIN = 0.01
"""Of the last layer that gives the mean action: 0.01 is stable-baselines3's for PPO; SAC's is scaled to the same."""


def build(config: RLConfig, envs: VecNormalize, seed: int) -> PPO | SAC:
    """An untrained agent whose mean action is nearly zero and whose exploration is `config.deviation`."""
    torch.set_num_threads(1)  # for networks this small more threads gain nothing
    common: dict[str, Any] = {
        "learning_rate": config.learning_rate, "gamma": config.gamma, "seed": seed, "device": "cpu",
    }  # fmt: skip
    if config.algorithm == "ppo":
        rollout = max(config.rollout // config.envs // 8, 1) * 8  # of each environment, so that eight batches divide it
        policy = {"net_arch": _WIDTHS, "log_std_init": math.log(config.deviation)}
        size = rollout * config.envs // 8
        return PPO("MlpPolicy", envs, n_steps=rollout, batch_size=size, n_epochs=10, policy_kwargs=policy, **common)
    agent = SAC(
        "MlpPolicy", envs, buffer_size=config.buffer, learning_starts=config.warmup, batch_size=256,
        train_freq=1, gradient_steps=max(config.envs // 2, 1), ent_coef="auto_0.01", tau=0.01,
        target_entropy=_entropy(config.deviation) * envs.action_space.shape[0],  # type: ignore[index]
        policy_kwargs={"net_arch": _WIDTHS}, **common,
    )  # fmt: skip
    with torch.no_grad():
        torch.nn.init.orthogonal_(agent.actor.mu.weight, _MEAN_GAIN)  # type: ignore[arg-type]
        agent.actor.mu.bias.zero_()  # type: ignore[operator, union-attr]
        agent.actor.log_std.weight.mul_(_MEAN_GAIN)  # type: ignore[operator, union-attr]
        agent.actor.log_std.bias.fill_(math.log(config.deviation))  # type: ignore[operator, union-attr]
    return agent


def tensors(agent: BaseAlgorithm) -> dict[str, dict[str, np.ndarray]]:
    """Weights ("policy") and optimisers ("optimiser") by name."""
    weights = {name: _array(value) for name, value in agent.policy.state_dict().items()}
    state: dict[str, np.ndarray] = {}
    for name, optimiser in _optimisers(agent).items():
        for place, values in optimiser.state_dict()["state"].items():
            state.update({f"{name}.{place}.{key}": _array(value) for key, value in values.items()})
    entropy = getattr(agent, "log_ent_coef", None)
    if entropy is not None:
        state["log_ent_coef"] = _array(entropy)
    return {"policy": weights, "optimiser": state}


def arrays(agent: BaseAlgorithm, envs: VecNormalize) -> dict[str, dict[str, np.ndarray]]:
    """Normaliser, counters, random states ("normaliser", "state") and, of SAC, the replay buffer ("replay")."""
    seen: Any = envs.obs_rms
    normaliser = {
        "mean": seen.mean, "var": seen.var, "count": seen.count, "epsilon": envs.epsilon, "clip": envs.clip_obs,
        "return_mean": envs.ret_rms.mean, "return_var": envs.ret_rms.var, "return_count": envs.ret_rms.count,
    }  # fmt: skip
    _, keys, place, has_normal, normal = np.random.get_state()  # noqa: NPY002 - stable-baselines3 draws from it
    state = {
        "num_timesteps": agent.num_timesteps, "n_updates": agent._n_updates, "episodes": agent._episode_num,
        "torch": torch.get_rng_state().numpy(), "numpy": keys, "numpy_place": place, "numpy_has_normal": has_normal,
        "numpy_normal": normal,
    }  # fmt: skip
    out = {"normaliser": _as_arrays(normaliser), "state": _as_arrays(state)}
    replay: Any = getattr(agent, "replay_buffer", None)
    if replay is not None:
        filled = replay.buffer_size if replay.full else replay.pos
        out["replay"] = {name: getattr(replay, name)[:filled] for name in _REPLAY}
        out["replay"]["pos"], out["replay"]["full"] = np.array(replay.pos), np.array(replay.full)
    return out


_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def restore(agent: PPO | SAC, envs: VecNormalize, saved: dict[str, dict[str, np.ndarray]], action_seed: int) -> None:
    """Puts what `tensors` and `arrays` gave back into an agent that `build` made of the same settings.

    Args:
        agent: receives weights, optimisers, counters and replay buffer.
        envs: receives the normaliser.
        saved: by "policy", "optimiser", "normaliser", "state", "replay".
        action_seed: of actions drawn at random.

    Raises:
        ModelFileError: names or shapes that do not fit.
    """
    try:
        agent.policy.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in saved["policy"].items()})
        for name, optimiser in _optimisers(agent).items():
            _restore_optimiser(optimiser, name, saved["optimiser"])
        if isinstance(agent, SAC) and agent.log_ent_coef is not None:
            with torch.no_grad():
                agent.log_ent_coef.copy_(torch.from_numpy(saved["optimiser"]["log_ent_coef"].copy()))
            _restore_replay(agent.replay_buffer, saved["replay"])
        normaliser, state = saved["normaliser"], saved["state"]
        seen: Any = envs.obs_rms
        if normaliser["mean"].shape != seen.mean.shape:
            raise ValueError(f"normaliser of {normaliser['mean'].shape}, observations of {seen.mean.shape}")
        seen.mean, seen.var, seen.count = normaliser["mean"], normaliser["var"], float(normaliser["count"])
        rewards = envs.ret_rms
        rewards.mean, rewards.var = normaliser["return_mean"], normaliser["return_var"]
        rewards.count = float(normaliser["return_count"])
        agent.num_timesteps, agent._n_updates = int(state["num_timesteps"]), int(state["n_updates"])
        agent._episode_num = int(state["episodes"])
        agent.action_space.seed(action_seed)
        random.seed(action_seed)
        torch.set_rng_state(torch.from_numpy(state["torch"].copy()))
        place, has_normal = int(state["numpy_place"]), int(state["numpy_has_normal"])
        drawn = ("MT19937", state["numpy"], place, has_normal, float(state["numpy_normal"]))
        np.random.set_state(drawn)  # noqa: NPY002
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
        raise ModelFileError(f"the checkpoint does not fit the agent ({error}): train anew with `grasp rl`") from None


def _optimisers(agent: BaseAlgorithm) -> dict[str, torch.optim.Optimizer]:
    if isinstance(agent, SAC):
        assert agent.ent_coef_optimizer is not None
        return {"actor": agent.actor.optimizer, "critic": agent.critic.optimizer, "entropy": agent.ent_coef_optimizer}
    return {"policy": agent.policy.optimizer}


def _restore_optimiser(optimiser: torch.optim.Optimizer, name: str, saved: dict[str, np.ndarray]) -> None:
    blank = optimiser.state_dict()
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in saved.items():
        owner, *rest = key.split(".")
        if owner == name:
            state.setdefault(int(rest[0]), {})[rest[1]] = torch.from_numpy(value.copy())
    optimiser.load_state_dict({**blank, "state": state})


def _restore_replay(replay: Any, saved: dict[str, np.ndarray]) -> None:
    for name in _REPLAY:
        getattr(replay, name)[: len(saved[name])] = saved[name]
    replay.pos, replay.full = int(saved["pos"]), bool(saved["full"])


def _entropy(deviation: float) -> float:
    """Of one normal action component of that deviation: what SAC's temperature aims at, so that exploration stays there."""
    return math.log(deviation * math.sqrt(2.0 * math.pi * math.e))


def _array(value: torch.Tensor) -> np.ndarray:
    return value.detach().cpu().numpy().copy()


def _as_arrays(values: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in values.items()}
