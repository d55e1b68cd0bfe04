"""
In two simulators
=================

The hand holds a cuboid under random pushes, in PyBullet and in MuJoCo (from CPython 3.12 on in
MuJoCo only), with a measured or an estimated wrench. To learn: the controller needs no force sensor
on the object; the lag of the estimate causes a drift far below a millimetre in both engines.
"""

from importlib.util import find_spec

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from gymnasium.wrappers import AddRenderObservation

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), width_ratios=(3, 2), layout="constrained")
engines = ["bullet", "mujoco"] if find_spec("pybullet") else ["mujoco"]
for engine in engines:
    for wrench in ("measured", "estimated"):
        env = gym.make(
            "grasp_env:FourFingerGrasp-v0",
            engine=engine,
            sensors={"wrench": wrench},
            disturbance="random",  # 0.6 N and 0.02 N m per axis
            duration=3.0,
            render_mode="rgb_array",
        )
        observation, info = env.reset(seed=0)
        times = []
        drifts = []
        done = False
        while not done:
            observation, reward, terminated, truncated, info = env.step(
                np.zeros(6, dtype=np.float32)
            )
            times.append(info["time"])
            drifts.append(1e3 * info["drift"])
            done = terminated or truncated
        squeeze = info["commanded_force"][:, 0].sum()
        print(
            f"{engine}, wrench {wrench:9}: drift at most {max(drifts):.4f} mm, {squeeze:.1f} N at the end"
        )
        assert info["is_success"] and max(drifts) < 2
        left.semilogy(
            times,
            drifts,
            label=f"{engine}, {wrench}",
            linestyle="-" if engine == engines[0] else "--",
        )
        if engine == engines[0] and wrench == "estimated":
            right.imshow(env.render())
        env.close()

# images in addition to the named parts of the observation
env = gym.make(
    "grasp_env:FourFingerGrasp-v0",
    observation="dict",
    render_mode="rgb_array",
    pictures={"size": (96, 96)},
)
env = AddRenderObservation(env, render_only=False)
observation, info = env.reset(seed=0)
print(
    "an agent that looks sees",
    {name: observation[name].shape for name in ("joint_angles", "touching", "pixels")},
)
env.close()

left.set(xlabel="time [s]", ylabel="drift of the cuboid [mm]", ylim=(1e-5, 2))
left.legend()
right.axis("off")
plt.show()
