"""Describe hanging fingers of three or four joints, and turn them into links.

The finger frame has x along the straight finger, z along its pressing direction and y = z x x. At
zero angles the finger is straight. The first joint swings it sideways (about z). The other joints
flex it: a positive flexion moves the tip along z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.sim.hand.check import Vector3, limits, numbers, positive, unit, word
from grasp_env.sim.hand.frames import roll_pitch_yaw
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link

_LINK_NAMES = {3: ("knuckle", "proximal", "distal"), 4: ("knuckle", "proximal", "middle", "distal")}
_ALONG_X: Vector3 = (0.0, math.pi / 2, 0.0)  # turns a capsule's axis from z to the link's x
_JOINT_COLOR = (0.30, 0.32, 0.36)
_TIP_COLOR = (0.13, 0.13, 0.15)
_JOINT_TO_LINK = 1.5  # radius of the ball drawn at a joint, relative to the radius of the links


@dataclass(frozen=True)
class FingerDescription:
    """The mounting, lengths, masses and strength of one finger.

    The fields with one number per joint all have three numbers (swing, two flexions) or four
    (swing, three flexions).

    Attributes:
        name: Prefix of the names of its links and joints, and name of its fingertip.
        base: Position of the first joint [m], (3,), world frame.
        press: Unit direction in which flexion moves the tip, (3,), world frame.
        hang: Unit direction of the straight finger, (3,), world frame, orthogonal to `press`.
        color: Red, green and blue in [0, 1].
        link_lengths: Lengths from the knuckle to the distal link [m].
        link_masses: Masses from the knuckle to the distal link, without the tip [kg].
        tip_mass: Mass of the tip [kg].
        link_radius: Radius of the links' capsules [m].
        tip_radius: Radius of the spherical tip, centred at the end of the distal link [m].
        torque_limit: Largest torque of every joint [N m].
        joint_lower: Lower joint limits [rad].
        joint_upper: Upper joint limits [rad].
        home: Rest posture [rad].

    Example:
        >>> FingerDescription("thumb", base=(0.0, 0.12, -0.1), press=(0.0, 0.0, 1.0), torque_limit=0.5).link_lengths
        (0.035, 0.08, 0.07)
    """

    name: str
    base: Vector3
    press: Vector3
    hang: Vector3 = (0.0, -1.0, 0.0)
    color: Vector3 = (0.5, 0.5, 0.5)
    link_lengths: tuple[float, ...] = (0.035, 0.08, 0.07)
    link_masses: tuple[float, ...] = (0.02, 0.03, 0.02)
    tip_mass: float = 0.01
    link_radius: float = 0.0075
    tip_radius: float = 0.01
    torque_limit: float = 12.0
    joint_lower: tuple[float, ...] = (-1.0, -1.8, 0.05)
    joint_upper: tuple[float, ...] = (1.0, 1.2, 2.6)
    home: tuple[float, ...] = (0.0, -0.6, 1.2)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", word(self.name, "name of a finger"))
        name = f"finger {self.name!r}"
        press = unit(self.press, f"{name}: press")
        hang = unit(self.hang, f"{name}: hang")
        if abs(np.dot(press, hang)) > 1e-9:
            raise InvalidInputError(
                f"{name}: press={press} and hang={hang} must be orthogonal; turn one of them by 90 degrees"
            )
        lengths = numbers(self.link_lengths, None, f"{name}: link_lengths")
        if len(lengths) not in _LINK_NAMES:
            raise InvalidInputError(
                f"{name}: link_lengths={lengths} has {len(lengths)} links; a finger has 3 or 4. "
                "Build other hands of Link objects, or from a URDF"
            )
        rows = {
            field: numbers(getattr(self, field), len(lengths), f"{name}: {field}")
            for field in _ROWS
        }
        for field in ("link_lengths", "link_masses"):
            for value in rows[field]:
                positive(value, f"{name}: {field}")
        for field in ("tip_mass", "link_radius", "tip_radius", "torque_limit"):
            positive(getattr(self, field), f"{name}: {field}")
        for low, high in zip(rows["joint_lower"], rows["joint_upper"], strict=True):
            limits(low, high, f"{name}: joint_lower and joint_upper [rad]")
        rows |= {"base": numbers(self.base, 3, f"{name}: base"), "press": press, "hang": hang}
        for field, value in rows.items():
            object.__setattr__(self, field, value)

    @property
    def rotation(self) -> np.ndarray:
        """Rotation from finger frame to world frame, (3, 3)."""
        hang = np.array(self.hang)
        press = np.array(self.press)
        return np.column_stack([hang, np.cross(press, hang), press])

    def links(self, palm: str) -> tuple[Link, ...]:
        """Return the links of the finger; the parent of the first is the link `palm`."""
        names = [palm, *(f"{self.name}_{kind}" for kind in _LINK_NAMES[len(self.link_lengths)])]
        return tuple(
            self._link(index, names[index + 1], names[index])
            for index in range(len(self.link_lengths))
        )

    def fingertip(self) -> Fingertip:
        """Return the sphere at the end of the distal link."""
        return Fingertip(
            self.name, f"{self.name}_distal", (self.link_lengths[-1], 0.0, 0.0), self.tip_radius
        )

    def _link(self, index: int, name: str, parent: str) -> Link:
        first = index == 0
        last = index == len(self.link_lengths) - 1
        length = self.link_lengths[index]
        radius = self.link_radius
        mass, center, along, across = _rod(self.link_masses[index], length, radius)
        collision = (_capsule(radius, length),)
        visual = (
            _capsule(radius, length),
            Geometry("sphere", (_JOINT_TO_LINK * radius,), color=_JOINT_COLOR),
        )
        if last:
            mass, center, along, across = self._with_tip(mass, center, along, across)
            tip: Vector3 = (length, 0.0, 0.0)
            # the capsule's round end stops at the tip's centre, so only the tip touches the object
            short = (_capsule(radius, length - radius),) if length > radius else ()
            collision = (*short, Geometry("sphere", (self.tip_radius,), tip))
            visual += (Geometry("sphere", (self.tip_radius,), tip, color=_TIP_COLOR),)
        origin = self.base if first else (self.link_lengths[index - 1], 0.0, 0.0)
        rotation = roll_pitch_yaw(self.rotation) if first else (0.0, 0.0, 0.0)
        axis = (0.0, 0.0, 1.0) if first else (0.0, -1.0, 0.0)
        inertia = (along, 0.0, 0.0, across, 0.0, across)
        return Link(
            name,
            parent,
            origin,
            rotation,
            axis,
            self.joint_lower[index],
            self.joint_upper[index],
            self.torque_limit,
            mass,
            (center, 0.0, 0.0),
            inertia,
            collision,
            visual,
            self.color,
        )

    def _with_tip(
        self, mass: float, center: float, along: float, across: float
    ) -> tuple[float, float, float, float]:
        """Return mass, centre and moments of the distal link including the solid sphere of its tip."""
        length = self.link_lengths[-1]
        ball = 0.4 * self.tip_mass * self.tip_radius**2
        total = mass + self.tip_mass
        middle = (mass * center + self.tip_mass * length) / total
        across += mass * (middle - center) ** 2 + self.tip_mass * (length - middle) ** 2
        return total, middle, along + ball, across + ball


_ROWS = ("link_lengths", "link_masses", "joint_lower", "joint_upper", "home")


def _capsule(radius: float, length: float) -> Geometry:
    return Geometry("capsule", (radius, length), (0.5 * length, 0.0, 0.0), _ALONG_X)


def _rod(mass: float, length: float, radius: float) -> tuple[float, float, float, float]:
    """Return mass [kg], centre [m] and the moments along and across [kg m^2] of a solid cylinder
    along x.
    """
    return mass, 0.5 * length, 0.5 * mass * radius**2, mass * (length**2 / 12 + radius**2 / 4)
