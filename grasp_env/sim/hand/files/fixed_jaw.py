"""Grippers with one moving jaw: the palm's own jaw becomes the second fingertip.

The arm that carries such a gripper moves while the jaw closes, until the fixed jaw touches, too. A
hand's palm does not move. Instead the tip of the fixed jaw slides a few millimetres, pushed by a
motor that is as strong as an arm. So the moving jaw's motor sets the squeeze, and structure carries
the forces along the fixed jaw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from grasp_env import core
from grasp_env.inputs.arguments import Array
from grasp_env.sim.hand.files.joints import frames_at
from grasp_env.sim.hand.frames import roll_pitch_yaw
from grasp_env.sim.hand.solids import hull_of, outline
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Palm
from grasp_env.sim.mesh_shape import hull_faces

TRAVEL = 0.006  # way of the fixed jaw's tip [m]
ARM_FORCE = 100.0  # with which the arm pushes it [N]
_FRONT = 0.004  # distance by which the tip stands before the jaw at the start of its way [m]
_POSTURES = 60  # of the moving jaw
_CLOSED = 0.025  # largest gap of closed jaws [m]
_OPEN = 0.02  # least change of the gap between jaws that close and open [m]
_MASS = 0.05  # of the fixed jaw's tip [kg]; it hardly counts beside the arm's force


def fixed_jaw(
    palm: Palm, links: Sequence[Link], tip: Fingertip
) -> tuple[Link, Fingertip, str] | None:
    """Return the palm's own jaw as a link with a fingertip, and a sentence on it.

    None if the only finger, which ends in `tip`, has several motors or does not close against the
    palm.
    """
    motors = [link for link in links if link.mimic is None]
    if len(motors) != 1 or not np.isfinite(motors[0].lower):
        return None
    surfaces = list[core.Surface]()
    for shape in palm.collision:
        corners, faces = hull_faces(hull_of(outline(shape)).points)
        surfaces.append(core.Surface.mesh(corners, faces.astype(float), [corners]))
    if not surfaces:
        return None
    nearest = list[tuple[Array, Array, float]]()
    for share in np.linspace(0.0, 1.0, _POSTURES).tolist():
        frame = frames_at(links, share)[tip.link]
        center = frame.rotation @ tip.center + frame.origin
        nearest.append(min((surface.nearest(center) for surface in surfaces), key=_gap))
    gaps = np.array([_gap(row) for row in nearest]) - tip.radius
    closed = int(gaps.argmin())
    if gaps[closed] > _CLOSED or gaps.max() - gaps[closed] < _OPEN:
        return None
    point, inward, _ = nearest[closed]
    jaw = _jaw(palm, links, point, -inward, tip.radius)
    where = np.round(1e3 * point, 1).tolist()
    return (
        jaw,
        Fingertip(jaw.name, jaw.name, jaw.collision[0].origin, tip.radius),
        f"one jaw moves, and the palm {palm.name!r} is the other, with a fingertip at {where} mm: this tip slides by up to "
        f"{1e3 * TRAVEL:g} mm, as the arm moves while the jaw closes, with up to {ARM_FORCE:g} N; name other tips as fingertips=",
    )


def _gap(nearest: tuple[Array, Array, float]) -> float:
    return nearest[2]


def _jaw(palm: Palm, links: Sequence[Link], point: Array, outward: Array, radius: float) -> Link:
    """Return the link that slides along `outward` (3,) from a point of the palm (3,) [m]."""
    side = np.eye(3)[np.abs(outward).argmin()]
    across: Any = np.cross(outward, side)
    across /= np.linalg.norm(across)
    third: Any = np.cross(outward, across)
    frame = np.column_stack([across, third, outward])
    x, y, z = point.tolist()
    center = (0.0, 0.0, _FRONT - radius)
    ball = 0.4 * _MASS * radius**2
    sphere = Geometry("sphere", (radius,), center)
    return Link(
        name=_free_name("fixed_jaw", [palm.name, *(link.name for link in links)]),
        parent=palm.name,
        origin=(x, y, z),
        rotation=roll_pitch_yaw(frame),
        axis=(0.0, 0.0, 1.0),
        lower=0.0,
        upper=TRAVEL,
        torque_limit=ARM_FORCE,
        mass=_MASS,
        center=center,
        inertia=(ball, 0.0, 0.0, ball, 0.0, ball),
        collision=(sphere,),
        visual=(sphere,),
        sliding=True,
    )


def _free_name(name: str, taken: list[str]) -> str:
    return name if name not in taken else _free_name(f"{name}_", taken)
