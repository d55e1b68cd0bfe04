"""Compiled: places on an object that one finger of a hand can touch."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.sim.clearance import surface_gap, write_limbs
from grasp_env.sim.kinematics_kernels import trace_hand
from grasp_env.sim.kinematics_solve import REACHED, solve_hand
from grasp_env.sim.shapes import nearest

_INSIDE_STEPS = 8  # from a point inside towards the surface; exactly along the ray does not matter


@compiled
def fill_pool(
    tree, limbs, surface, own_joints, carried, home, direction, rays, margins, points, normals, starts, ends, outcome,
):  # fmt: skip
    """Write up to K places on the surface that one finger reaches with its links clear of the object.

    Args:
        tree: The `Tree` of this finger alone, m joints.
        limbs: `Limbs` of the hand.
        surface: The object.
        own_joints: Numbers of the joints in the hand, (m,) int64.
        carried: Whether the finger moves a limb, (C,) bool.
        home: Angles to start the inverse kinematics from [rad], (1, m).
        direction: From the object to the finger, unit, (3,).
        rays: (S, 6): where inside the object's bounding box to start [m], and what to add to the direction.
        margins: [m] of flat surface around a contact, [rad] from joint limits, [m] of clearance.
        points: Output [m], (K, 3).
        normals: Output, inward, (K, 3).
        starts: Output, limbs at that place [m], (K, C, 3).
        ends: Output, (K, C, 3).
        outcome: Output, how many rays ended at an edge, out of reach, with a link at the object, (3,) int64.

    Returns:
        Number of places written.
    """
    joints = len(own_joints)
    frames, origins, axes = np.empty((joints, 3, 3)), np.empty((joints, 3)), np.empty((joints, 3))
    hand_frames, hand_origins = np.empty((own_joints[-1] + 1, 3, 3)), np.empty((own_joints[-1] + 1, 3))
    target, angles, missed = np.empty((1, 3)), np.empty(joints), np.empty(1)
    alone, one, all_joints, end = np.array([0]), np.array([1]), np.arange(joints), np.array([joints])
    found = 0
    for s in range(len(rays)):
        if found == len(points):
            break
        point, normal = points[found], normals[found]
        if not _place(surface, rays[s], direction, point, normal):
            continue
        if not _is_flat(surface, point, normal, margins[0]):
            outcome[0] += 1
            continue
        for k in range(3):
            target[0, k] = point[k] - tree.tip_radii[0] * normal[k]
        solve_hand(tree, target, alone, one, all_joints, end, home, angles, missed)
        fits = missed[0] <= REACHED
        for j in range(joints):
            fits = fits and tree.lower[j] + margins[1] <= angles[j] <= tree.upper[j] - margins[1]
        if not fits:
            outcome[1] += 1
            continue
        trace_hand(tree, angles, frames, origins, axes)
        for j in range(joints):
            hand_frames[own_joints[j]], hand_origins[own_joints[j]] = frames[j], origins[j]
        write_limbs(limbs, carried, hand_frames, hand_origins, starts[found], ends[found])
        for c in range(len(carried)):
            if carried[c] and limbs.tips[c] == 0 and fits:
                enough = limbs.radii[c] + margins[2]
                fits = surface_gap(surface, starts[found, c], ends[found, c], enough) >= enough
        if not fits:
            outcome[2] += 1
            continue
        found += 1
    return found


@compiled
def _place(surface, ray, direction, point, normal):
    """Walk from inside along a ray to the surface; False where the start is not inside."""
    center, way = ray[:3].copy(), direction + ray[3:]
    length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    depth = nearest(surface, center, point, normal)
    if depth >= 0.0 or length < 0.1:
        return False
    for _ in range(_INSIDE_STEPS):
        for k in range(3):
            center[k] -= depth / length * way[k]
        depth = nearest(surface, center, point, normal)
        if depth > -1e-4:
            break
    return True


@compiled
def _is_flat(surface, point, normal, size):
    """Whether the normal turns by less than 20 degrees up to `size` away."""
    side, center, there, inward = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    small = 0
    for k in range(3):
        if abs(normal[k]) < abs(normal[small]):
            small = k
    for turn in range(4):
        if turn % 2 == 0:
            along = normal[small]
            for k in range(3):
                side[k] = (1.0 if k == small else 0.0) - along * normal[k]
            length = math.sqrt(side[0] ** 2 + side[1] ** 2 + side[2] ** 2)
            for k in range(3):
                side[k] *= (size if turn == 0 else -size) / length
        else:
            # the second tangent, of the same length
            x, y, z = side[0], side[1], side[2]
            side[0], side[1], side[2] = (
                normal[1] * z - normal[2] * y,
                normal[2] * x - normal[0] * z,
                normal[0] * y - normal[1] * x,
            )
        for k in range(3):
            center[k] = point[k] + side[k] - 0.1 * size * normal[k]
        nearest(surface, center, there, inward)
        if inward[0] * normal[0] + inward[1] * normal[1] + inward[2] * normal[2] < 0.94:
            return False
    return True
