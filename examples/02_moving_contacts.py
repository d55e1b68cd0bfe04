"""
Contacts that move, at 1 kHz
============================

Four fingers hold a cuboid that turns, and their tips roll. To learn: ``solve`` takes the current
contacts and warm-starts from its last solution; a new grasp and solver at each tick give the same
forces, many times slower. In C++: ``02_moving_contacts.cpp``.
"""

from time import perf_counter

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.force import ForceOptimizer, Margin, joint_torques, optimize_force
from grasp_env.grasp import Grasp, gravity_wrench, presets

nominal = presets.paper_cuboid()  # a thumb below, three fingers above; friction 0.4
# velocities of the contact points by the joints, object frame [m]: three rows a contact, three
# joints a finger
jacobian = np.kron(np.eye(4), [[0.05, 0, 0], [0.01, -0.02, -0.03], [0.06, 0.05, 0.03]])


def world(seconds):
    """Contact points [m], inward normals and the wrench [N, N m] at this moment, all in the
    object's frame.
    """
    roll = 6 * seconds + np.arange(4)
    turn = np.pi * seconds  # the tips move by a millimetre, the cuboid turns about y
    points = nominal.positions + 1e-3 * np.column_stack([np.sin(roll), np.cos(roll), np.zeros(4)])
    normals = nominal.normals + 1e-2 * np.column_stack([np.sin(roll), np.zeros((4, 2))])
    rotation = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals, gravity_wrench(0.5, com=[0.005, 0, 0.01], rotation=rotation)


margin = Margin(0.75, preload=0.5)
optimizer = ForceOptimizer(nominal, margin=margin, initial="previous")
stamps = np.empty((1000, 3))
used = np.empty((1000, 4))
torques = np.empty((1000, 12))
for tick in range(1000):
    points, normals, wrench = world(1e-3 * tick)
    begin = perf_counter()
    solution = optimizer.solve(wrench, positions=points, normals=normals)
    moved = perf_counter()
    anew = optimize_force(Grasp.from_contacts(points, normals, 0.4), wrench, margin=margin)
    stamps[tick] = begin, moved, perf_counter()
    assert np.allclose(anew.force, solution.force, atol=0.1)
    used[tick] = solution.friction_used  # shares of the friction; beyond 1 a finger slips
    torques[tick] = joint_torques(jacobian, solution.object_force)

moving, anew = np.median(1e6 * np.diff(stamps), axis=0)
print(f"median: contacts of the call {moving:.1f} us, all anew {anew:.1f} us")
print(
    f"largest joint torque {abs(torques).max():.3f} N m, at most {used.max():.3f} of the friction used"
)
assert used.max() <= 0.75 and 3 * moving < anew

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 4.5), layout="constrained")
left.plot(used, label=["thumb", "finger 1", "finger 2", "finger 3"])
right.plot(torques)
left.set(xlabel="time [ms]", ylabel="share of the friction used", ylim=(0, 1))
right.set(xlabel="time [ms]", ylabel="torques of 12 joints [N m]")
left.legend()
plt.show()
