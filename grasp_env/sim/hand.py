"""The hand as data: where its fingers are fixed, how long, how heavy and how strong they are.

The finger frame has x along the hanging finger, z along its pressing direction and y = z x x.
Joint 1 swings the finger sideways (about z), joints 2 and 3 flex it towards the object: at zero
angles a finger hangs straight along x, and a positive flexion moves its tip along z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from grasp_env.errors import InvalidInputError

Vector3: TypeAlias = tuple[float, float, float]

JOINTS_PER_FINGER = 3


@dataclass(frozen=True)
class FingerDescription:
    """How one finger is fixed to the palm.

    Attributes:
        name: Used for its links and joints.
        base: Position of the first joint [m], (3,), world frame.
        press: Unit direction in which flexion moves the tip, (3,), world frame.
        hang: Unit direction of the straight finger, (3,), world frame, orthogonal to `press`.
        color: Red, green and blue in [0, 1].
    """

    name: str
    base: Vector3
    press: Vector3
    hang: Vector3 = (0.0, -1.0, 0.0)
    color: Vector3 = (0.5, 0.5, 0.5)

    def __post_init__(self) -> None:
        axes = np.array([self.hang, self.press], dtype=float)
        if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-9):
            raise InvalidInputError(
                f"finger {self.name!r}: press={self.press} and hang={self.hang} must be "
                "orthogonal unit vectors; normalise them and turn one by 90 degrees"
            )

    @property
    def rotation(self) -> np.ndarray:
        """Finger frame to world frame, (3, 3)."""
        hang, press = np.array(self.hang, dtype=float), np.array(self.press, dtype=float)
        return np.column_stack([hang, np.cross(press, hang), press])


@dataclass(frozen=True)
class HandDescription:
    """A hand of equal fingers, each with three torque-controlled revolute joints.

    Attributes:
        fingers: One description per finger, in the order of the contacts.
        link_lengths: Knuckle, proximal and distal link [m].
        link_masses: Knuckle, proximal, distal link and tip [kg].
        link_radius: Radius of the capsules drawn for the links [m]; links do not collide.
        tip_radius: Radius of the spherical tip, centred at the end of the distal link [m].
        tip_friction: Bullet multiplies the friction of both bodies, so 1 leaves the object's.
        torque_limit: Largest torque of every joint [N m].
        joint_lower: Lower limits of swing, first and second flexion [rad].
        joint_upper: Upper limits of swing, first and second flexion [rad].
        palm_center: Centre of the palm's box [m], world frame.
        palm_half_extents: Half of the palm's sides [m].
    """

    fingers: tuple[FingerDescription, ...]
    link_lengths: Vector3 = (0.035, 0.08, 0.07)
    link_masses: tuple[float, float, float, float] = (0.02, 0.03, 0.02, 0.01)
    link_radius: float = 0.0075
    tip_radius: float = 0.01
    tip_friction: float = 1.0
    torque_limit: float = 12.0
    joint_lower: Vector3 = (-1.0, -1.8, 0.05)
    joint_upper: Vector3 = (1.0, 1.2, 2.6)
    palm_center: Vector3 = (0.0, 0.145, 0.0)
    palm_half_extents: Vector3 = (0.062, 0.008, 0.118)

    def __post_init__(self) -> None:
        positive = {
            "link_lengths": self.link_lengths,
            "link_masses": self.link_masses,
            "tip_radius": (self.tip_radius,),
            "torque_limit": (self.torque_limit,),
        }
        for name, values in positive.items():
            if not all(math.isfinite(value) and value > 0 for value in values):
                raise InvalidInputError(f"{name}={values} must be finite and above 0")
        if not self.fingers:
            raise InvalidInputError("fingers=() is empty; describe at least one finger")
        if any(low >= up for low, up in zip(self.joint_lower, self.joint_upper, strict=True)):
            raise InvalidInputError(f"joint_lower={self.joint_lower} must be below joint_upper={self.joint_upper}")

    @property
    def joint_count(self) -> int:
        """Number of driven joints, three per finger."""
        return JOINTS_PER_FINGER * len(self.fingers)

    @property
    def distal_center(self) -> float:
        """Centre of mass of the distal link with its tip [m], from the knee along the link."""
        distal, tip = self.link_masses[2:]
        return self.link_lengths[2] * (0.5 * distal + tip) / (distal + tip)

    @staticmethod
    def four_finger() -> HandDescription:
        """The hand of the reference grasp: a thumb at z < 0 and three fingers at z > 0."""
        back, front = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
        return HandDescription(
            fingers=(
                FingerDescription("thumb", (0.0, 0.135, -0.09), back, color=(0.85, 0.33, 0.24)),
                FingerDescription("middle", (0.0, 0.135, 0.105), front, color=(0.20, 0.50, 0.80)),
                FingerDescription("left", (-0.045, 0.135, 0.09), front, color=(0.95, 0.69, 0.20)),
                FingerDescription("right", (0.045, 0.135, 0.09), front, color=(0.27, 0.65, 0.42)),
            )
        )
