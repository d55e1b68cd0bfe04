"""State of a scene, as named arrays."""

from __future__ import annotations

from typing import NamedTuple

from grasp_env.inputs.arguments import Array


class Snapshot(NamedTuple):
    """Views of the core's arrays, which the next reading overwrites; N tips, M joints.

    Only the forces are the engine's. The geometry is computed from the current poses, for spherical
    tips and the object's surface: an engine's contact points belong to the start of the last step,
    and a finger that does not touch has none.
    """

    position: Array  # (3,) centre of the object [m], world frame
    rotation: Array  # (3, 3) from the object frame to the world frame
    linear: Array  # (3,) velocity of the object [m/s], world frame
    angular: Array  # (3,) angular velocity of the object [rad/s], world frame
    points: Array  # (N, 3) point of the surface nearest to each tip [m], object frame
    normals: Array  # (N, 3) inward unit normal there, object frame
    touch: Array  # (N, 3) point of the tip nearest to the object [m], world frame
    tips: Array  # (N, 3) centres of the tips [m], world frame
    gaps: Array  # (N,) distance between tip and object [m], negative if they overlap
    slip: Array  # (N,) tangential speed of the tip relative to the object [m/s]
    touching: Array  # (N,) 1.0 if the tip carried force in the last step, else 0.0
    forces: Array  # (N, 3) measured force of each tip ON the object [N], object frame
    # (1,) total force on the object [N] of other links, and of tips' links more than 5 mm from the
    # tip's point
    stray: Array
    gravity_torques: Array  # (M,) joint torques that carry the weight of the links [N m]
    angles: Array  # (M,) joint angles [rad]
    rates: Array  # (M,) joint rates [rad/s]
    frames: Array  # (M, 3, 3) rotations of the links, world frame
    origins: Array  # (M, 3) origins of the links [m], world frame
    axes: Array  # (M, 3) axes of the joints, world frame
