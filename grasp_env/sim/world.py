"""Builds the bodies of a scene and sets every parameter of Bullet that matters to them."""

from __future__ import annotations

import os
import tempfile
from typing import NamedTuple

import numpy as np

from grasp_env.errors import SimulationError
from grasp_env.sim.client import bullet
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.hand import HandDescription
from grasp_env.sim.urdf import hand_urdf

_CUBOID_COLOR = (0.86, 0.80, 0.68)
_UNDAMPED = {
    "linearDamping": 0.0,
    "angularDamping": 0.0,
    "jointDamping": 0.0,
    "restitution": 0.0,
    "rollingFriction": 0.0,
    "spinningFriction": 0.0,
}


class World(NamedTuple):
    """Body numbers in one PyBullet server."""

    hand: int
    cuboid: int


def build_world(client: int, config: SceneConfig, angles: np.ndarray) -> World:
    """Make the hand, then the cuboid, in an empty server.

    The order matters: the signs of the friction forces that Bullet reports depend on it.

    Args:
        client: Number of the PyBullet connection.
        config: The scene.
        angles: Of the joints at the start [rad], (3N,).
    """
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / config.physics_rate,
        numSubSteps=0,  # with substeps the reported contact forces are a fraction of the true ones
        numSolverIterations=config.solver_iterations,
        solverResidualThreshold=0.0,
        enableConeFriction=1,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    bullet.setGravity(*config.gravity, physicsClientId=client)
    hand = _load_hand(client, config.hand)
    for joint, angle in enumerate(angles.tolist()):
        bullet.resetJointState(hand, joint, angle, 0.0, physicsClientId=client)
        bullet.changeDynamics(
            hand, joint, lateralFriction=config.hand.tip_friction, physicsClientId=client,
            **_UNDAMPED,
        )  # fmt: skip
    # every joint comes with a velocity motor that holds it: switch it off for torque control
    bullet.setJointMotorControlArray(
        hand, range(len(angles)), bullet.VELOCITY_CONTROL, forces=[0.0] * len(angles),
        physicsClientId=client,
    )  # fmt: skip
    return World(hand, _make_cuboid(client, config))


def set_object_opacity(client: int, world: World, opacity: float) -> None:
    """Draw the cuboid (1) or not (0)."""
    bullet.changeVisualShape(world.cuboid, -1, rgbaColor=(*_CUBOID_COLOR, opacity), physicsClientId=client)


def _load_hand(client: int, hand: HandDescription) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "hand.urdf")
        with open(path, "w", encoding="utf-8") as file:
            file.write(hand_urdf(hand))
        number = bullet.loadURDF(
            path, useFixedBase=True, flags=bullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )  # fmt: skip
    found = bullet.getNumJoints(number, physicsClientId=client)
    if found != hand.joint_count:
        raise SimulationError(
            f"the loaded hand has {found} joints instead of {hand.joint_count}; give its fingers different names"
        )
    return number


def _make_cuboid(client: int, config: SceneConfig) -> int:
    sides = list(config.half_extents)
    shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=sides, physicsClientId=client)
    look = bullet.createVisualShape(
        bullet.GEOM_BOX, halfExtents=sides, rgbaColor=(*_CUBOID_COLOR, 1.0), physicsClientId=client
    )
    cuboid = bullet.createMultiBody(config.object_mass, shape, look, physicsClientId=client)
    # no frictionAnchor: it holds on to old contact points, and under a changing load the object
    # crept by 1 mm and the contact forces missed the commanded ones by 0.2 N (1e-6 N without)
    bullet.changeDynamics(cuboid, -1, lateralFriction=config.friction, physicsClientId=client, **_UNDAMPED)
    return cuboid
