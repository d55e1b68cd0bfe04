"""Agents and other policies: actions against numpy written out, files that are refused,
stable-baselines3's evaluator."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from grasp_env.env.actions import MODES
from grasp_env.env.observation import bounds
from grasp_env.errors import InvalidInputError, ModelFileError
from policies import TrainedAgent, ZeroPolicy
from policies.agent import NAMES
from policies.agent_files import META, checkpoints, write_checkpoint

SEEN = len(bounds(4, 12))
ACTIONS = MODES["initial_force"].size(4)
META_DATA = {
    "action": "initial_force",
    "fingers": 4,
    "joints": 12,
    "observation_size": SEEN,
    "action_size": ACTIONS,
}
NORMALISER = {
    "mean": np.full(SEEN, 0.5),
    "var": np.full(SEEN, 4.0),
    "epsilon": np.array(1e-2),
    "clip": np.array(0.6),
}


def parts(algorithm: str) -> dict[str, np.ndarray]:
    """Random weights of two hidden layers."""
    rng = np.random.default_rng(0)
    hidden, last, _ = NAMES[algorithm]
    sizes = {f"{hidden}.0": (8, SEEN), f"{hidden}.2": (5, 8), last: (ACTIONS, 5)}
    if algorithm == "sac":
        sizes["actor.log_std"] = (ACTIONS, 5)
    made = {
        f"{name}.{k}": rng.standard_normal(size if k == "weight" else size[0]).astype(np.float32)
        for name, size in sizes.items()
        for k in ("weight", "bias")
    }
    return made | (
        {} if algorithm == "sac" else {"log_std": rng.standard_normal(ACTIONS).astype(np.float32)}
    )


def saved(folder, steps=1, algorithm="ppo", weights=None, **changes):
    meta = {**META_DATA, "algorithm": algorithm, **changes}
    policy = parts(algorithm) if weights is None else weights
    return write_checkpoint(folder, steps, meta, {"policy": policy}, {"normaliser": NORMALISER})


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_actions_are_those_of_numpy(algorithm, tmp_path):
    weights = parts(algorithm)
    hidden, last, _ = NAMES[algorithm]
    saved(tmp_path, algorithm=algorithm)
    agent = TrainedAgent.load(tmp_path)
    seen = np.random.default_rng(1).normal(size=(500, SEEN))
    x = np.clip((seen - 0.5) / np.sqrt(4.01), -0.6, 0.6)
    for name in (f"{hidden}.0", f"{hidden}.2"):
        x = x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]
        x = np.tanh(x) if algorithm == "ppo" else np.maximum(x, 0.0)
    mean = x @ weights[f"{last}.weight"].T + weights[f"{last}.bias"]
    squash = np.tanh if algorithm == "sac" else lambda a: np.clip(a, -1.0, 1.0)
    actions, state = agent.predict(seen, state="kept")
    assert (actions.dtype, state) == (np.float32, "kept")
    np.testing.assert_allclose(actions, squash(mean), atol=1e-5)
    np.testing.assert_allclose(agent.predict(seen[0])[0], actions[0], atol=1e-6)
    if algorithm == "ppo":
        log = np.broadcast_to(weights["log_std"], mean.shape)
    else:
        log = np.clip(
            x @ weights["actor.log_std.weight"].T + weights["actor.log_std.bias"], -20.0, 2.0
        )
    drawn = agent.predict(seen, deterministic=False)[0]
    noise = np.random.default_rng(0).standard_normal(mean.shape)
    np.testing.assert_allclose(drawn, squash(mean + np.exp(log) * noise), atol=1e-4)
    with pytest.raises(InvalidInputError, match=rf"observation must be \({SEEN},\) or"):
        agent.predict(np.zeros(SEEN + 1))


def test_the_newest_whole_checkpoint_is_kept_and_read(tmp_path):
    for steps in (64, 128, 128):
        saved(
            tmp_path, steps, weights={name: value + steps for name, value in parts("ppo").items()}
        )
    assert [path.name for path in checkpoints(tmp_path)] == ["step-000000128"]
    assert TrainedAgent.load(tmp_path).meta["steps"] == 128
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (META, lambda text: text.replace(b'"ppo"', b'"sac"'), "does not match its own sha256"),
        (META, lambda text: text.replace(b"rl-agent/3", b"rl-agent/1"), "has schema"),
        (META, lambda text: b"{", "JSON"),
        ("policy.safetensors", lambda blob: blob[:-1], "truncated or changed"),
        ("normaliser.npz", lambda blob: blob[:100], "truncated or changed"),
    ],
)
def test_damaged_files_are_refused(file, change, message, tmp_path):
    folder = saved(tmp_path)
    (folder / file).write_bytes(change((folder / file).read_bytes()))
    with pytest.raises(ModelFileError, match=message):
        TrainedAgent.load(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": 16}, "shows"),
        ({"joints": -1}, "is for a hand of 4 fingers and -1 joints"),
        ({"action": "none"}, "acts as 'none'"),
        ({"env_id": "FourFingerGrasp-v9"}, "was trained on 'FourFingerGrasp-v9'"),
        (
            {"weights": {**parts("ppo"), "action_net.bias": np.zeros(ACTIONS - 1)}},
            "incomplete or malformed",
        ),
        ({"weights": {**parts("ppo"), "action_net.bias": np.full(ACTIONS, np.nan)}}, "not finite"),
    ],
)
def test_agents_for_something_else_are_refused(changes, message, tmp_path):
    with pytest.raises(ModelFileError, match=message):
        TrainedAgent.load(saved(tmp_path, **changes))
    with pytest.raises(ModelFileError, match="holds no agent"):
        TrainedAgent.load(tmp_path / "nothing")


def test_zero_policy_under_evaluate_policy():
    env = Monitor(gym.make("grasp_env:FourFingerGrasp-v0", max_episode_steps=10))
    mean, deviation = evaluate_policy(ZeroPolicy(), env, n_eval_episodes=2)  # type: ignore[arg-type]
    assert 0.0 < mean < 10.0  # ten steps of at most one
    assert deviation == 0.0  # the constant wrench is deterministic
    env.close()
    assert ZeroPolicy().predict(np.zeros((3, 59)))[0].shape == (3, 6)
