"""
Exact or smooth
===============

The exact optimum has the smallest squeeze and lies on the friction cones; the paper's Phi keeps a
margin. To learn: ``barrier_weight`` (lambda) trades margin against squeeze, and the forces of Phi
change smoothly with the wrench, while exact ones have kinks.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import ForceOptimizer
from grasp_env.grasp import presets

grasp = presets.paper_cuboid()
# a load of 3 N turns in the plane of the thumb and a finger [deg]
angles = np.linspace(0, 360, 361)
loads = np.zeros((361, 6))
loads[:, 1], loads[:, 2] = 3 * np.cos(np.radians(angles)), 3 * np.sin(np.radians(angles))

optimizers = {"exact": ForceOptimizer(grasp, method="conic")}
for weight in (1e-4, 1e-2, 1e-1, 1.0):
    optimizers[f"lambda {weight:g}"] = ForceOptimizer(grasp, barrier_weight=weight, tolerance=1e-8)

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
squeezes = []
margins = []
bends = []
print("             mean squeeze   least margin   sharpest bend of a force")
for name, optimizer in optimizers.items():
    solutions = [optimizer.solve(load) for load in loads]
    force = np.array([solution.force for solution in solutions])
    squeezes.append(force[:, :, 0].sum(axis=1).mean())
    margins.append(min(solution.cone_margin for solution in solutions))
    bends.append(abs(np.diff(force, 2, axis=0)).max())
    print(f"{name:12} {squeezes[-1]:10.2f} N {margins[-1]:13.4f} N {bends[-1]:14.3f} N/deg^2")
    right.plot(angles, force[:, 0, 0], label=name)
assert (
    (np.diff(squeezes) > 0).all()
    and (np.diff(margins[1:]) > 0).all()
    and (np.diff(bends) < 0).all()
)

left.plot(squeezes, margins, color="0.7", zorder=0)
left.scatter(squeezes, margins, color=[f"C{k}" for k in range(5)])
left.set(xlabel="mean sum of normal forces [N]", ylabel="least margin to a cone [N]", xlim=0)
right.set(
    xlabel="direction of the load [deg]",
    ylabel="normal force of the thumb [N]",
    xticks=range(0, 361, 90),
)
right.legend()
plt.show()
