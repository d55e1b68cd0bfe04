"""
Many wrenches, many grasps
==========================

Sixty thousand directions of a load on one grasp, and a thousand positions of its thumb. To learn:
``optimize_forces`` solves whole arrays, in vector registers and on all cores, with the results of
single calls. In C++: ``08_batch.cpp``.
"""

from time import perf_counter

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import optimize_force, optimize_forces
from grasp_env.grasp import Grasp, presets

grasp = presets.paper_cuboid()
azimuth, elevation = np.meshgrid(np.radians(np.arange(-180, 180)), np.radians(np.arange(-84, 85)))
loads = np.zeros((azimuth.size, 6))  # 5 N in every direction
loads[:, 0] = 5 * (np.cos(elevation) * np.cos(azimuth)).ravel()
loads[:, 1] = 5 * (np.cos(elevation) * np.sin(azimuth)).ravel()
loads[:, 2] = 5 * np.sin(elevation).ravel()
begin = perf_counter()
batch = optimize_forces(grasp, loads, method="conic")
took = perf_counter() - begin
print(
    f"{len(batch)} wrenches on one grasp: {len(batch) / took / 1e6:.2f} million a second; {batch}"
)
print(f"they take {batch.objective.mean():.3f} N on average, {batch.objective.max():.3f} N at most")
np.testing.assert_allclose(
    batch[1234].force, optimize_force(grasp, loads[1234], method="conic").force, atol=1e-6
)

places = np.linspace(-0.03, 0.03, 31)  # positions of the thumb on the lower face [m]
grasps = []
for y in places:
    for x in places:
        points = grasp.positions.copy()
        points[0, :2] = x, y
        grasps.append(Grasp.from_contacts(points, grasp.normals, 0.4))
weights = np.tile([3.0, 0, 0, 0, 0, 0], (len(grasps), 1))  # the hand lies on its side
begin = perf_counter()
many = optimize_forces(grasps, weights, method="conic")
took = perf_counter() - begin
print(f"{len(many)} grasps, a wrench each: {1e-3 * len(many) / took:.0f} thousand a second; {many}")
assert batch.optimal.all() and many.optimal.all()

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
total = batch.force[:, :, 0].sum(axis=1).reshape(azimuth.shape)  # normal forces [N]
drawn = left.imshow(total, extent=(-180, 180, -84, 84), origin="lower", aspect="auto")
left.set(xlabel="azimuth of 5 N [deg]", ylabel="elevation [deg]")
fig.colorbar(drawn, label="least sum of normal forces [N]", orientation="horizontal")
total = many.force[:, :, 0].sum(axis=1).reshape(31, 31)
drawn = right.imshow(total, extent=(-31, 31, -31, 31), origin="lower")
right.set(xlabel="x of the thumb [mm]", ylabel="y [mm]")
fig.colorbar(drawn, label="least sum, 3 N along x [N]", orientation="horizontal")
plt.show()
