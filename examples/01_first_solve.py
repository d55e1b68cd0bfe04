"""
Solve your own contacts
=======================

Three fingertips carry a mug of 0.3 kg. The contacts come from a drawing, in millimetres and with
outward normals. To learn: check your numbers with ``advise`` before you trust a force; it names
both mistakes. And give a margin: without one the optimum nearly slips. In C++:
``01_first_solve.cpp``.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import optimize_force
from grasp_env.grasp import Grasp, advise, gravity_wrench

angles = np.radians([0, 130, 230])  # around the mug, 80 mm across
drawing = 40 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
outward = drawing / 40

print("as drawn:")
for text in advise(Grasp.from_contacts(drawing, outward, friction=0.6)):
    print(f"- {text}")

# metres, normals INTO the object
grasp = Grasp.from_contacts(drawing / 1000, -outward, friction=0.6)
assert advise(grasp) == []

weight = gravity_wrench(0.3)  # the force [N] and moment [N m] that act ON the mug
solution = optimize_force(grasp, weight, margin=0.75)  # forces use at most 75 % of the friction
solution.raise_for_status()  # raises an error unless the force is certified optimal
print(
    f"\nin metres, inward: {solution.status.value}, squeezes with {solution.total_normal_force:.2f} N in all"
)
print("contact   normal        o        t   [N]")
for k, (normal, o, t) in enumerate(solution.force.round(3) + 0.0):
    print(f"{k:7d} {normal:8.3f} {o:8.3f} {t:8.3f}")
print(f"uses at most {solution.friction_used.max():.3f} of the friction")

# the forces in the object's axes and the weight sum to zero
vectors = grasp.to_object_frame(solution.force)
print("fingers + weight:", (vectors.sum(axis=0) + weight[:3]).round(9) + 0.0, "N")
assert abs(vectors.sum(axis=0) + weight[:3]).max() < 1e-9

fig = plt.figure(figsize=(8, 4.5), layout="constrained")
ax = fig.add_subplot(projection="3d", proj_type="ortho")
around, height = np.meshgrid(np.linspace(0, 2 * np.pi, 61), [-50, 50])
ax.plot_surface(40 * np.cos(around), 40 * np.sin(around), height, color="0.8", alpha=0.3)
ax.quiver(*drawing.T, *(15 * vectors.T), color="tab:blue", pivot="tip", label="fingers")
ax.quiver(0, 0, 0, *(15 * weight[:3]), color="tab:red", label="weight")
ax.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title="forces, 15 mm per newton")
ax.set(xticks=[-40, 0, 40], yticks=[-40, 0, 40], zticks=[-50, 0, 50])
ax.set_aspect("equal")
ax.view_init(elev=20, azim=-60)
ax.set_box_aspect(None, zoom=1)
ax.legend(loc="center left", bbox_to_anchor=(-0.4, 0.5))
plt.show()
