"""An object in a PyBullet server: its body and its dynamics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from grasp_env.sim.client import bullet
from grasp_env.sim.objects import ObjectDescription

UNDAMPED = {
    "linearDamping": 0.0,
    "angularDamping": 0.0,
    "jointDamping": 0.0,
    "restitution": 0.0,
    "rollingFriction": 0.0,
    "spinningFriction": 0.0,
}
"""Arguments of changeDynamics that undo Bullet's defaults."""

_Z_TO_Y = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # capsules and cylinders of Bullet lie along z


def create_body(client: int, item: ObjectDescription, color: tuple[float, float, float]) -> int:
    """Make an object at the origin and return its body number; the hand must be there already.

    Bullet's surface is that of `item.surface`. For cuboid, sphere and capsule its contacts are exact; its search for
    the nearest point takes corners within a centimetre for one, though: the normal and the distance are off by up to
    0.04 and 40 um on the round side of a cylinder, 0.006 and 16 um on a mesh of 320 faces.

    Args:
        client: Number of the PyBullet connection.
        item: The object.
        color: Red, green and blue in [0, 1].
    """
    solid, look = _shapes(item)
    shape = bullet.createCollisionShape(**solid, physicsClientId=client)
    seen = bullet.createVisualShape(**look, rgbaColor=(*color, 1.0), physicsClientId=client)
    body = bullet.createMultiBody(item.mass, shape, seen, physicsClientId=client)
    set_dynamics(client, body, item)
    return body


def set_dynamics(client: int, body: int, item: ObjectDescription) -> None:
    """Give a body the mass, inertia and friction of an object, without damping."""
    # no frictionAnchor: it holds on to old contact points, and under a changing load the object
    # crept by 1 mm and the contact forces missed the commanded ones by 0.2 N (1e-6 N without)
    bullet.changeDynamics(
        body, -1, mass=item.mass, localInertiaDiagonal=item.moments, lateralFriction=item.friction,
        collisionMargin=_margin(item), physicsClientId=client, **UNDAMPED,
    )  # fmt: skip


def _margin(item: ObjectDescription) -> float:
    """Bullet rounds edges by the margin, and puts it around meshes; of spheres and capsules it is the radius."""
    return 0.5 * item.size[0] if item.shape in ("sphere", "capsule") else 0.0


def _shapes(item: ObjectDescription) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of createCollisionShape and createVisualShape."""
    if item.shape == "cuboid":
        sides = {"shapeType": bullet.GEOM_BOX, "halfExtents": [0.5 * side for side in item.size]}
        return sides, sides
    if item.shape == "mesh":
        corners, faces = item.faces
        # three corners of its own for every face, so that it is drawn flat
        drawn, normals = item.surface.triangles.reshape(-1, 3), np.repeat(item.surface.normals, 3, axis=0)
        hull = {"shapeType": bullet.GEOM_MESH, "vertices": corners.tolist()}
        look = {
            "shapeType": bullet.GEOM_MESH,
            "vertices": drawn.tolist(),
            "indices": list(range(3 * len(faces))),
            "normals": normals.tolist(),
        }
        return hull, look
    radius = 0.5 * item.size[0]
    if item.shape == "sphere":
        ball = {"shapeType": bullet.GEOM_SPHERE, "radius": radius}
        return ball, ball
    kind = bullet.GEOM_CYLINDER if item.shape == "cylinder" else bullet.GEOM_CAPSULE
    length = item.size[1] if item.shape == "cylinder" else item.size[1] - 2.0 * radius
    solid = {"shapeType": kind, "radius": radius, "height": length, "collisionFrameOrientation": _Z_TO_Y}
    look = {"shapeType": kind, "radius": radius, "length": length, "visualFrameOrientation": _Z_TO_Y}
    return solid, look
