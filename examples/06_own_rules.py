"""
Your own start rule and your own disturbance
============================================

Both are plain functions. To learn: a start rule takes (grasp, wrench) and returns forces, and
``Repair`` makes any guess feasible; a disturbance takes the times of an episode. To compare your
rule with others: ``grasp evaluate --start firm=my_rules.py:firm``.
"""

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import ForceOptimizer, Repair, optimize_force
from grasp_env.grasp import presets


def firm(grasp, wrench):
    """Forces (N, 3) [N] to start from: least-norm balance and 4 N of squeeze at each contact."""
    force = -(grasp.pseudoinverse @ wrench).reshape(-1, 3)
    force[:, 0] += 4
    return Repair()(grasp, wrench, force)


def quake(times, rng, settings):
    """Wrenches (T, 6) [N, N m] on the object at times (T,) [s]: tones that swell and fade."""
    tones = np.sin(2 * np.pi * times[:, None] * [2, 3.3, 5] + rng.uniform(0, 2 * np.pi, 3))
    swell = np.sin(np.pi * times / settings.limits.duration)[:, None] ** 2
    return swell * np.column_stack([2 * tones, 0.02 * tones])


wrench = np.array([1, 0.5, -0.6, -0.1, 0.2, 0])
one = optimize_force(presets.paper_cuboid(), wrench, method="reduced_flow", initial=firm)
optimizer = ForceOptimizer(presets.paper_cuboid(), method="reduced_flow", initial=firm)
same = optimizer.solve(wrench)
paper = optimize_force(presets.paper_cuboid(), wrench, method="reduced_flow")
print(
    f"iterations from {one.initial!r}: {one.iterations}; from {paper.initial!r}: {paper.iterations}"
)
assert one.initial == same.initial == "firm" and (one.force == same.force).all()
# the start changes the time, not the result
np.testing.assert_allclose(one.force, paper.force, atol=0.1)

env = gym.make("grasp_env:FourFingerGrasp-v0", initial_force=firm, disturbance=quake, duration=4.0)
observation, info = env.reset(seed=0)
rows = []
done = False
while not done:
    observation, reward, terminated, truncated, info = env.step(np.zeros(6, dtype=np.float32))
    rows.append((info["time"], *info["wrench"][:3], 1e3 * info["drift"], info["iterations"]))
    done = terminated or truncated
env.close()
times, *forces, drift, iterations = np.array(rows).T
print(
    f"held for {times[-1]:.2f} s; drift at most {drift.max():.3f} mm, {np.median(iterations):.0f} iterations a step"
)
assert not info["failure"] and np.ptp(forces) > 2

fig, (top, bottom) = plt.subplots(2, 1, figsize=(8, 4.5), sharex=True, layout="constrained")
top.plot(times, np.transpose(forces), label=["x", "y", "z"])
top.set(ylabel="force to balance [N]")
top.legend(ncols=3, loc="upper right")
bottom.plot(times, iterations, color="0.3")
bottom.set(xlabel="time [s]", ylabel="iterations of the flow", ylim=0)
plt.show()
