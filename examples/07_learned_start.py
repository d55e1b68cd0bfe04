"""
A learned start
===============

The shipped network starts the paper's flow close to its optimum. To learn: a model is a start rule
like any other, for single calls, batches and the environment. Train your own with ``grasp fit --out
runs/fit/mine``, load it with ``LearnedInitialForce.load("runs/fit/mine")``, and compare it with
``grasp evaluate --start mine=runs/fit/mine``. In C++: ``07_learned_start.cpp``.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import optimize_force, optimize_forces
from grasp_env.grasp import presets, wrench
from policies import LearnedInitialForce

grasp = presets.paper_cuboid()
# not used in training; up to 2 N, 0.05 N m
held_out = wrench.sample_ball(np.random.default_rng(1), 2000)

network = LearnedInitialForce.pretrained()
starts = {
    "the paper's 12-basis": "linear_combination",
    "four_finger, this grasp's network": network,
}
fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
forces = []
medians = []
for name, rule in starts.items():
    batch = optimize_forces(grasp, held_out, method="reduced_flow", initial=rule)
    assert batch.optimal.all()
    forces.append(batch.force)
    median, most = np.percentile(batch.iterations, [50, 99])
    medians.append(median)
    print(f"{name:35} iterations: median {median:3.0f}, 99 % within {most:3.0f}")
    ax.step(np.sort(batch.iterations), np.linspace(0, 100, len(held_out)), where="post", label=name)
assert medians[1] < 0.25 * medians[0]
# the start changes the time, not the result
np.testing.assert_allclose(forces[1], forces[0], atol=0.5)
ax.set(
    xlabel="iterations of the flow to a gap of 1e-4",
    ylabel="wrenches done [%]",
    xlim=(-3, 150),
    ylim=(0, 101),
)
ax.legend(loc="lower right")

for size in (0.5, 1.0, 2.0):
    load = size * np.array([1, 0.5, -0.6, -0.01, 0.02, 0])  # [N, N m]
    learned, plain = (optimize_force(grasp, load, initial=rule) for rule in (network, None))
    print(
        f"wrench x {size}: {learned.iterations} Newton steps from the network, "
        f"{plain.iterations} from an internal force; ",
        end="",
    )
    print("normal forces", *learned.force[:, 0].round(3), "N")

# the network is for four contacts: with five the solve starts from an internal force, and the
# solution names it
print("five fingers:", optimize_force(presets.five_finger_cuboid(), load, initial=network).initial)

plt.show()
