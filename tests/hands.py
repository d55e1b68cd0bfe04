"""Hands, and scenes without a simulator, for tests."""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np
from engines import HAND_FLAGS, bullet

from grasp_env import core
from grasp_env.force import ForceOptimizer
from grasp_env.grasp import Grasp
from grasp_env.sim import (
    FingerDescription,
    HandDescription,
    HandKinematics,
    ObjectDescription,
    Scene,
)
from grasp_env.sim.hand.inertia import inertia_matrix
from grasp_env.sim.hand.tree import Fingertip, Geometry, Link, Mimic, Palm
from grasp_env.sim.hand.urdf import hand_urdf
from grasp_env.sim.snapshot import Snapshot


def load_hand(client: int, hand: HandDescription) -> int:
    """Load a hand with a fixed palm, and return the body's number."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "hand.urdf")
        with open(path, "w", encoding="utf-8") as file:
            file.write(hand_urdf(hand))
        return bullet.loadURDF(path, useFixedBase=True, flags=HAND_FLAGS, physicsClientId=client)


def kinematics_alone(fingers: int = 4) -> HandKinematics:
    """Return the kinematics of a hand of fingers side by side."""
    return HandKinematics(
        HandDescription.of_fingers(
            [
                FingerDescription(f"f{k}", (0.1 * k, 0.2, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
                for k in range(fingers)
            ]
        )
    )


def scene_alone(
    item: ObjectDescription | None = None, fingers: int = 4
) -> tuple[core.Scene, Snapshot]:
    """Return a scene of the core without a simulator, and views of its state to write into."""
    held = item or ObjectDescription()
    made = core.Scene.make(
        kinematics_alone(fingers).tree, held.surface, (0.0, -9.81, 0.0), held.mass
    )
    views = Snapshot(**made.arrays())
    views.rotation[:] = np.eye(3)
    return made, views


def hand_alone(
    scene: core.Scene,
    fingers: int = 4,
    settings: core.HandControllerSettings | None = None,
    sensors: core.SensorSettings | None = None,
    body: core.Body | None = None,
    **options: Any,
) -> tuple[core.SimulatedHand, core.HandController]:
    """Return a simulated hand of such a scene and its controller, by default without springs and
    with Newton on soft contacts around its object."""
    angles = np.arange(fingers) * 2.0 * np.pi / fingers
    outwards = np.column_stack([np.cos(angles), 0.0 * angles, np.sin(angles)])
    grasp = Grasp.from_contacts(
        0.05 * outwards, -outwards, 0.4, contact_model="soft", torsional_friction=0.01
    )
    optimizer = ForceOptimizer(options.pop("grasp", grasp), **options)
    made = settings or core.HandControllerSettings()
    made.grip = made.place = core.Spring(0.0, 0.0, 0.0)
    made.reach_limit = made.posture_stiffness = made.posture_damping = 0.0
    made.torque_rate = 1e9
    controller = core.HandController()
    tree = kinematics_alone(fingers).tree
    motors = core.Calibration.newton_metres(tree)
    controller.configure(tree, made, motors, [0.0] * 3 * fingers, optimizer.core)
    hand = core.SimulatedHand.make(
        scene,
        controller,
        optimizer.core,
        1.0,
        body or core.Body(),
        sensors or core.SensorSettings(),
    )
    return hand, controller


def mass_matrix(kinematics: HandKinematics, angles: np.ndarray) -> np.ndarray:
    """Return the mass matrix (M, M) from the links' masses and inertias; coupled joints load their
    driver."""
    hand = kinematics.hand
    frames, origins = kinematics.links(angles)
    numbers = {link.name: index for index, link in enumerate(hand.links)}
    turning = np.zeros((hand.joint_count, 3, hand.joint_count))
    total = np.zeros((hand.joint_count,) * 2)
    for index, link in enumerate(hand.links):
        if link.parent in numbers:
            turning[index] = turning[numbers[link.parent]]
        if not link.sliding:
            turning[index][:, hand.drivers[index]] += (
                (link.mimic.ratio if link.mimic else 1.0) * frames[index] @ link.axis
            )
        moving = kinematics.link_jacobian(
            angles, index, origins[index] + frames[index] @ link.center
        )
        inertia = frames[index] @ inertia_matrix(link.inertia) @ frames[index].T
        total += link.mass * moving.T @ moving + turning[index].T @ inertia @ turning[index]
    return total


def grasp_torques(scene: Scene, forces: np.ndarray) -> np.ndarray:
    """Return torques (M,) with which the tips push with `forces` (N, 3), object frame, and carry
    the links' weight."""
    s = scene.look()
    torques = s.gravity_torques.copy()
    for finger, force in enumerate(forces @ s.rotation.T):
        for link in np.flatnonzero(scene.kinematics.carries[finger]):
            torques[link] += s.axes[link] @ np.cross(s.touch[finger] - s.origins[link], force)
    return torques


def numbers(scene: Scene) -> np.ndarray:
    """Return all readings of a scene in one row."""
    return np.concatenate([part.reshape(-1) for part in scene.look()])


def make_link(name: str = "a", parent: str = "palm", **fields: Any) -> Link:
    """Return a light link, by default on a joint about z."""
    given: dict[str, Any] = {
        "origin": (0.0, 0.0, 0.0),
        "rotation": (0.0, 0.0, 0.0),
        "axis": (0.0, 0.0, 1.0),
        "lower": -1.0,
        "upper": 1.0,
        "torque_limit": 2.0,
        "mass": 0.03,
        "center": (0.0, 0.0, 0.0),
        "inertia": (1e-5, 0.0, 0.0, 1e-5, 0.0, 1e-5),
    }
    return Link(name, parent, **(given | fields))


def gripper(
    fingers: int, joints: int, coupled: bool = False, torque: float = 2.0
) -> HandDescription:
    """Return fingers around a round palm that bend towards its axis; with `coupled`, the last joint
    of each follows the one before."""
    links: list[Link] = []
    tips: list[Fingertip] = []
    length = 0.12 / joints
    bone = Geometry("capsule", (0.006, length - 0.012), (0.0, 0.0, 0.5 * length - 0.004))
    ball = Geometry("sphere", (0.01,), (0.0, 0.0, length))
    common: dict[str, Any] = {"axis": (0.0, -1.0, 0.0), "upper": 1.2, "torque_limit": torque}
    common["center"] = (0.0, 0.0, 0.5 * length)
    for finger in range(fingers):
        turn = 2.0 * np.pi * finger / fingers
        for joint in range(joints):
            last = joint == joints - 1
            before = f"f{finger}_{joint - 1}"
            if joint == 0:
                origin = (0.06 * np.cos(turn), 0.06 * np.sin(turn), 0.01)
                place = {"origin": origin, "rotation": (0.0, 0.0, turn), "lower": -0.6}
            else:
                follows = Mimic(f"{before}_joint") if coupled and last else None
                place = {
                    "parent": before,
                    "origin": (0.0, 0.0, length),
                    "lower": 0.0,
                    "mimic": follows,
                }
            links.append(
                make_link(
                    f"f{finger}_{joint}",
                    collision=(bone, ball) if last else (bone,),
                    **common,
                    **place,
                )
            )
        tips.append(Fingertip(f"f{finger}", links[-1].name, (0.0, 0.0, length), 0.01))
    palm = Palm(collision=(Geometry("cylinder", (0.07, 0.01)),))
    return HandDescription("gripper", palm, tuple(links), tuple(tips), placed=False)
