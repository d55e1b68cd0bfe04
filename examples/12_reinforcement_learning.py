"""
Train an agent with stable-baselines3
=====================================

PPO adjusts the solver's start so that the paper's flow needs fewer iterations. To learn: one thread
for a small network, ``VecNormalize`` for observations up to 500, a TensorBoard row at every update,
and a comparison with the zero action, the paper's start. The few steps of this page teach almost
nothing; with 65536 as argument, two minutes of one core, the agent's starts took 28.9 iterations,
the paper's 56.3.
"""

import sys
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

STEPS = int(sys.argv[1]) if sys.argv[1:] else 4096
FOLDER = Path("runs/example_ppo")  # `tensorboard --logdir runs/example_ppo` shows the progress
ENV = "grasp_env:FourFingerGrasp-v0"
SETTINGS = {"disturbance": "random"}
torch.set_num_threads(1)  # two threads train several times slower
# DummyVecEnv: processes would not be faster
plain = make_vec_env(ENV, n_envs=8, seed=0, env_kwargs=SETTINGS)
# gamma: an action affects only its own step
envs = VecNormalize(plain, gamma=0.0, clip_reward=np.inf)
kwargs = {
    "n_steps": 256,
    "batch_size": 256,
    "learning_rate": 1e-3,
    "policy_kwargs": {"log_std_init": np.log(0.1)},
}
model = PPO(
    "MlpPolicy", envs, gamma=0.0, seed=0, device="cpu", tensorboard_log=str(FOLDER), **kwargs
)
model.learn(STEPS, log_interval=1)
model.save(FOLDER / "agent")
# the agent needs it; both are pickles: load only your own
envs.save(str(FOLDER / "normaliser.pkl"))


def iterations(predict):
    """Return the iterations of the solver at every step of ten held-out episodes."""
    env = gym.make(ENV, **SETTINGS)
    counts = []
    for seed in range(1_000_000, 1_000_010):
        observation, info = env.reset(seed=seed)
        over = False
        while not over:
            observation, _, lost, over, info = env.step(predict(observation))
            assert not lost, info["failure"]
            counts.append(info["iterations"])
    return counts


loaded = PPO.load(FOLDER / "agent")
seen = VecNormalize.load(str(FOLDER / "normaliser.pkl"), plain)
agent = iterations(
    lambda observation: loaded.predict(seen.normalize_obs(observation), deterministic=True)[0]
)
paper = iterations(lambda observation: np.zeros(6, dtype=np.float32))
print(
    f"trained for {model.num_timesteps} steps; iterations over {len(paper)} held-out steps of the hand:"
)
print(f"{np.mean(agent):.1f} from the agent's starts, {np.mean(paper):.1f} from the paper's")

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
left.plot(np.mean(plain.env_method("get_episode_rewards"), axis=0))
left.set(xlabel="episodes of each environment", ylabel="return in training")
right.hist(
    [paper, agent], bins=range(0, 180, 20), label=["from the paper's start", "from the agent's"]
)
right.set(xlabel="iterations of the solver", ylabel="steps of the hand")
right.legend()
plt.show()
