"""PyBullet as a `Simulator`."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from grasp_env import core
from grasp_env.errors import UnknownNameError
from grasp_env.inputs.arguments import Array, instance
from grasp_env.sim.bullet_body import UNDAMPED, create_body, set_dynamics
from grasp_env.sim.bullet_sweeps import min_sweeps
from grasp_env.sim.client import Client, bullet
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.engine import BulletEngine
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.hand.limbs import touching_pairs
from grasp_env.sim.hand.tree import Mimic
from grasp_env.sim.hand.urdf import HULL_MARGIN, write_hand
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.sim.simulator import Simulator

HAND_FLAGS: int = (
    bullet.URDF_USE_INERTIA_FROM_FILE
    | bullet.URDF_USE_SELF_COLLISION
    | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT  # neighbours overlap around their joint
)
# fewest and most solver sweeps for coupled joints: with 20, links of 20 g yielded by 0.02 rad under
# 0.5 N m, with 100 by 1e-9
COUPLED_SWEEPS, MAX_SWEEPS = 100, 1000


class Bullet(Simulator):
    """A hand around an object in its own PyBullet server; see `Simulator`.

    Attributes:
        client: The connection.
        world: Numbers of hand, object and joints in the server; each `load` makes another tuple.
    """

    def __init__(self, hand: HandDescription, gui: bool = False, visuals: bool = False) -> None:
        self.client = Client(gui)
        folder = tempfile.mkdtemp()
        self._clean = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._urdf = write_hand(
            hand if visuals or gui else hand.without_visuals(), folder, HULL_MARGIN
        )

    def load(self, config: SceneConfig, angles: Array) -> None:
        """See `Simulator`."""
        client = self.client.number
        self.world = build_world(client, config, self._urdf, angles)
        links = [-1] * (bullet.getNumJoints(self.world.hand, physicsClientId=client) + 1)
        for link, index in enumerate(self.world.joints):
            links[index + 1] = link  # the palm is -1
        self._links = links
        # Bullet reports forces on the hand, as it was loaded first; the factor makes their mean
        self._answers = core.Answers(
            link=3,
            place=6,
            forces=[(9, 7), (10, 11), (12, 13)],
            factor=-1.0 / config.substeps,
            first=-1,
            links=links,
        )
        self._states: dict[str, tuple[int, Any]] = {}  # resetting the server removed earlier ones
        self._steps = config.substeps
        # contacts of all steps of the last `advance`, or those saved with a state; None if the
        # server still has them
        self._recorded = None

    def advance(self, torques: list[float], wrench: list[float] | None) -> None:
        """See `Simulator`."""
        client = self.client.number
        hand, body, joints = self.world
        self._recorded = () if self._steps > 1 else None
        for _ in range(self._steps):  # Bullet clears torques and wrenches after each step
            bullet.setJointMotorControlArray(
                hand, joints, bullet.TORQUE_CONTROL, forces=torques, physicsClientId=client
            )
            if wrench is not None:
                bullet.applyExternalForce(
                    body, -1, wrench[:3], (0.0, 0.0, 0.0), bullet.LINK_FRAME, client
                )
                bullet.applyExternalTorque(body, -1, wrench[3:], bullet.LINK_FRAME, client)
            bullet.stepSimulation(client)
            if self._recorded is not None:
                self._recorded += bullet.getContactPoints(hand, body, physicsClientId=client)

    def read(self) -> Array:
        """See `Simulator`."""
        client = self.client.number
        hand, body, joints = self.world
        states = bullet.getJointStates(hand, joints, client)
        pose = bullet.getBasePositionAndOrientation(body, client)
        velocity = bullet.getBaseVelocity(body, client)
        return self._answers.read(states, pose, velocity, self._contacts())

    def _contacts(self) -> Any:
        if self._recorded is not None:
            return self._recorded
        return bullet.getContactPoints(
            self.world.hand, self.world.object, physicsClientId=self.client.number
        )

    def self_contacts(self) -> list[tuple[int, int]]:
        """See `Simulator`."""
        hand, client = self.world.hand, self.client.number
        pairs = {
            tuple(sorted((self._links[row[3] + 1], self._links[row[4] + 1])))
            for row in bullet.getContactPoints(hand, hand, physicsClientId=client) or ()
            if row[9] > 0.0
        }
        return sorted((first, second) for first, second in pairs)

    def set_gravity(self, gravity: Array) -> None:
        """See `Simulator`."""
        bullet.setGravity(*gravity.tolist(), physicsClientId=self.client.number)

    def set_joint_friction(self, torques: list[float]) -> None:
        """See `Simulator`; a motor that holds speed zero with a bounded torque is Coulomb friction."""
        bullet.setJointMotorControlArray(
            self.world.hand,
            self.world.joints,
            bullet.VELOCITY_CONTROL,
            forces=torques,
            physicsClientId=self.client.number,
        )

    def set_object(self, item: ObjectDescription) -> None:
        """See `Simulator`."""
        set_dynamics(self.client.number, self.world.object, item)

    def keep(self, name: str) -> None:
        """See `Simulator`; it takes 1 ms and 97 kB."""
        client = self.client.number
        if name in self._states:
            bullet.removeState(self._states[name][0], physicsClientId=client)
        self._states[name] = bullet.saveState(physicsClientId=client), self._contacts()
        self.reset(name)

    def reset(self, name: str) -> None:
        """See `Simulator`."""
        if name not in self._states:
            raise UnknownNameError("kept state", name, self._states)
        client, world = self.client.number, self.world
        state, self._recorded = self._states[name]
        bullet.restoreState(stateId=state, physicsClientId=client)
        # Bullet restores the contacts of two links to the first pair of their shapes, which may be
        # wrong. New collision proxies make the next step find them anew; until then the saved
        # contacts are read
        bullet.setCollisionFilterPair(world.hand, world.object, -1, -1, 1, physicsClientId=client)

    def close(self) -> None:
        """See `Simulator`."""
        self.client.close()
        self._clean()


class World(NamedTuple):
    """Numbers of hand and object in a PyBullet server, and of joints in the hand's order."""

    hand: int
    object: int
    joints: tuple[int, ...]


def build_world(client: int, config: SceneConfig, urdf: str, angles: np.ndarray) -> World:
    """Clear the server, then load the hand and the object.

    It takes 3 ms, or 17 ms with visual shapes. The signs of the forces that Bullet reports depend
    on the order.
    """
    # also resets gravity and the solver's parameters
    bullet.resetSimulation(physicsClientId=client)
    engine = instance(config.engine, BulletEngine, "engine")
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / engine.rate,
        numSubSteps=0,  # with substeps the reported contact forces are a fraction of the true ones
        numSolverIterations=max(
            engine.solver_iterations,
            min_sweeps(config, angles),
        ),
        solverResidualThreshold=0.0,
        enableConeFriction=1,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,  # the cache keeps every hull, 0.5 MB for a hand of 32
        physicsClientId=client,
    )
    bullet.setGravity(*config.gravity, physicsClientId=client)
    hand = bullet.loadURDF(urdf, useFixedBase=True, flags=HAND_FLAGS, physicsClientId=client)
    joints = tuple(joint_indices(client, hand, config.hand))
    plain = {"lateralFriction": config.hand.tip_friction, **UNDAMPED}
    for link in range(-1, bullet.getNumJoints(hand, physicsClientId=client)):
        bullet.changeDynamics(hand, link, physicsClientId=client, **plain)
    for joint in joints:
        # by default Bullet clips joint speeds to 100 rad/s before it solves contacts, so that at 250
        # Hz a light link passes on only 8 of 12 N m
        bullet.changeDynamics(hand, joint, maxJointVelocity=1e5, physicsClientId=client)
    for joint, angle in zip(joints, angles.tolist(), strict=True):
        bullet.resetJointState(hand, joint, angle, 0.0, physicsClientId=client)
    # switch off the velocity motor that holds each joint by default
    bullet.setJointMotorControlArray(
        hand, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * len(joints), physicsClientId=client
    )
    couple(client, hand, joints, config.hand)
    for pair in touching_pairs(config.hand):
        first, second = (-1 if link < 0 else joints[link] for link in pair)
        bullet.setCollisionFilterPair(hand, hand, first, second, 0, physicsClientId=client)
    return World(hand, create_body(client, config.object, engine.mesh_contacts), joints)


def couple(client: int, body: int, joints: Sequence[int], hand: HandDescription) -> None:
    """Couple joints to their drivers with gear constraints, which pass their load to the drivers."""
    coupled = {index: link.mimic for index, link in enumerate(hand.links) if link.mimic is not None}
    if not coupled:
        return
    sweeps = bullet.getPhysicsEngineParameters(physicsClientId=client)["numSolverIterations"]
    sweeps = max(sweeps, _gear_sweeps(client, body, joints, hand, coupled))
    bullet.setPhysicsEngineParameter(numSolverIterations=sweeps, physicsClientId=client)
    for index, mimic in coupled.items():
        gear = bullet.createConstraint(
            body,
            joints[hand.drivers[index]],
            body,
            joints[index],
            bullet.JOINT_GEAR,
            hand.links[index].axis,
            (0, 0, 0),
            (0, 0, 0),
            physicsClientId=client,
        )
        # Bullet's target is for driver - follower / ratio
        bullet.changeConstraint(
            gear,
            gearRatio=-1.0 / mimic.ratio,
            relativePositionTarget=-mimic.offset / mimic.ratio,
            erp=0.8,
            maxForce=1e6,
            physicsClientId=client,
        )


def _gear_sweeps(
    client: int,
    body: int,
    joints: Sequence[int],
    hand: HandDescription,
    coupled: Mapping[int, Mimic],
) -> int:
    """Return the solver sweeps that reduce the couplings' error to a millionth in this posture.

    The solver treats one gear after another, as if its two joints did not move each other. It
    therefore overshoots: by nearly the whole error if a light link carries a heavy one.
    """
    angles = [row[0] for row in bullet.getJointStates(body, joints, client)]
    order = np.argsort(joints)  # of all of Bullet's joints, as none is fixed
    masses = np.array(
        bullet.calculateMassMatrix(body, [angles[joint] for joint in order], physicsClientId=client)
    )
    mobility = np.linalg.inv(masses)
    rows = {int(joint): row for row, joint in enumerate(order)}
    gears = np.zeros((len(coupled), len(joints)))
    assumed = np.zeros(len(coupled))  # mobilities in the solver
    for number, (index, mimic) in enumerate(coupled.items()):
        driver = rows[hand.drivers[index]]
        follower = rows[index]
        gears[number, [driver, follower]] = 1.0, -1.0 / mimic.ratio
        assumed[number] = mobility[driver, driver] + mobility[follower, follower] / mimic.ratio**2
    coupling = gears @ mobility @ gears.T
    error = np.eye(len(coupled))
    for number in range(len(coupled)):
        error[number] -= coupling[number] @ error / assumed[number]
    slowest = min(float(np.abs(np.linalg.eigvals(error)).max()), 1.0 - 1e-9)
    return int(np.clip(np.log(1e-6) / np.log(max(slowest, 1e-3)), COUPLED_SWEEPS, MAX_SWEEPS))


def joint_indices(client: int, body: int, hand: HandDescription) -> list[int]:
    """Return PyBullet's index of every joint of the hand, (M,), and thus of its link."""
    count = bullet.getNumJoints(body, client)
    names = [bullet.getJointInfo(body, index, client)[1].decode() for index in range(count)]
    return [names.index(name) for name in hand.joint_names]
