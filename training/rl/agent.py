"""stable-baselines3 agents that start near the zero policy, and their state as arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from grasp_env.env.env import FourFingerGrasp
from grasp_env.errors import InvalidInputError, ModelFileError
from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp
from policies.agent_files import ENV_ID
from training.rl.rl_config import RLConfig

_WIDTHS = [64, 64]
_MEAN_GAIN = 0.01
"""Gain of the mean action's last layer: stable-baselines3's for PPO, also used for SAC."""
LAST = 0.1
"""Learning rate of PPO at the end, as a share of that at the beginning."""
_SQUEEZE, _INSIDE = 0.75, 0.999
"""Largest resting force as a share of what is allowed, and largest resting action: the tanh of SAC
never reaches 1."""
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_MOMENTS = ("mean", "var", "count")
Arrays = dict[str, dict[str, np.ndarray]]


def make_envs(settings: dict[str, Any], count: int, gamma: float) -> VecNormalize:
    """Make parallel environments with normalised observations and rewards, not yet seeded.

    They run in one process: sending the data of a step costs almost as much as the step (4
    environments on two cores: 912 steps/s in one process, 844 in four; 8 environments: 737, 820).

    Rewards are not clipped. `VecNormalize` does not subtract their mean: with a discount of 0 they
    exceed its default clip at 10 and would all be equal.

    Args:
        settings: settings of the environment, as from `EnvConfig.to_dict`.
        count: number of environments.
        gamma: discount of the return whose deviation scales rewards.
    """
    envs = make_vec_env(
        f"grasp_env:{ENV_ID}",
        count,
        env_kwargs={"render_mode": None, "config": settings},
        monitor_kwargs={"info_keywords": ("is_success",)},
    )
    return VecNormalize(envs, gamma=gamma, clip_reward=np.inf)


def first_seed(seed: int, steps: int) -> int:
    """Return the first environment's seed after `steps`, in [2**30, 2**31); the others follow.

    A resumed training sees new episodes, and no training sees the episodes that score agents.
    """
    state = int(np.random.SeedSequence([seed, steps]).generate_state(1)[0])
    return 2**30 + state % (2**30 - 2**10)


def resting_action(env: FourFingerGrasp) -> np.ndarray:
    """Return the action (3N,) of the mode "contact_force" that holds the object at rest.

    To the least forces that balance the weight it adds the optimal squeeze without a load, until one
    force reaches `_SQUEEZE` of the largest: lighter ones slip at the first disturbance.

    Raises:
        InvalidInputError: actions in [-1, 1] cannot hold the object.
    """
    _, info = env.reset(seed=0)
    seen = env.scene.look()
    item = env.episode.object
    soft = {"contact_model": "soft", "torsional_friction": item.torsional_friction}
    model = soft if item.torsional_friction > 0.0 else {}
    grasp = Grasp.from_contacts(seen.points, seen.normals, info["object_friction"], **model)
    # the weight alone: a disturbance may act from the first tick on
    weight = np.zeros(6)
    weight[:3] = info["object_mass"] * env.scene.gravity @ seen.rotation
    least = -np.linalg.pinv(grasp.matrix) @ weight
    squeeze = optimize_force(grasp, np.zeros(6)).force.reshape(-1)
    scale = env.config.agent.action_scale
    most = min(2.0 * scale, env.config.limits.max_force or np.inf)
    force = least + ((_SQUEEZE * most - least[::3]) / squeeze[::3]).min() * squeeze
    action = force / scale
    action[::3] -= 1.0
    if grasp.cone_margin(force.reshape(-1, 3)) <= 0.0 or np.abs(action).max() > 1.0:
        raise InvalidInputError(
            f"forces of at most {most:g} N, by agent.action_scale {scale:g} N and limits.max_force {env.config.limits.max_force}, do not hold the "
            "object at rest: raise them, or make it lighter"
        )
    return action.clip(-_INSIDE, _INSIDE)


def build(config: RLConfig, envs: VecNormalize, seed: int) -> PPO | SAC:
    """Make an untrained agent with the exploration `config.deviation`.

    Its mean action is nearly zero, or nearly the resting one if it sets the contact forces: with
    zeros, equal forces, the object leaves the hand at once and there is nothing to learn from.
    """
    torch.set_num_threads(1)  # more threads do not help networks this small
    shape: Any = envs.action_space.shape
    start = np.zeros(shape)
    if config.action == "contact_force":
        plain: Any = envs.venv
        start = resting_action(plain.envs[0].unwrapped)
    common: Any = {
        "gamma": config.gamma,
        "seed": seed,
        "device": "cpu",
    }
    if config.algorithm == "ppo":
        # steps of an environment: eight batches
        rollout = 8 * max(config.rollout // config.envs // 8, 1)
        policy = {"net_arch": _WIDTHS, "log_std_init": math.log(config.deviation)}
        options = {"n_steps": rollout, "batch_size": rollout * config.envs // 8, "n_epochs": 10}
        agent = PPO(
            "MlpPolicy",
            envs,
            learning_rate=lambda left: (LAST + (1.0 - LAST) * left) * config.learning_rate,
            policy_kwargs=policy,
            **options,
            **common,
        )
        with torch.no_grad():
            agent.policy.action_net.bias.copy_(torch.as_tensor(start))  # type: ignore[operator, union-attr]
        return agent
    # entropy of a normal distribution with that deviation; SAC's temperature keeps the exploration
    # there
    entropy = math.log(config.deviation * math.sqrt(2.0 * math.pi * math.e))
    agent = SAC(
        "MlpPolicy",
        envs,
        learning_rate=config.learning_rate,
        buffer_size=config.buffer,
        learning_starts=config.warmup,
        batch_size=256,
        train_freq=1,
        gradient_steps=max(config.envs // 2, 1),
        ent_coef="auto_0.01",
        tau=0.01,
        target_entropy=entropy * shape[0],
        policy_kwargs={"net_arch": _WIDTHS},
        **common,
    )
    with torch.no_grad():
        torch.nn.init.orthogonal_(agent.actor.mu.weight, _MEAN_GAIN)  # type: ignore[arg-type]
        agent.actor.mu.bias.copy_(torch.as_tensor(np.arctanh(start)))  # type: ignore[operator, union-attr]
        agent.actor.log_std.weight.mul_(_MEAN_GAIN)  # type: ignore[operator, union-attr]
        agent.actor.log_std.bias.fill_(math.log(config.deviation))  # type: ignore[operator, union-attr]
    return agent


def arrays(agent: PPO | SAC, envs: VecNormalize) -> Arrays:
    """Return "policy", "optimiser", "normaliser" and, of SAC, "replay" as arrays by name."""
    parameters = agent.get_parameters()
    out: dict[str, dict[str, Any]] = {"policy": parameters.pop("policy")}
    out["optimiser"] = {
        f"{name}/{index}/{key}": value
        for name, optimiser in parameters.items()
        for index, values in optimiser["state"].items()
        for key, value in values.items()
    }
    out["normaliser"] = {"epsilon": envs.epsilon, "clip": envs.clip_obs}
    for prefix, running in _running(envs).items():
        out["normaliser"] |= {f"{prefix}{name}": getattr(running, name) for name in _MOMENTS}
    if isinstance(agent, SAC):
        replay: Any = agent.replay_buffer
        out["optimiser"]["log_ent_coef"] = agent.log_ent_coef
        filled = replay.buffer_size if replay.full else replay.pos
        out["replay"] = {name: getattr(replay, name)[:filled] for name in _REPLAY}
        out["replay"] |= {"pos": replay.pos, "full": replay.full}
    return {
        stem: {name: _array(value) for name, value in values.items()}
        for stem, values in out.items()
    }


def restore(agent: PPO | SAC, envs: VecNormalize, saved: Arrays) -> None:
    """Restore the state from `arrays` in an agent that `build` made with the same settings.

    Raises:
        ModelFileError: names or shapes do not fit.
    """
    try:
        parameters: Any = agent.get_parameters()
        state = _tensors(saved["optimiser"])
        if isinstance(agent, SAC):
            replay: Any = agent.replay_buffer
            agent.log_ent_coef.data.copy_(state.pop("log_ent_coef"))  # type: ignore[union-attr]
            for name in _REPLAY:
                getattr(replay, name)[: len(saved["replay"][name])] = saved["replay"][name]
            replay.pos, replay.full = int(saved["replay"]["pos"]), bool(saved["replay"]["full"])
        parameters["policy"] = _tensors(saved["policy"])
        for path, value in state.items():
            name, index, key = path.split("/")
            parameters[name]["state"].setdefault(int(index), {})[key] = value
        agent.set_parameters(parameters)
        for prefix, running in _running(envs).items():
            mean, var, count = (saved["normaliser"][f"{prefix}{name}"] for name in _MOMENTS)
            if mean.shape != running.mean.shape:
                raise ValueError(
                    f"normaliser of {mean.shape}, observations of {running.mean.shape}"
                )
            running.mean, running.var, running.count = mean, var, float(count)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
        raise ModelFileError(
            f"the checkpoint does not fit the agent ({error}): train anew with `grasp rl`"
        ) from None


def _running(envs: VecNormalize) -> dict[str, Any]:
    """Return the running means and variances of observations and of returns, by their prefixes."""
    return {"": envs.obs_rms, "return_": envs.ret_rms}


def _tensors(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(value.copy()) for name, value in arrays.items()}


def _array(value: Any) -> np.ndarray:
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy().copy()
    return np.asarray(value)
