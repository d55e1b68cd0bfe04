"""A hand's controller without a simulator: the joints stay in their posture, and the contacts are
those of the paper's cuboid."""

from __future__ import annotations

from typing import Any

import numpy as np
from hands import kinematics_alone
from oracles import geometry

from grasp_env.control import Calibration, HandController, HandControllerSettings, HandState
from grasp_env.grasp import presets
from grasp_env.sim import HandDescription

PERIOD = 1e-3
GRASP = presets.paper_cuboid()
FRICTION = float(np.ravel(GRASP.friction)[0])
KINEMATICS = kinematics_alone()
HOME = np.array(KINEMATICS.home)
JOINTS = len(HOME)
NO_POSTURE = {"posture_stiffness": 0.0, "posture_damping": 0.0}
NO_SPRINGS = {"grip_stiffness": 0.0, "grip_damping": 0.0, **NO_POSTURE}
FAST = {"torque_rate": 1e6, "friction": FRICTION}


def scaled(limits: np.ndarray) -> Calibration:
    """Motors with these limits [N m], commanded in N m."""
    table = np.column_stack([-limits, limits])
    return Calibration(table, table, resolution=0.0)


def made(
    limits: np.ndarray | None = None, hand: HandDescription = KINEMATICS.hand, **settings: Any
) -> tuple[HandController, HandState]:
    """A controller, by default of strong motors, and a state in which it holds 2 N."""
    controller = HandController()
    motors = None if limits is None else scaled(limits)
    controller.configure(hand, HandControllerSettings(**{**FAST, **settings}), motors)
    state = controller.new_state()
    state.angles = HOME.copy()
    state.touching[:] = 1.0
    state.positions[:] = GRASP.positions
    state.normals[:] = GRASP.normals
    state.wrench[1] = -2.0
    controller.activate(state)
    return controller, state


def updated(controller: HandController, state: HandState, count: int = 1) -> np.ndarray:
    """Commands of the last update."""
    return [controller.update(state, PERIOD) for _ in range(count)][-1]


def net(controller: HandController, force: np.ndarray) -> np.ndarray:
    """Wrench (6,) of forces (N, 3), contact frames, on the object."""
    pushes = np.einsum("nij,nj->ni", controller.arrays()["frames"], force)
    return np.concatenate([pushes.sum(axis=0), np.cross(GRASP.positions, pushes).sum(axis=0)])


def sizes(places: np.ndarray, *wrenches: np.ndarray) -> list[float]:
    """Largest components [N] of wrenches in the unit frame of contacts (N, 3)."""
    to_unit = geometry.unit_frame(places)[2]
    return [float(np.abs(to_unit @ wrench).max()) for wrench in wrenches]


def torques_of(controller: HandController, state: HandState, force: np.ndarray) -> np.ndarray:
    """Torques (M,) of forces (N, 3) and of the links' weight."""
    moves, weight = KINEMATICS.statics(state.angles, GRASP.positions, state.gravity)
    pushes = np.einsum("nij,nj->ni", controller.arrays()["frames"], force)
    return weight + pushes.ravel() @ moves.reshape(-1, JOINTS)
