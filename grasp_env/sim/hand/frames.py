"""Convert between rotation matrices and the roll, pitch and yaw of URDF, and compose frames."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.check import Vector3


def rotation_matrix(angles: Vector3) -> Array:
    """Return Rz(yaw) Ry(pitch) Rx(roll), (3, 3), for roll, pitch and yaw [rad]."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def axis_rotation(axis: Array, angle: float) -> Array:
    """Return the rotation (3, 3) about a unit axis (3,) by an angle [rad]."""
    cross = _cross(axis)
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def quaternion_rotation(quaternion: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion (4,): x, y, z, w."""
    cross = _cross(quaternion[:3])
    return np.eye(3) + 2.0 * (quaternion[3] * cross + cross @ cross)


def _cross(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def roll_pitch_yaw(rotation: Array) -> Vector3:
    """Return roll, pitch and yaw [rad] of a rotation matrix, accurate to the last digits also near
    gimbal lock.
    """
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    c = math.cos(yaw)
    s = math.sin(yaw)
    pitch = math.atan2(-rotation[2, 0], c * rotation[0, 0] + s * rotation[1, 0])
    # the roll of Rz(-yaw) times the rotation: it makes up for an inexact yaw
    roll = math.atan2(
        s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1]
    )
    return roll, pitch, yaw


class Frame(NamedTuple):
    """Pose of an inner frame in an outer one: p_outer = rotation @ p_inner + origin."""

    rotation: Array
    origin: Array

    @staticmethod
    def of(origin: Vector3, angles: Vector3) -> Frame:
        """Make a frame from an origin [m] and roll, pitch, yaw [rad]."""
        return Frame(rotation_matrix(angles), np.array(origin, dtype=float))

    @staticmethod
    def of_joint(axis: Array, angle: float, sliding: bool) -> Frame:
        """Return the motion of a joint about, or of a sliding one along, its unit axis (3,)."""
        return (
            Frame(np.eye(3), angle * axis)
            if sliding
            else Frame(axis_rotation(axis, angle), np.zeros(3))
        )

    def inverse(self) -> Frame:
        """Return the pose of the outer frame in the inner one."""
        return Frame(self.rotation.T, -self.rotation.T @ self.origin)

    def carry(self, origin: Vector3, angles: Vector3) -> tuple[Vector3, Vector3]:
        """Transform an origin [m] and roll, pitch, yaw [rad] to the outer frame; the identity
        changes no digit.
        """
        if not self.origin.any() and np.array_equal(self.rotation, np.eye(3)):
            return origin, angles
        return (self @ Frame.of(origin, angles)).numbers()

    def __matmul__(self, inner: Frame) -> Frame:
        return Frame(self.rotation @ inner.rotation, self.rotation @ inner.origin + self.origin)

    def numbers(self) -> tuple[Vector3, Vector3]:
        """Return the origin [m] and roll, pitch, yaw [rad]."""
        x, y, z = self.origin.tolist()
        return (x, y, z), roll_pitch_yaw(self.rotation)


IDENTITY = Frame(np.eye(3), np.zeros(3))
