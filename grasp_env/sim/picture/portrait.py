"""A picture of a hand by itself: how it looks, beside the shapes it touches with and its fingertips."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace

import numpy as np

from grasp_env._check import Array
from grasp_env.sim.client import Client, bullet
from grasp_env.sim.hand.description import Geometry, HandDescription, Link, Palm
from grasp_env.sim.hand.frames import Frame, roll_pitch_yaw
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.hand.solids import outline
from grasp_env.sim.hand.urdf import hand_files
from grasp_env.sim.picture.camera import shoot
from grasp_env.sim.picture.pixels import gradient, put_background
from grasp_env.sim.picture.view import View

_TIP = (0.90, 0.25, 0.15)
_SOLID = (0.62, 0.70, 0.80)
_PALM = (0.45, 0.50, 0.58)
_FINE = 2
_ROOM = 0.04  # of the picture, left free around the hand


def portrait(hand: HandDescription, size: int = 640, angles: Array | None = None) -> np.ndarray:
    """A picture (size, 2 size, 3) uint8: the hand's looks, and what of it touches, its fingertips red.

    The palm is below the fingertips, and they close towards the camera, as far as a hand has such sides.

    Args:
        hand: To be drawn.
        size: Of one half [pixels].
        angles: Of its joints [rad], (M,); None: `home`.
    """
    posture = np.array(hand.home) if angles is None else angles
    upright = _upright(hand, posture)
    return np.hstack([_picture(each, posture, size) for each in (upright, _solid(upright))])


def _solid(hand: HandDescription) -> HandDescription:
    """The hand with its collision shapes as its looks."""
    spheres = {(tip.link, tip.center) for tip in hand.fingertips}

    def body(part: Link | Palm, color: tuple[float, float, float]) -> tuple[Geometry, ...]:
        return tuple(
            replace(shape, color=_TIP if shape.kind == "sphere" and (part.name, shape.origin) in spheres else color)
            for shape in part.collision
        )

    links = tuple(replace(link, visual=body(link, _SOLID)) for link in hand.links)
    return replace(hand, palm=replace(hand.palm, visual=body(hand.palm, _PALM)), links=links)


def _upright(hand: HandDescription, angles: Array) -> HandDescription:
    """The hand turned so that its tips are above its palm, y up, and close towards z."""
    kinematics = HandKinematics(hand)
    tips = kinematics.tips(angles)
    solid = [outline(shape) for shape in hand.palm.collision]
    up = tips.mean(axis=0) - (np.vstack(solid).mean(axis=0) if solid else 0.0)
    finite = np.isfinite(kinematics.lower)
    # a little further, the way that is nearer to each joint's far limit: the way fingers close
    far = np.where(np.abs(kinematics.upper) > np.abs(kinematics.lower), kinematics.upper, kinematics.lower)
    closing = kinematics.tips(np.where(finite, 0.8 * angles + 0.2 * np.where(finite, far, 0.0), angles)) - tips
    ahead = closing.mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9) if up.any() else np.array([0.0, 1.0, 0.0])
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.cross(up, (1.0, 0.0, 0.0)) if abs(up[0]) < 0.9 else np.cross(up, (0.0, 1.0, 0.0))
    ahead = ahead / np.linalg.norm(ahead)
    rotation = np.array([np.cross(up, ahead), up, ahead])
    x, y, z = Frame(rotation, np.zeros(3)).origin.tolist()
    return hand.moved((x, y, z), roll_pitch_yaw(rotation))


def _picture(hand: HandDescription, angles: Array, size: int) -> np.ndarray:
    kinematics = HandKinematics(hand)
    rotations, origins = kinematics.links(angles)
    points = [outline(shape) for shape in hand.palm.collision]
    for link, rotation, origin in zip(hand.links, rotations, origins, strict=True):
        points += [outline(shape) @ rotation.T + origin for shape in link.collision]
    points += [kinematics.tips(angles), origins]
    wide = size * _FINE
    view = View((0.45, 0.35, 1.0), (0.0, 0.0, 0.0), 20.0, wide, wide).fitted(np.vstack(points), _ROOM, _ROOM)
    client = Client(False)
    with tempfile.TemporaryDirectory() as folder:
        for name, text in hand_files(hand).items():
            with open(os.path.join(folder, name), "w", encoding="utf-8") as file:
                file.write(text)
        try:
            number = client.number
            body = bullet.loadURDF(os.path.join(folder, "hand.urdf"), useFixedBase=True, physicsClientId=number)
            names = [bullet.getJointInfo(body, index, number)[1].decode() for index in range(hand.joint_count)]
            for name, angle in zip(hand.joint_names, angles.tolist(), strict=True):
                bullet.resetJointState(body, names.index(name), angle, physicsClientId=number)
            pixels, depth = shoot(number, view, wide, wide, shadows=True)
        finally:
            client.close()
    image = put_background(pixels, depth, gradient(wide, wide, (253, 253, 254), (226, 231, 238)))
    split = image[..., :3].reshape(size, _FINE, size, _FINE, 3)
    return split.mean(axis=(1, 3)).round().astype(np.uint8)
