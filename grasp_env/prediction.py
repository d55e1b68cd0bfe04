"""What late measurements mean now: the state carried forward over a known delay, with the velocities that were measured."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.sim.kinematics_kernels import trace_hand, write_gravity_torques, write_tip_centers
from grasp_env.sim.shapes import Surface, nearest
from grasp_env.sim.snapshot import split, unpack_tree


@compiled
def carry_forward(numbers, indices, kind, sizes, triangles, triangle_normals, gravity, time, buffer):
    """Moves joints and object of a snapshot on by `time` [s] at their velocities, and all geometry with them; forces stay.

    Without it a delay takes damping away: forces that press on a turned object as it was turn it further.

    Args:
        numbers, indices: the hand, from `pack_tree`.
        kind, sizes, triangles, triangle_normals: the object's `Surface`.
        gravity: (3,) [m/s^2], world.
        time: [s].
        buffer: of the snapshot; overwritten.
    """
    tree = unpack_tree(numbers, indices)
    m, n = indices[0], indices[1]
    s = split(buffer, n, m)
    for j in range(m):
        s.angles[j] = min(max(s.angles[j] + time * s.rates[j], tree.lower[j]), tree.upper[j])
    for k in range(3):
        s.position[k] += time * s.linear[k]
    _turn(s.rotation, s.angular, time)
    trace_hand(tree, s.angles, s.frames, s.origins, s.axes)
    write_tip_centers(tree, s.frames, s.origins, s.tips)
    write_gravity_torques(tree, s.frames, s.origins, s.axes, gravity, s.gravity_torques)
    surface, center = Surface(kind, sizes, triangles, triangle_normals), np.empty(3)
    for i in range(n):
        for k in range(3):
            center[k] = 0.0
            for q in range(3):
                center[k] += s.rotation[q, k] * (s.tips[i, q] - s.position[q])
        s.gaps[i] = nearest(surface, center, s.points[i], s.normals[i]) - tree.tip_radii[i]
        for k in range(3):
            world = 0.0
            for q in range(3):
                world += s.rotation[k, q] * s.normals[i, q]
            s.touch[i, k] = s.tips[i, k] + tree.tip_radii[i] * world


@compiled
def _turn(rotation, velocity, time):
    """Rotation (3, 3) after turning at a constant angular velocity (3,) [rad/s], world frame."""
    rate = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    if not rate * time > 1e-12:
        return
    sine, rest = math.sin(rate * time), 1.0 - math.cos(rate * time)
    x, y, z = velocity[0] / rate, velocity[1] / rate, velocity[2] / rate
    for column in range(3):
        a, b, c = rotation[0, column], rotation[1, column], rotation[2, column]
        along = rest * (x * a + y * b + z * c)
        rotation[0, column] = a + sine * (y * c - z * b) + along * x - rest * a
        rotation[1, column] = b + sine * (z * a - x * c) + along * y - rest * b
        rotation[2, column] = c + sine * (x * b - y * a) + along * z - rest * c
