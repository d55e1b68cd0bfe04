"""Motions of a held object: the fingers must reach their contacts along them, with tips only."""

from __future__ import annotations

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.grasping.points import limbs_of
from grasp_env.sim.hand.frames import quaternion_rotation
from grasp_env.sim.hand.kinematics import HandKinematics

_CLEARANCE = 0.001  # least distance of the links from the object [m]


def check_motion(grasp: SceneConfig, kinematics: HandKinematics, poses: Array) -> None:
    """Raise unless the fingers hold the object along a motion, and touch it with their tips only.

    Args:
        grasp: The object and its contacts.
        kinematics: The hand in its pose.
        poses: Poses of the object (K, 7): position [m] and quaternion (x, y, z, w), world frame.

    Raises:
        InvalidInputError: A finger does not reach its contact, or a link is nearer than 1 mm to
            the object.
    """
    points = np.array(grasp.contact_points)
    radii = np.array([tip.radius for tip in grasp.hand.fingertips])[:, None]
    tips = points - radii * grasp.contact_normals
    limbs = limbs_of(kinematics)
    surface = grasp.object.surface
    angles = np.array(grasp.start_angles) if grasp.start_angles else None
    for position, rotation in zip(
        poses[:, :3], map(quaternion_rotation, poses[:, 3:]), strict=True
    ):
        angles = kinematics.solve(position + tips @ rotation.T, angles)
        # the hand as the object sees it
        shift = -rotation.T @ position
        seen = limbs.moved(rotation.T.ravel().tolist(), shift.tolist(), kinematics.home)
        away, _ = seen.clearance(surface, angles, 2.0 * _CLEARANCE)
        if away < _CLEARANCE:
            raise InvalidInputError(
                f"the object moves to {np.round(position, 4).tolist()} m, where a link of the hand {grasp.hand.name!r} is "
                f"{1e3 * away:.1f} mm from it; at least {1e3 * _CLEARANCE:g} mm are needed: use a smaller motion, or another hand"
            )
