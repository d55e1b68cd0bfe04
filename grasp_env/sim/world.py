"""Builds the bodies of a scene and sets every parameter of Bullet that matters to them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from grasp_env.sim.bodies import UNDAMPED, create_body
from grasp_env.sim.client import bullet
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.hand_bodies import HAND_FLAGS, joint_indices

OBJECT_COLOR = (0.86, 0.80, 0.68)


class World(NamedTuple):
    """Numbers in one PyBullet server: the hand, the object, and the hand's joints in the order of its description."""

    hand: int
    object: int
    joints: tuple[int, ...]


def build_world(client: int, config: SceneConfig, urdf: str, angles: np.ndarray) -> World:
    """Make the hand, then the object, in an emptied server: 3 ms, 17 ms where the URDF has visual shapes.

    The order matters: the signs of the friction forces that Bullet reports depend on it.

    Args:
        client: Number of the PyBullet connection.
        config: The scene.
        urdf: Path of the hand's file; loading the same path again leaks nothing, another path 12 kB.
        angles: Of the joints at the start [rad], (M,).
    """
    bullet.resetSimulation(physicsClientId=client)  # resets gravity and solver iterations too: all is set again here
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
    hand = bullet.loadURDF(urdf, useFixedBase=True, flags=HAND_FLAGS, physicsClientId=client)
    joints = tuple(joint_indices(client, hand, config.hand))
    for link in range(-1, bullet.getNumJoints(hand, physicsClientId=client)):
        bullet.changeDynamics(
            hand, link, lateralFriction=config.hand.tip_friction, physicsClientId=client, **UNDAMPED
        )  # fmt: skip
    for joint in joints:
        # Bullet cuts joint speeds at 100 rad/s before it solves contacts: at 250 Hz a light link then passes on 8 of its 12 N m
        bullet.changeDynamics(hand, joint, maxJointVelocity=1e5, physicsClientId=client)
    for joint, angle in zip(joints, angles.tolist(), strict=True):
        bullet.resetJointState(hand, joint, angle, 0.0, physicsClientId=client)
    # every joint comes with a velocity motor that holds it: switch it off for torque control
    bullet.setJointMotorControlArray(
        hand, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * len(joints), physicsClientId=client
    )
    return World(hand, create_body(client, config.object, OBJECT_COLOR), joints)


def set_object_opacity(client: int, world: World, opacity: float) -> None:
    """Draw the object (1) or not (0)."""
    bullet.changeVisualShape(world.object, -1, rgbaColor=(*OBJECT_COLOR, opacity), physicsClientId=client)
