"""Where each finger meets the cuboid, with which force, and what the hand can do there.

The geometry is that of a sphere and a cuboid, computed from the current poses: Bullet's own contact
points belong to the start of the last step, and a finger that does not touch has none. Only the
forces are Bullet's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from grasp_env._compile import compiled
from grasp_env.sim.kinematics import (
    HandKinematics,
    trace_finger,
    write_gravity_torques,
    write_point_jacobian,
)

_LOST_DISTANCE = 10.0  # [m]; an object beyond it has long left the hand


@dataclass(frozen=True)
class FingerContacts:
    """The contacts of all N fingers, in the hand's order.

    Attributes:
        touching: Whether the finger carried force in the last step, (N,) bool.
        points: Point of the object's surface nearest to the tip [m], (N, 3), object frame.
        normals: Inward unit normals there, (N, 3), object frame.
        forces: Measured force of the finger ON the object [N], (N, 3), object frame.
        slip: Tangential speed of the tip relative to the object [m/s], (N,).
        gaps: Distance of tip and object [m], (N,), below 0 where they overlap.
    """

    touching: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    forces: np.ndarray
    slip: np.ndarray
    gaps: np.ndarray


class Snapshot(NamedTuple):
    """What follows from one reading of joints and object; see `take_snapshot`."""

    valid: bool
    rotation: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    gaps: np.ndarray
    slip: np.ndarray
    jacobians: np.ndarray
    gravity_torques: np.ndarray


@compiled
def _write_rotation(quaternion, rotation):
    """Write the rotation matrix of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    rotation[0, 0], rotation[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = 2 * (x * y - z * w), 2 * (x * y + z * w)
    rotation[0, 2], rotation[2, 0] = 2 * (x * z + y * w), 2 * (x * z - y * w)
    rotation[1, 2], rotation[2, 1] = 2 * (y * z - x * w), 2 * (y * z + x * w)


@compiled
def _nearest_on_box(center, half_extents, point, normal):
    """Write the box's surface point nearest to `center` and the inward normal.

    Returns the signed distance of `center` to the surface, below 0 inside.
    """
    squared, depth, face = 0.0, math.inf, 0
    for k in range(3):
        point[k] = min(max(center[k], -half_extents[k]), half_extents[k])
        squared += (center[k] - point[k]) ** 2
        if half_extents[k] - abs(center[k]) < depth:
            depth, face = half_extents[k] - abs(center[k]), k
    if squared > 0.0:
        distance = math.sqrt(squared)
        for k in range(3):
            normal[k] = (point[k] - center[k]) / distance
        return distance
    sign = math.copysign(1.0, center[face])
    normal[:] = 0.0
    normal[face], point[face] = -sign, sign * half_extents[face]
    return -depth


@compiled
def _slip_speed(relative, normal):
    """Length of the part of a velocity that is orthogonal to a unit normal."""
    along, squared = 0.0, 0.0
    for k in range(3):
        along += relative[k] * normal[k]
    for k in range(3):
        squared += (relative[k] - along * normal[k]) ** 2
    return math.sqrt(squared)


@compiled
def _observe(
    bases, rotations, lengths, masses, fractions, radius, half_extents, gravity, reading
):  # fmt: skip
    count = len(bases)
    joints, body = reading[: 6 * count], reading[6 * count :]
    position, quaternion, velocity = body[:3], body[3:7], body[7:]
    rotation = np.empty((3, 3))
    points, normals = np.empty((count, 3)), np.empty((count, 3))
    gaps, slip = np.empty(count), np.empty(count)
    jacobians, torques = np.empty((count, 3, 3)), np.empty(3 * count)
    origins, axes = np.empty((4, 3)), np.empty((3, 3))
    center, world_normal, touch = np.empty(3), np.empty(3), np.empty(3)
    arm, relative = np.empty(3), np.empty(3)
    valid = np.isfinite(reading.sum()) and np.abs(position).max() < _LOST_DISTANCE
    _write_rotation(quaternion, rotation)
    for i in range(count):
        angles = joints[3 * i : 3 * i + 3]
        rates = joints[3 * (count + i) : 3 * (count + i) + 3]
        trace_finger(bases[i], rotations[i], lengths, angles, origins, axes)
        for k in range(3):
            center[k] = 0.0
            for m in range(3):
                center[k] += rotation[m, k] * (origins[3, m] - position[m])
        gaps[i] = _nearest_on_box(center, half_extents, points[i], normals[i]) - radius
        for k in range(3):
            world_normal[k] = 0.0
            for m in range(3):
                world_normal[k] += rotation[k, m] * normals[i, m]
            touch[k] = origins[3, k] + radius * world_normal[k]
            arm[k] = touch[k] - position[k]
        write_point_jacobian(origins, axes, touch, jacobians[i])
        write_gravity_torques(origins, axes, masses, fractions, gravity, torques[3 * i : 3 * i + 3])
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            object_speed = velocity[k] + velocity[3 + a] * arm[b] - velocity[3 + b] * arm[a]
            relative[k] = -object_speed
            for m in range(3):
                relative[k] += jacobians[i, k, m] * rates[m]
        slip[i] = _slip_speed(relative, world_normal)
    return valid, rotation, points, normals, gaps, slip, jacobians, torques


def take_snapshot(
    kinematics: HandKinematics,
    half_extents: np.ndarray,
    gravity: np.ndarray,
    reading: np.ndarray,
) -> Snapshot:
    """Compute contact geometry, Jacobians and gravity torques in one compiled pass.

    Args:
        kinematics: The hand.
        half_extents: Of the cuboid [m], (3,).
        gravity: Acceleration [m/s^2], (3,), world frame.
        reading: What was read from the server, (6N + 13,): angles [rad] and speeds [rad/s] of the
            joints; position [m], quaternion (x y z w), linear [m/s] and angular [rad/s] velocity
            of the object, world frame.

    Returns:
        The snapshot, not `valid` where a number is not finite or the object is lost. Its
        `jacobians` (N, 3, 3) map the speeds of a finger's own joints to the world velocity of its
        tip's contact point.
    """
    hand = kinematics
    return Snapshot(
        *_observe(
            hand.bases, hand.rotations, hand.lengths, hand.masses, hand.fractions,
            hand.hand.tip_radius, half_extents, gravity, reading,
        )
    )  # fmt: skip
