"""The simulated grasp: a torque-controlled hand around a cuboid, and what a loop reads of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import as_array
from grasp_env.errors import SimulationError
from grasp_env.sim.client import Client, bullet
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.contacts import FingerContacts, Snapshot, take_snapshot
from grasp_env.sim.kinematics import HandKinematics
from grasp_env.sim.world import World, build_world, set_object_opacity

_DIVERGED = (
    "the simulation diverged: {what} {value}; reset the scene, and use smaller torques or wrenches "
    "or a higher physics_rate"
)


@dataclass(frozen=True)
class ObjectState:
    """Pose and motion of the object in the world frame, which is its nominal frame.

    Attributes:
        position: Of its centre [m], (3,).
        quaternion: Orientation, (4,), x y z w.
        rotation: Object frame to world frame, (3, 3).
        linear_velocity: Of its centre [m/s], (3,).
        angular_velocity: [rad/s], (3,).
    """

    position: np.ndarray
    quaternion: np.ndarray
    rotation: np.ndarray
    linear_velocity: np.ndarray
    angular_velocity: np.ndarray


class Scene:
    """A hand around a cuboid in its own PyBullet server.

    The state is read once per step, when it is first asked for. Returned arrays are shared within
    a step and never written again by the scene: treat them as read-only.

    Args:
        config: What to simulate.
        gui: Open a window; needs a display.

    Raises:
        InvalidInputError: A finger cannot reach its contact.
        SimulationError: No display for the window.
    """

    def __init__(self, config: SceneConfig | None = None, gui: bool = False) -> None:
        self.config = config or SceneConfig()
        self.kinematics = HandKinematics(self.config.hand)
        angles = self.kinematics.solve(self.config.nominal_tips())
        self.client = Client(gui)
        self._half_extents = np.array(self.config.half_extents, dtype=float)
        self._gravity = np.array(self.config.gravity, dtype=float)
        self._joints = list(range(self.config.hand.joint_count))
        self._world = build_world(self.client.number, self.config, angles)
        self._saved: int | None = None
        self._remember()

    @property
    def timestep(self) -> float:
        """Simulated time of one step [s]."""
        return 1.0 / self.config.physics_rate

    @property
    def bodies(self) -> World:
        """PyBullet's numbers of the hand and of the cuboid."""
        return self._world

    def reset(self) -> None:
        """Return to the settled grasp (or the nominal pose before `settle`), bit by bit."""
        bullet.restoreState(stateId=self._saved, physicsClientId=self.client.number)
        self._forget()

    def step(self, torques: ArrayLike, external_wrench: ArrayLike | None = None) -> None:
        """Advance by one physics step.

        Args:
            torques: Of the joints [N m], (3N,), cut at the hand's limit.
            external_wrench: On the object besides gravity: force [N] and moment about its centre
                [N m], (6,), object frame. None is no wrench.

        Raises:
            InvalidInputError: A wrong shape, or numbers that are not finite.
            SimulationError: The scene is closed.
        """
        client, world = self.client.number, self._world
        limit = self.config.hand.torque_limit
        numbers = _checked_list(torques, len(self._joints), "torques")
        bullet.setJointMotorControlArray(
            world.hand, self._joints, bullet.TORQUE_CONTROL, physicsClientId=client,
            forces=[min(max(number, -limit), limit) for number in numbers],
        )  # fmt: skip
        if external_wrench is not None:
            wrench = _checked_list(external_wrench, 6, "external_wrench")
            bullet.applyExternalForce(world.cuboid, -1, wrench[:3], (0.0, 0.0, 0.0), bullet.LINK_FRAME, client)
            bullet.applyExternalTorque(world.cuboid, -1, wrench[3:], bullet.LINK_FRAME, client)
        bullet.stepSimulation(client)
        self._forget()

    def state(self) -> ObjectState:
        """Pose and motion of the object."""
        rotation = self._read().rotation
        if self._state is None:
            body = self._reading[2 * len(self._joints) :]
            self._state = ObjectState(body[:3], body[3:7], rotation, body[7:10], body[10:])
        return self._state

    def joints(self) -> np.ndarray:
        """Joint angles [rad] and speeds [rad/s], (2, 3N)."""
        self._read()
        return self._reading[: 2 * len(self._joints)].reshape(2, -1)

    def contacts(self) -> FingerContacts:
        """Contact geometry now, and the contact forces of the last step."""
        snapshot = self._read()
        if self._contacts is None:
            touching, forces = self._measure_forces()
            self._contacts = FingerContacts(
                touching, snapshot.points, snapshot.normals, forces @ snapshot.rotation,
                snapshot.slip, snapshot.gaps,
            )  # fmt: skip
        return self._contacts

    def jacobians(self) -> np.ndarray:
        """World velocity of each tip's contact point per speed of its own joints, (N, 3, 3)."""
        return self._read().jacobians

    def gravity_torques(self) -> np.ndarray:
        """Torques that carry the weight of the hand's links [N m], (3N,)."""
        return self._read().gravity_torques

    def grasp_torques(self, forces: np.ndarray) -> np.ndarray:
        """Torques that press on the object with the given forces and carry the hand's weight.

        Args:
            forces: Of the fingers ON the object [N], (N, 3), object frame.

        Returns:
            J^T f plus gravity compensation [N m], (3N,).
        """
        snapshot = self._read()
        pushed = (forces @ snapshot.rotation.T)[:, None, :] @ snapshot.jacobians
        return pushed.ravel() + snapshot.gravity_torques

    def settle(self, controller: Callable[[Scene], np.ndarray], duration: float = 0.3) -> FingerContacts:
        """Close the fingers under a controller and make the result the state of `reset`.

        Args:
            controller: Called before each step with the scene; returns torques [N m], (3N,).
            duration: Simulated time [s].

        Returns:
            The contacts of the settled grasp.

        Raises:
            SimulationError: Afterwards a finger does not touch, or the contact forces do not carry
                the object's weight within 1 %.
        """
        self.reset()
        for _ in range(max(1, round(duration / self.timestep))):
            self.step(controller(self))
        contacts, state = self.contacts(), self.state()
        total = state.rotation @ contacts.forces.sum(axis=0)
        scale = np.linalg.norm(self.config.weight) or np.abs(contacts.forces).sum()
        error = np.linalg.norm(total + self.config.weight) / max(scale, 1e-12)
        if not contacts.touching.all() or error > 0.01:
            raise SimulationError(
                f"the grasp did not settle in {duration} s: touching={contacts.touching.tolist()}, "
                f"the contact forces sum to {total.round(4).tolist()} N and should carry "
                f"{self.config.weight.round(4).tolist()} N within 1 %, off by {error:.1%}; check "
                "that the controller balances gravity and presses every finger"
            )
        self._remember()
        return contacts

    @contextmanager
    def object_hidden(self) -> Iterator[None]:
        """Leave the object out of pictures while the block runs; its physics stays."""
        set_object_opacity(self.client.number, self._world, 0.0)
        try:
            yield
        finally:
            set_object_opacity(self.client.number, self._world, 1.0)

    def close(self) -> None:
        """Free the server; calling it again does nothing, any other call afterwards raises."""
        self.client.close()
        self._forget()

    def __reduce__(self) -> str:
        return self.client.__reduce__()  # raises: a copy would drive the same server

    def _remember(self) -> None:
        """Save the state `reset` returns to; at most one is kept, each takes 97 kB."""
        client = self.client.number
        bullet.performCollisionDetection(physicsClientId=client)  # a bare state restores inexactly
        if self._saved is not None:
            bullet.removeState(self._saved, physicsClientId=client)
        self._saved = bullet.saveState(physicsClientId=client)
        self.reset()

    def _forget(self) -> None:
        self._snapshot: Snapshot | None = None
        self._state: ObjectState | None = None
        self._contacts: FingerContacts | None = None

    def _read(self) -> Snapshot:
        """Read joints and object, once per step."""
        client = self.client.number
        if self._snapshot is None:
            world = self._world
            joints = bullet.getJointStates(world.hand, self._joints, client)
            position, quaternion = bullet.getBasePositionAndOrientation(world.cuboid, client)
            linear, angular = bullet.getBaseVelocity(world.cuboid, client)
            numbers = [joint[0] for joint in joints]
            numbers += [joint[1] for joint in joints]
            self._reading = np.array([*numbers, *position, *quaternion, *linear, *angular])
            snapshot = take_snapshot(self.kinematics, self._half_extents, self._gravity, self._reading)
            if not snapshot.valid:
                raise SimulationError(_DIVERGED.format(what="the object is at", value=position))
            self._snapshot = snapshot
        return self._snapshot

    def _measure_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """Which finger touches (N,), and its force on the object [N], (N, 3), world frame.

        The hand was loaded before the object; the friction signs of Bullet depend on that.
        """
        client, world = self.client.number, self._world
        count = len(self.config.hand.fingers)
        touching, forces = [False] * count, [0.0] * (3 * count)
        for row in bullet.getContactPoints(world.hand, world.cuboid, physicsClientId=client):
            (nx, ny, nz), n, a, (ax, ay, az), b, (bx, by, bz) = row[7], *row[9:14]
            link = row[3]  # 3 i + 2 for finger i, whose force starts at 3 i
            forces[link - 2] -= n * nx + a * ax + b * bx
            forces[link - 1] -= n * ny + a * ay + b * by
            forces[link] -= n * nz + a * az + b * bz
            touching[link // 3] |= n > 0.0
        if not math.isfinite(sum(forces)):
            raise SimulationError(_DIVERGED.format(what="the contact forces are", value=forces))
        return np.array(touching), np.array(forces).reshape(count, 3)


def _checked_list(values: ArrayLike, size: int, name: str) -> list[float]:
    """Finite numbers as PyBullet wants them; the full check runs only where the quick one fails."""
    if isinstance(values, np.ndarray) and values.shape == (size,):
        numbers = values.tolist()
        if math.isfinite(sum(numbers)):
            return numbers
    return as_array(values, (size,), name).tolist()
