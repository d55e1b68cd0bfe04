"""The body of an object in PyBullet: its shapes, mass, inertia and friction."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from grasp_env.inputs.arguments import Array
from grasp_env.sim.client import bullet
from grasp_env.sim.mesh_files import obj_text
from grasp_env.sim.mesh_shape import hull_faces
from grasp_env.sim.objects.description import OBJECT_COLOR, ObjectDescription

# arguments of changeDynamics that switch off Bullet's default damping
UNDAMPED = dict.fromkeys(
    [
        "linearDamping",
        "angularDamping",
        "jointDamping",
        "restitution",
        "rollingFriction",
        "spinningFriction",
    ],
    0.0,
)
# capsules and cylinders of Bullet lie along z
_Z_TO_Y = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


def create_body(client: int, item: ObjectDescription, contacts: str | None = None) -> int:
    """Create an object at the origin, after the hand, and return its body number.

    Contacts with cuboids, spheres and capsules are exact. So are those with the faces of a mesh;
    `contacts` is `BulletEngine.mesh_contacts`. At other shapes Bullet merges corners within a
    centimetre: on the round side of a cylinder the normal is off by up to 0.04, the distance by 40
    um.
    """
    exact = item.has_coarse_pieces if contacts is None else contacts == "faces"
    with tempfile.TemporaryDirectory() as folder:
        solid, look = _shapes(item, folder, exact)
        shape = bullet.createCollisionShape(**solid, physicsClientId=client)
        visual = bullet.createVisualShape(
            **look, rgbaColor=(*OBJECT_COLOR, 1.0), physicsClientId=client
        )
        # reads the file once more
        body = bullet.createMultiBody(item.mass, shape, visual, physicsClientId=client)
    set_dynamics(client, body, item)
    return body


def set_dynamics(client: int, body: int, item: ObjectDescription) -> None:
    """Set the mass, inertia and friction of a body, without damping."""
    # no frictionAnchor, which keeps old contact points: under a changing load the object crept by 1
    # mm and contact forces were off by 0.2 N (1e-6 N without)
    bullet.changeDynamics(
        body,
        -1,
        mass=item.mass,
        localInertiaDiagonal=item.moments,
        lateralFriction=item.friction,
        # else 0, as a margin rounds edges and grows meshes
        collisionMargin=0.5 * item.size[0] if item.shape in ("sphere", "capsule") else 0.0,
        physicsClientId=client,
        **{**UNDAMPED, "spinningFriction": item.torsional_friction},
    )


def _write(folder: str, name: str, parts: Sequence[tuple[Array, Any]]) -> str:
    """Write an .obj without normals, so that Bullet shades each face flat; return its path."""
    path = Path(folder, name)
    path.write_text(obj_text(parts), encoding="ascii")
    return str(path)


def _shapes(
    item: ObjectDescription, folder: str, exact: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arguments of createCollisionShape and createVisualShape."""
    if item.shape == "cuboid":
        sides = {"shapeType": bullet.GEOM_BOX, "halfExtents": [0.5 * side for side in item.size]}
        return sides, sides
    if item.shape == "mesh":
        look = {"shapeType": bullet.GEOM_MESH, "fileName": _write(folder, "mesh.obj", [item.faces])}
        if exact:
            return {**look, "flags": bullet.GEOM_FORCE_CONCAVE_TRIMESH}, look
        if len(item.pieces) == 1:
            return {"shapeType": bullet.GEOM_MESH, "vertices": item.pieces[0].tolist()}, look
        hulls = [hull_faces(piece) for piece in item.pieces]
        return {**look, "fileName": _write(folder, "pieces.obj", hulls)}, look
    radius = 0.5 * item.size[0]
    if item.shape == "sphere":
        ball = {"shapeType": bullet.GEOM_SPHERE, "radius": radius}
        return ball, ball
    kind = bullet.GEOM_CYLINDER if item.shape == "cylinder" else bullet.GEOM_CAPSULE
    length = item.size[1] if item.shape == "cylinder" else item.size[1] - 2.0 * radius
    common = {"shapeType": kind, "radius": radius}
    solid = {**common, "height": length, "collisionFrameOrientation": _Z_TO_Y}
    return solid, {**common, "length": length, "visualFrameOrientation": _Z_TO_Y}
