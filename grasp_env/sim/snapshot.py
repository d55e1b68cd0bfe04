"""State of a scene after a step, as named arrays."""

from __future__ import annotations

from typing import NamedTuple

from grasp_env._check import Array


class Snapshot(NamedTuple):
    """Views of the core's struct of that name, which the next reading overwrites; N tips, M joints.

    The geometry is computed from the current poses, for spherical tips and the object's surface. An engine's own contact points belong
    to the start of the last step, and a finger that does not touch has none. Only the forces are the engine's.

    Attributes:
        position: (3,) centre of the object [m], world.
        rotation: (3, 3) object frame to world frame.
        linear: (3,) velocity of the object [m/s], world.
        angular: (3,) angular velocity of the object [rad/s], world.
        points: (N, 3) point of the surface nearest to each tip [m], object frame.
        normals: (N, 3) inward unit normal there, object frame.
        touch: (N, 3) point of the tip nearest to the object [m], world.
        tips: (N, 3) centres of the tips [m], world.
        gaps: (N,) distance between tip and object [m], negative if they overlap.
        slip: (N,) tangential speed of the tip relative to the object [m/s].
        touching: (N,) 1.0 if the tip carried force in the last step, else 0.0.
        forces: (N, 3) measured force of each tip ON the object [N], object frame.
        stray: (1,) total force on the object [N] from other parts of the hand: other links, and tips' links more than 5 mm from the tip's
            point.
        gravity_torques: (M,) joint torques that carry the weight of the links [N m].
        angles, rates: (M,) joint angles [rad] and rates [rad/s].
        frames, origins, axes: (M, 3, 3), (M, 3) [m], (M, 3) of links and joints, world frame.
    """

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
    gravity_torques: Array
    angles: Array
    rates: Array
    frames: Array
    origins: Array
    axes: Array
