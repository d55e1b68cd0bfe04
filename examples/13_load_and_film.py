"""
Load an agent, score it, film it
================================

``grasp rl`` trains agents whose folders hold weights, normaliser and settings without pickles. To
learn: ``TrainedAgent.load`` runs an agent with numpy alone, on the observations of the environment,
and serves as a model for stable-baselines3; the pictures of the environment, with forces and
friction cones, make a film. The 2048 steps of this page, seconds of work, teach nothing yet.
"""

import subprocess
import sys

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from policies import TrainedAgent, ZeroPolicy

# the command line's `grasp rl --steps 2048 ...`
options = (
    "--steps 2048 --episodes 2 --curve-points 1 --curve-episodes 1 --seeds 0 --out runs/example_rl"
)
subprocess.run([sys.executable, "-m", "training", "rl", *options.split()], check=True)

agent = TrainedAgent.load("runs/example_rl/seed-0")
settings = agent.meta["env_settings"]  # with other weights of the costs than the default
print("trained:", {name: agent.meta[name] for name in ("algorithm", "action", "steps")})

env = Monitor(gym.make("grasp_env:FourFingerGrasp-v0", config=settings))
for name, policy in {"agent": agent, "the paper's start": ZeroPolicy()}.items():
    env.reset(seed=1_000_000)  # the same episodes for both
    mean, deviation = evaluate_policy(policy, env, n_eval_episodes=3)
    print(f"return of an episode, {name}: {mean:.1f} +- {deviation:.1f}")

short = {"render_mode": "rgb_array", "duration": 0.6, "pictures": {"size": (320, 320)}}
env = gym.make("grasp_env:FourFingerGrasp-v0", config=settings, **short)
observation, info = env.reset(seed=1_000_000)
over = False
iterations = []
frames = []
while not over:
    observation, reward, lost, over, info = env.step(agent.predict(observation)[0])
    assert not lost, info["failure"]
    iterations.append(info["iterations"])
    frames.append(Image.fromarray(env.render()))
# duration [ms]
frames[0].save("runs/example_rl/agent.webp", save_all=True, append_images=frames[1:], duration=20)
env.close()

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
left.imshow(frames[-1])
left.axis("off")
right.plot(np.arange(1, len(iterations) + 1) / 50, iterations, "o-")
right.set(xlabel="time [s]", ylabel="iterations of the solver", ylim=0)
plt.show()
