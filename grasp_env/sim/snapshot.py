"""What a scene looks like after a step: one compiled pass over one reading of the server.

The geometry is that of spherical tips and the object's surface, computed from the current poses: Bullet's own contact points belong
to the start of the last step, and a finger that does not touch has none. Only the forces are Bullet's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from grasp_env._check import Array, Indices
from grasp_env._compile import compiled
from grasp_env._views import cut, inlined, small
from grasp_env.sim.kinematics_kernels import Tree, trace_hand, write_gravity_torques, write_tip_centers
from grasp_env.sim.shapes import Surface, nearest

LOST_DISTANCE = 10.0
"""[m]; an object beyond it has long left the hand."""
STRAY_DISTANCE = 5e-3
"""[m] from the tip's contact point beyond which a contact of its link belongs to the link, not to the tip."""
VALID, MASK = 0, 20
"""Places of `valid` and `mask` in a buffer."""
BODY = 13
"""Numbers of the object in a reading: position, quaternion (x y z w), linear and angular velocity, world frame."""
ROW = 16
"""Numbers of a contact in a reading: Bullet's link, point on the object (3), normal force, normal (3), then twice a friction force and
its direction (3)."""


class Snapshot(NamedTuple):
    """Views into one flat buffer, which the next reading overwrites; N tips, M joints.

    Attributes:
        valid: (1,) 1.0 where every number is finite and the object near.
        position: (3,) the object's centre [m], world.
        rotation: (3, 3) object frame to world frame.
        linear: (3,) its velocity [m/s], world.
        angular: (3,) [rad/s], world.
        points: (N, 3) surface point nearest to each tip [m], object frame.
        normals: (N, 3) inward unit normal there, object frame.
        touch: (N, 3) point of the tip nearest to the object [m], world.
        tips: (N, 3) centres of the tips [m], world.
        gaps: (N,) distance of tip and object [m], below 0 where they overlap.
        slip: (N,) tangential speed of the tip relative to the object [m/s].
        touching: (N,) 1.0 where the tip carried force in the last step.
        forces: (N, 3) measured force of each tip ON the object [N], object frame.
        stray: (1,) total force of other parts of the hand on the object [N].
        mask: (1,) the sum of 2^i over the tips i that touch.
        gravity_torques: (M,) torques that carry the hand's links [N m].
        angles, rates: (M,) of the joints [rad], [rad/s].
        frames, origins, axes: (M, 3, 3), (M, 3), (M, 3) of links and joints, world frame.
    """

    valid: Array
    position: Array
    rotation: Array
    linear: Array
    angular: Array
    points: Array
    normals: Array
    touch: Array
    tips: Array
    gaps: Array
    slip: Array
    touching: Array
    forces: Array
    stray: Array
    mask: Array
    gravity_torques: Array
    angles: Array
    rates: Array
    frames: Array
    origins: Array
    axes: Array


def snapshot_size(tips: int, joints: int) -> int:
    """Numbers in a snapshot's buffer."""
    return 21 + 18 * tips + 18 * joints


@inlined
def split(buffer, tips, joints):
    """The `Snapshot` views of a buffer of `snapshot_size` numbers."""
    a = 21
    b = a + 15 * tips
    c = b + 3 * tips
    d = c + 3 * joints
    return Snapshot(
        cut(buffer, 0, (1,)),
        cut(buffer, 1, (3,)),
        cut(buffer, 4, (3, 3)),
        cut(buffer, 13, (3,)),
        cut(buffer, 16, (3,)),
        cut(buffer, a, (tips, 3)),
        cut(buffer, a + 3 * tips, (tips, 3)),
        cut(buffer, a + 6 * tips, (tips, 3)),
        cut(buffer, a + 9 * tips, (tips, 3)),
        cut(buffer, b, (tips,)),
        cut(buffer, b + tips, (tips,)),
        cut(buffer, b + 2 * tips, (tips,)),
        cut(buffer, a + 12 * tips, (tips, 3)),
        cut(buffer, 19, (1,)),
        cut(buffer, 20, (1,)),
        cut(buffer, c, (joints,)),
        cut(buffer, c + joints, (joints,)),
        cut(buffer, c + 2 * joints, (joints,)),
        cut(buffer, d, (joints, 3, 3)),
        cut(buffer, d + 9 * joints, (joints, 3)),
        cut(buffer, d + 12 * joints, (joints, 3)),
    )


def pack_tree(tree: Tree) -> tuple[Array, Indices]:
    """A hand's tree as two flat arrays, which cost a compiled call a tenth of what the tuple does: numbers, indices."""
    numbers = (
        tree.offsets, tree.rotations, tree.axes, tree.masses, tree.centers, tree.tip_centers, tree.tip_radii,
        tree.lower, tree.upper, tree.torque_limits,
    )  # fmt: skip
    sizes = [len(tree.parents), len(tree.tip_links)]
    return (
        np.concatenate([np.ravel(part) for part in numbers]),
        np.concatenate([sizes, tree.parents, tree.tip_links]).astype(np.int64),
    )


@inlined
def unpack_tree(numbers, indices):
    """The tree of `pack_tree`, as views."""
    m, n = indices[0], indices[1]
    a = 20 * m
    return Tree(
        cut(indices, 2, (m,)),
        cut(numbers, 0, (m, 3)),
        cut(numbers, 3 * m, (m, 3, 3)),
        cut(numbers, 12 * m, (m, 3)),
        cut(numbers, 15 * m, (m,)),
        cut(numbers, 16 * m, (m, 3)),
        cut(indices, 2 + m, (n,)),
        cut(numbers, 19 * m, (n, 3)),
        cut(numbers, 19 * m + 3 * n, (n,)),
        cut(numbers, a - m + 4 * n, (m,)),
        cut(numbers, a + 4 * n, (m,)),
        cut(numbers, a + m + 4 * n, (m,)),
    )


@inlined
def write_rotation(quaternion, rotation):
    """Write the rotation matrix of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    rotation[0, 0], rotation[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = 2 * (x * y - z * w), 2 * (x * y + z * w)
    rotation[0, 2], rotation[2, 0] = 2 * (x * z + y * w), 2 * (x * z - y * w)
    rotation[1, 2], rotation[2, 1] = 2 * (y * z - x * w), 2 * (y * z + x * w)


@inlined
def add_point_velocity(parents, link, origins, axes, rates, point, velocity):
    """Add the world velocity of a point fixed to `link` (3,) to `velocity`."""
    while link >= 0:
        x, y, z = point[0] - origins[link, 0], point[1] - origins[link, 1], point[2] - origins[link, 2]
        rate = rates[link]
        velocity[0] += rate * (axes[link, 1] * z - axes[link, 2] * y)
        velocity[1] += rate * (axes[link, 2] * x - axes[link, 0] * z)
        velocity[2] += rate * (axes[link, 0] * y - axes[link, 1] * x)
        link = parents[link]


@compiled
def observe(numbers, indices, kind, sizes, triangles, triangle_normals, gravity, reading, finger_of_link, buffer):
    """Fills a snapshot's buffer.

    Args:
        numbers, indices: the hand, from `pack_tree`.
        kind, sizes, triangles, triangle_normals: the object's `Surface`.
        gravity: (3,) [m/s^2], world.
        reading: (2M + BODY + ROW * R,) joint angles, joint speeds, the object, and R contacts, as they come from the server.
        finger_of_link: (L,) by Bullet's link number + 1: the finger whose tip is on the link, or -1.
        buffer: (`snapshot_size`,) overwritten.
    """
    tree = unpack_tree(numbers, indices)
    m, n = indices[0], indices[1]
    s = split(buffer, n, m)
    surface = Surface(kind, sizes, triangles, triangle_normals)
    body = reading[2 * m : 2 * m + BODY]
    near = True
    for j in range(2 * m):
        near = near and math.isfinite(reading[j])
    for k in range(BODY):
        near = near and math.isfinite(body[k])
    for k in range(3):
        near = near and abs(body[k]) < LOST_DISTANCE
    s.valid[0] = 1.0 if near else 0.0
    if not near:
        return
    for j in range(m):
        s.angles[j], s.rates[j] = reading[j], reading[m + j]
    for k in range(3):
        s.position[k], s.linear[k], s.angular[k] = body[k], body[7 + k], body[10 + k]
    write_rotation(body[3:7], s.rotation)
    trace_hand(tree, s.angles, s.frames, s.origins, s.axes)
    write_tip_centers(tree, s.frames, s.origins, s.tips)
    write_gravity_torques(tree, s.frames, s.origins, s.axes, gravity, s.gravity_torques)
    center, velocity = small(3), small(3)
    for i in range(n):
        for k in range(3):
            center[k] = 0.0
            for q in range(3):
                center[k] += s.rotation[q, k] * (s.tips[i, q] - s.position[q])
        distance = nearest(surface, center, s.points[i], s.normals[i])
        s.gaps[i] = distance - tree.tip_radii[i]
        along = 0.0
        velocity[:] = 0.0
        for k in range(3):
            world = 0.0
            for q in range(3):
                world += s.rotation[k, q] * s.normals[i, q]
            center[k] = world  # from here on the inward normal, world frame
            s.touch[i, k] = s.tips[i, k] + tree.tip_radii[i] * world
        add_point_velocity(tree.parents, tree.tip_links[i], s.origins, s.axes, s.rates, s.touch[i], velocity)
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            arm_p, arm_q = s.touch[i, p] - s.position[p], s.touch[i, q] - s.position[q]
            velocity[k] -= s.linear[k] + s.angular[p] * arm_q - s.angular[q] * arm_p
            along += velocity[k] * center[k]
        squared = 0.0
        for k in range(3):
            squared += (velocity[k] - along * center[k]) ** 2
        s.slip[i] = math.sqrt(squared)
    _measure(s, reading[2 * m + BODY :], finger_of_link)


@inlined
def _measure(s, rows, finger_of_link):
    """Contact forces by finger. The hand was loaded before the object: the friction signs of Bullet depend on that."""
    s.touching[:] = 0.0
    s.forces[:] = 0.0
    s.stray[0], s.mask[0] = 0.0, 0.0
    force = small(3)
    for start in range(0, rows.size, ROW):
        row = rows[start : start + ROW]
        finger = finger_of_link[int(row[0]) + 1]
        force_squared, away_squared = 0.0, 0.0
        for k in range(3):
            force[k] = -(row[4] * row[5 + k] + row[8] * row[9 + k] + row[12] * row[13 + k])
            force_squared += force[k] * force[k]
            if finger >= 0:
                away_squared += (row[1 + k] - s.touch[finger, k]) ** 2
        if not math.isfinite(force_squared):
            s.valid[0] = 0.0
            return
        if finger < 0 or away_squared > STRAY_DISTANCE**2:
            s.stray[0] += math.sqrt(force_squared)
            continue
        if row[4] > 0.0:
            s.touching[finger] = 1.0
        for k in range(3):
            for q in range(3):
                s.forces[finger, k] += s.rotation[q, k] * force[q]
    for i in range(s.touching.size):
        s.mask[0] += s.touching[i] * 2.0**i
