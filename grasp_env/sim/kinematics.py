"""Positions, Jacobians and gravity torques of all fingers, compiled, and the inverse kinematics.

PyBullet offers the same, one finger and one call at a time (about 17 us each); these kernels take
about a microsecond for the hand. The tests compare the two.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env._compile import compiled
from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand import HandDescription


@compiled
def trace_finger(base, rotation, lengths, angles, origins, axes):
    """Write the joints of one finger: origins (4, 3), the last one the tip, and axes (3, 3)."""
    swing_cos, swing_sin = math.cos(angles[0]), math.sin(angles[0])
    first_cos, first_sin = math.cos(angles[1]), math.sin(angles[1])
    second_cos, second_sin = math.cos(angles[1] + angles[2]), math.sin(angles[1] + angles[2])
    for k in range(3):
        hang = rotation[k, 0] * swing_cos + rotation[k, 1] * swing_sin
        press = rotation[k, 2]
        axes[0, k] = press
        axes[1, k] = rotation[k, 0] * swing_sin - rotation[k, 1] * swing_cos
        axes[2, k] = axes[1, k]
        origins[0, k] = base[k]
        origins[1, k] = base[k] + lengths[0] * hang
        origins[2, k] = origins[1, k] + lengths[1] * (first_cos * hang + first_sin * press)
        origins[3, k] = origins[2, k] + lengths[2] * (second_cos * hang + second_sin * press)


@compiled
def write_point_jacobian(origins, axes, point, jacobian):
    """Write the velocity of a point of the distal link per joint speed, (3, 3)."""
    for j in range(3):
        x, y, z = point[0] - origins[j, 0], point[1] - origins[j, 1], point[2] - origins[j, 2]
        jacobian[0, j] = axes[j, 1] * z - axes[j, 2] * y
        jacobian[1, j] = axes[j, 2] * x - axes[j, 0] * z
        jacobian[2, j] = axes[j, 0] * y - axes[j, 1] * x


@compiled
def write_gravity_torques(origins, axes, masses, fractions, gravity, torques):
    """Write the torques of one finger that carry the weight of its links, (3,)."""
    center, lever = np.empty(3), np.empty((3, 3))
    torques[:] = 0.0
    for link in range(3):
        for k in range(3):
            step = origins[link + 1, k] - origins[link, k]
            center[k] = origins[link, k] + fractions[link] * step
        write_point_jacobian(origins, axes, center, lever)
        for j in range(link + 1):
            for k in range(3):
                torques[j] -= masses[link] * gravity[k] * lever[k, j]


@compiled
def _hand_tips(bases, rotations, lengths, angles):
    tips, origins, axes = np.empty((len(bases), 3)), np.empty((4, 3)), np.empty((3, 3))
    for i in range(len(bases)):
        trace_finger(bases[i], rotations[i], lengths, angles[3 * i : 3 * i + 3], origins, axes)
        tips[i] = origins[3]
    return tips


class HandKinematics:
    """The geometry and masses of a hand as arrays, with what follows from them.

    Attributes:
        bases: First joints [m], (N, 3), world frame.
        rotations: Finger frames to world frame, (N, 3, 3).
        lengths: Knuckle, proximal and distal link [m], (3,).
        masses: Of the three moving links, the tip counted with the distal one [kg], (3,).
        fractions: Centre of mass of each link as a part of its length, (3,).
    """

    def __init__(self, hand: HandDescription) -> None:
        self.hand = hand
        self.bases = np.array([finger.base for finger in hand.fingers], dtype=float)
        self.rotations = np.array([finger.rotation for finger in hand.fingers])
        self.lengths = np.array(hand.link_lengths, dtype=float)
        knuckle, proximal, distal, tip = hand.link_masses
        self.masses = np.array([knuckle, proximal, distal + tip])
        self.fractions = np.array([0.5, 0.5, hand.distal_center / hand.link_lengths[2]])

    def tips(self, angles: np.ndarray) -> np.ndarray:
        """Centres of the tips [m], (N, 3), world frame, for joint angles (3N,) [rad]."""
        return _hand_tips(self.bases, self.rotations, self.lengths, angles)

    def solve(self, tips: np.ndarray) -> np.ndarray:
        """Joint angles that bring the tips to the given centres, the knees bent outwards.

        Args:
            tips: Centres of the tips [m], (N, 3), world frame.

        Returns:
            Angles [rad], (3N,).

        Raises:
            InvalidInputError: A tip is out of reach, or only beyond a joint limit.
        """
        angles = np.concatenate([self._solve_finger(i, tip) for i, tip in enumerate(tips)])
        residual = np.abs(self.tips(angles) - tips).max()
        if residual > 1e-9:
            raise InvalidInputError(
                f"the inverse kinematics missed tips={tips.tolist()} by {residual:.1e} m; move "
                "them away from the axes of the first joints"
            )
        return angles

    def _solve_finger(self, index: int, tip: np.ndarray) -> np.ndarray:
        hand, finger = self.hand, self.hand.fingers[index]
        knuckle, proximal, distal = hand.link_lengths
        hang, side, press = self.rotations[index].T @ (tip - self.bases[index])
        down = math.hypot(hang, side) - knuckle
        reach = math.hypot(down, press)
        if not abs(proximal - distal) < reach < proximal + distal:
            raise InvalidInputError(
                f"finger {finger.name!r} cannot reach tip={np.round(tip, 4).tolist()}: it is "
                f"{reach:.4f} m from its knuckle, allowed are {abs(proximal - distal):.4f} to "
                f"{proximal + distal:.4f} m; move the contact or the finger's base"
            )
        cosine = (reach**2 - proximal**2 - distal**2) / (2 * proximal * distal)
        knee = math.acos(cosine)
        bend = math.atan2(distal * math.sin(knee), proximal + distal * cosine)
        angles = np.array([math.atan2(side, hang), math.atan2(press, down) - bend, knee])
        if np.any(angles < hand.joint_lower) or np.any(angles > hand.joint_upper):
            raise InvalidInputError(
                f"finger {finger.name!r} needs angles={np.round(angles, 3).tolist()} rad for "
                f"tip={np.round(tip, 4).tolist()}, allowed are {hand.joint_lower} to "
                f"{hand.joint_upper}; move the contact, the finger's base or the limits"
            )
        return angles
