"""
A contact is lost, and comes back
=================================

One of four fingers leaves the object for 0.2 s. To learn: another number of contacts is another problem, so make a
``ForcePipeline`` for each set that may remain beforehand, and ``reset`` it when its turn comes: no tick is late. In
C++: ``03_lost_contact.cpp``.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.errors import RankDeficientGraspError
from grasp_env.force import ForcePipeline
from grasp_env.grasp import Grasp, presets

nominal = presets.paper_cuboid()  # a thumb below, three fingers above
points, normals = nominal.positions, nominal.normals
pipelines = {}  # by the number of fingers that hold
for count in (3, 4):
    grasp = Grasp.from_contacts(points[:count], normals[:count], friction=0.4)
    pipelines[count] = ForcePipeline(grasp, method="newton", initial="previous")

events = {399: "four hold", 400: "one is lost", 401: "three hold", 600: "it is back", 601: "four hold"}
forces, iterations, before = np.full((1000, 4), np.nan), np.empty(1000), 4
for tick in range(1000):
    count = 3 if 400 <= tick < 600 else 4
    if count != before:
        pipelines[count].reset()  # what it held then is not held now
    before = count
    turn = 2 * np.pi * 1e-3 * tick
    wrench = np.array([3 * np.sin(turn), 2 * np.cos(turn), 2, 0, 0, 0.02])  # [N, N m]
    solution = pipelines[count].solve(points[:count], normals[:count], wrench).raise_for_status()
    forces[tick, :count], iterations[tick] = solution.force[:, 0], solution.iterations
    if tick in events:
        normal = solution.force[:, 0].round(3)
        print(f"{tick} ms, {events[tick]:11} {solution.iterations} iterations, normal forces {normal} N")
assert np.isnan(forces[500, 3]) and iterations[401] <= iterations[400]

try:  # what no force can balance is said when the grasp is made, not in the loop
    Grasp.from_contacts(points[:2], normals[:2], 0.4)
except RankDeficientGraspError as error:
    print("two remain:", error)

fig, ax = plt.subplots(figsize=(8, 4.5), layout="constrained")
ax.plot(forces, label=["thumb", "finger 1", "finger 2", "finger 3"])
ax.axvspan(400, 600, color="0.92", label="finger 3 is off")
ax.set(xlabel="time [ms]", ylabel="normal force [N]", xlim=(0, 1000), ylim=(0, 7))
ax.legend(ncols=5, loc="upper center")
plt.show()
