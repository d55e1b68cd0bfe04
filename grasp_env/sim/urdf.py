"""The URDF text of a hand: a fixed palm and, per finger, a knuckle, a proximal and a distal link.

Only the tips collide. The tip is part of the distal link, which keeps the tree at three links per
finger; its mass is counted in that link's inertia.
"""

from __future__ import annotations

import math

import numpy as np

from grasp_env.sim.hand import FingerDescription, HandDescription

_QUARTER = repr(math.pi / 2)  # turns a capsule from z, its axis in URDF, to x, the links' axis
_PALM_COLOR = (0.17, 0.19, 0.23)
_JOINT_COLOR = (0.30, 0.32, 0.36)
_TIP_COLOR = (0.13, 0.13, 0.15)
_JOINT_TO_LINK = 1.5  # radius of the ball drawn at a joint to that of the links


def _numbers(values: tuple[float, ...] | np.ndarray) -> str:
    """Numbers with all their digits: the compiled kinematics must agree to the last one."""
    return " ".join(repr(float(value)) for value in values)


def _roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """URDF angles of a rotation matrix: Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    if math.hypot(rotation[0, 0], rotation[1, 0]) < 1e-12:  # gimbal lock: all turning in the yaw
        return 0.0, pitch, math.atan2(-rotation[0, 1], rotation[1, 1])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def _material(name: str, color: tuple[float, ...]) -> str:
    return f'<material name="{name}"><color rgba="{_numbers(color)} 1"/></material>'


def _visual(shape: str, x: float, name: str, color: tuple[float, ...], pitch: str = "0") -> str:
    return (
        f'<visual><origin xyz="{x!r} 0 0" rpy="0 {pitch} 0"/><geometry>{shape}</geometry>'
        f"{_material(name, color)}</visual>"
    )


def _inertial(mass: float, center: float, along: float, across: float) -> str:
    """Inertia about the centre of mass of a link along x [kg m^2]."""
    return (
        f'<inertial><origin xyz="{center!r} 0 0"/><mass value="{mass!r}"/><inertia '
        f'ixx="{along!r}" iyy="{across!r}" izz="{across!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _rod(mass: float, length: float, radius: float) -> tuple[float, float]:
    """Inertia of a solid cylinder about its axis and across it [kg m^2]."""
    return 0.5 * mass * radius**2, mass * (length**2 / 12 + radius**2 / 4)


def _distal_inertial(hand: HandDescription) -> str:
    """Inertial element of the distal link with the solid sphere of its tip."""
    (_, _, rod_mass, tip_mass), length = hand.link_masses, hand.link_lengths[2]
    center, ball = hand.distal_center, 0.4 * tip_mass * hand.tip_radius**2
    along, across = _rod(rod_mass, length, hand.link_radius)
    across += rod_mass * (center - 0.5 * length) ** 2 + tip_mass * (length - center) ** 2
    return _inertial(rod_mass + tip_mass, center, along + ball, across + ball)


def _joint(hand: HandDescription, index: int, parent: str, child: str, origin: str) -> str:
    axis = ("0 0 1", "0 -1 0", "0 -1 0")[index]
    return (
        f'<joint name="{child}_joint" type="revolute"><parent link="{parent}"/>'
        f'<child link="{child}"/>{origin}<axis xyz="{axis}"/>'
        f'<limit lower="{hand.joint_lower[index]!r}" upper="{hand.joint_upper[index]!r}" '
        f'effort="{hand.torque_limit!r}" velocity="100"/></joint>'
    )


def _finger(hand: HandDescription, finger: FingerDescription) -> str:
    """Joints and links of one finger."""
    parts, parent = [], "palm"
    for index, kind in enumerate(("knuckle", "proximal", "distal")):
        child, length = f"{finger.name}_{kind}", hand.link_lengths[index]
        if index == 0:
            angles = _numbers(_roll_pitch_yaw(finger.rotation))
            origin = f'<origin xyz="{_numbers(finger.base)}" rpy="{angles}"/>'
        else:
            origin = f'<origin xyz="{hand.link_lengths[index - 1]!r} 0 0"/>'
        capsule = f'<capsule radius="{hand.link_radius!r}" length="{length!r}"/>'
        ball = f'<sphere radius="{_JOINT_TO_LINK * hand.link_radius!r}"/>'
        body = _visual(capsule, 0.5 * length, child, finger.color, _QUARTER)
        body += _visual(ball, 0.0, f"{child}_ball", _JOINT_COLOR)
        if index < 2:
            mass = hand.link_masses[index]
            body += _inertial(mass, 0.5 * length, *_rod(mass, length, hand.link_radius))
        else:
            sphere = f'<sphere radius="{hand.tip_radius!r}"/>'
            body += _distal_inertial(hand) + _visual(sphere, length, f"{child}_tip", _TIP_COLOR)
            body += f'<collision><origin xyz="{length!r} 0 0"/><geometry>{sphere}</geometry></collision>'
        parts += [_joint(hand, index, parent, child, origin), f'<link name="{child}">{body}</link>']
        parent = child
    return "\n".join(parts)


def hand_urdf(hand: HandDescription) -> str:
    """The hand as a URDF document, its palm frame equal to the world frame."""
    box = f'<box size="{_numbers(tuple(2 * side for side in hand.palm_half_extents))}"/>'
    palm = (
        f'<link name="palm"><inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" '
        f'ixz="0" iyz="0"/></inertial><visual><origin xyz="{_numbers(hand.palm_center)}"/>'
        f"<geometry>{box}</geometry>{_material('palm', _PALM_COLOR)}</visual></link>"
    )
    fingers = "\n".join(_finger(hand, finger) for finger in hand.fingers)
    return f'<?xml version="1.0"?>\n<robot name="hand">\n{palm}\n{fingers}\n</robot>\n'
