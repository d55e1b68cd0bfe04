"""The simulated grasp: a torque-controlled hand around an object, and what a loop reads of them."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env._check import Array, as_array
from grasp_env.errors import SimulationError, UnknownNameError
from grasp_env.sim.bodies import set_dynamics
from grasp_env.sim.client import Client, bullet
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.hand import HandDescription
from grasp_env.sim.kinematics import HandKinematics
from grasp_env.sim.objects import ObjectDescription
from grasp_env.sim.reading import walk
from grasp_env.sim.snapshot import BODY, ROW, Snapshot, observe, pack_tree, snapshot_size, split
from grasp_env.sim.urdf import hand_urdf
from grasp_env.sim.world import World, build_world, set_object_opacity

_DIVERGED = (
    "the simulation diverged: the object is at {position} m with velocity {velocity} m/s, contact forces up to {force:.3g} N; "
    "reset the scene, and use smaller torques or wrenches or a higher physics_rate"
)


class Scene:
    """A hand around an object in its own PyBullet server.

    The state is read once per step, when it is first asked for, into buffers that the next reading overwrites: copy what
    must last.

    Args:
        config: What to simulate.
        gui: Open a window; needs a display.
        visuals: Load the hand's visual shapes, which pictures need; they make loading a new object five times slower.

    Raises:
        InvalidInputError: A finger cannot reach its contact.
        SimulationError: No display for the window.
    """

    def __init__(self, config: SceneConfig | None = None, gui: bool = False, visuals: bool = False) -> None:
        self.config = config or SceneConfig()
        hand = self.config.hand
        self.kinematics = HandKinematics(hand)
        angles = self.kinematics.solve(self.config.nominal_tips())
        self.client = Client(gui)
        self.visuals = visuals or gui
        self.tree_numbers, self.tree_indices = pack_tree(self.kinematics.tree)
        folder = tempfile.mkdtemp()  # one path for all loads: Bullet keeps every path it has seen
        self._clean = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._urdf = os.path.join(folder, "hand.urdf")
        with open(self._urdf, "w", encoding="utf-8") as file:
            file.write(hand_urdf(hand if self.visuals else _invisible(hand)))
        self.buffer = np.zeros(snapshot_size(hand.finger_count, hand.joint_count))
        self._snapshot: Snapshot = split(self.buffer, hand.finger_count, hand.joint_count)
        self.reading = np.empty(0)
        self._build(angles)
        self.keep()

    @property
    def timestep(self) -> float:
        """Simulated time of one step [s]."""
        return 1.0 / self.config.physics_rate

    @property
    def bodies(self) -> World:
        """PyBullet's numbers of the hand, of the object and of the joints."""
        return self._world

    def load(self, config: SceneConfig) -> None:
        """Builds another object, or another grasp of it, for the same hand and rates; no kept state is left.

        Raises:
            InvalidInputError: a finger cannot reach its contact; the scene is as before.
        """
        angles = self.kinematics.solve(config.nominal_tips())
        self.config = replace(config, hand=self.config.hand)
        self._build(angles)

    def change_object(self, mass: float | None = None, friction: float | None = None) -> None:
        """Another mass [kg] (and inertia, in proportion) or friction of the object, from now on; `reset` does not undo it."""
        before = self.config.object
        inertia = before.inertia
        if mass is not None and inertia is not None:
            inertia = tuple(np.multiply(inertia, mass / before.mass).tolist())
        changed = replace(
            before, mass=before.mass if mass is None else mass, friction=before.friction if friction is None else friction,
            inertia=inertia,
        )  # fmt: skip
        self._set_object(changed)

    def set_gravity(self, gravity: Array) -> None:
        """Another gravity (3,) [m/s^2], world frame, from now on."""
        if not np.array_equal(gravity, self.gravity):
            self.gravity[:] = gravity
            bullet.setGravity(*gravity.tolist(), physicsClientId=self.client.number)
            self._read = False

    def keep(self, name: str = "start") -> None:
        """Makes the present state one that `reset` returns to: 1 ms; one is kept of each name, each takes 97 kB."""
        client = self.client.number
        contacts = self._contacts()
        if name in self._kept:
            bullet.removeState(self._kept[name][0], physicsClientId=client)
        self._kept[name] = bullet.saveState(physicsClientId=client), contacts
        self.reset(name)

    def reset(self, name: str = "start") -> None:
        """Returns to a kept state and its contact forces, bit by bit; gravity and the object's dynamics stay as they are.

        Raises:
            UnknownNameError: nothing of that name was kept.
        """
        if name not in self._kept:
            raise UnknownNameError("kept state", name, self._kept)
        client, world = self.client.number, self._world
        state, self._resting = self._kept[name]
        bullet.restoreState(stateId=state, physicsClientId=client)
        # Bullet restores contacts to the first pair of shapes of two links, not to the one they were of: new collision proxies make
        # the next step find them anew. Nothing is lost, as its solver starts from no impulses; until then those kept are read
        bullet.setCollisionFilterPair(world.hand, world.object, -1, -1, 1, physicsClientId=client)
        self._read = False

    def step(self, torques: ArrayLike, external_wrench: ArrayLike | None = None) -> None:
        """Advances by one physics step.

        Args:
            torques: Of the joints [N m], (M,), cut at the hand's limits.
            external_wrench: On the object besides gravity: force [N] and moment about its centre
                [N m], (6,), object frame. None is no wrench.

        Raises:
            InvalidInputError: A wrong shape, or numbers that are not finite.
            SimulationError: The scene is closed.
        """
        limits = self.kinematics.tree.torque_limits
        numbers = as_array(torques, (len(limits),), "torques")
        wrench = None if external_wrench is None else as_array(external_wrench, (6,), "external_wrench").tolist()
        self.advance(np.clip(numbers, -limits, limits).tolist(), wrench)

    def advance(self, torques: list[float], wrench: list[float] | None) -> None:
        """`step` without checks, for loops: torques within the limits, and what they push with."""
        client, world = self.client.number, self._world
        bullet.setJointMotorControlArray(
            world.hand, world.joints, bullet.TORQUE_CONTROL, forces=torques, physicsClientId=client
        )
        if wrench is not None:
            bullet.applyExternalForce(world.object, -1, wrench[:3], (0.0, 0.0, 0.0), bullet.LINK_FRAME, client)
            bullet.applyExternalTorque(world.object, -1, wrench[3:], bullet.LINK_FRAME, client)
        bullet.stepSimulation(client)
        self._resting = None
        self._read = False

    def look(self) -> Snapshot:
        """Hand, object and contacts as they are now, and the contact forces of the last step.

        Raises:
            SimulationError: The simulation diverged, or the scene is closed.
        """
        if not self._read:
            joints, pose, velocity, contacts = self.answers()
            count = walk(id(joints), id(pose), id(velocity), id(contacts), self.reading)
            observe(*self.observed, self.reading[:count], self.finger_of_link, self.buffer)
            first = 2 * len(joints) + BODY
            if not self.buffer[0]:
                force = float(np.abs(self.reading[first:count]).max(initial=0.0))
                raise SimulationError(_DIVERGED.format(position=pose[0], velocity=velocity[0], force=force))
            self._read = True
        return self._snapshot

    def seen(self) -> None:
        """Takes `buffer` as filled from the answers of now, by a kernel."""
        self._read = True

    def answers(self) -> tuple[Any, Any, Any, Any]:
        """What the server says of joints, the object's pose and velocity, and contacts; `reading` has room for their numbers."""
        client, world = self.client.number, self._world
        joints = bullet.getJointStates(world.hand, world.joints, client)
        pose = bullet.getBasePositionAndOrientation(world.object, client)
        velocity = bullet.getBaseVelocity(world.object, client)
        contacts = self._contacts()
        room = 2 * len(world.joints) + BODY + ROW * len(contacts)
        if room > len(self.reading):
            self.reading = np.empty(2 * room)
        return joints, pose, velocity, contacts

    @contextmanager
    def object_hidden(self) -> Iterator[None]:
        """Leaves the object out of pictures while the block runs; its physics stays."""
        set_object_opacity(self.client.number, self._world, 0.0)
        try:
            yield
        finally:
            set_object_opacity(self.client.number, self._world, 1.0)

    def close(self) -> None:
        """Frees the server; calling it again does nothing, any other call afterwards raises."""
        self.client.close()
        self._clean()
        self._read = False

    def __reduce__(self) -> Any:
        return self.client.__reduce__()  # raises: a copy would drive the same server

    def _build(self, angles: Array) -> None:
        client = self.client.number
        self._world = build_world(client, self.config, self._urdf, angles)
        surface = self.config.object.surface
        links = np.full(bullet.getNumJoints(self._world.hand, physicsClientId=client) + 1, -1, dtype=np.int64)
        for finger, link in enumerate(self.kinematics.tree.tip_links.tolist()):
            links[self._world.joints[link] + 1] = finger
        self.finger_of_link = links
        self.gravity = np.array(self.config.gravity, dtype=float)
        self.observed = (
            self.tree_numbers, self.tree_indices, surface.kind, surface.numbers, surface.triangles, surface.normals, self.gravity,
        )  # fmt: skip
        self._kept: dict[str, tuple[int, Any]] = {}  # the server that held others was emptied
        self._resting: Any = None
        self._read = False

    def _contacts(self) -> Any:
        """What the server says of the contacts in the last step, after a reset what it said when the state was kept."""
        if self._resting is not None:
            return self._resting
        return bullet.getContactPoints(self._world.hand, self._world.object, physicsClientId=self.client.number)

    def _set_object(self, changed: ObjectDescription) -> None:
        self.config = replace(self.config, object=changed)
        set_dynamics(self.client.number, self._world.object, changed)


def _invisible(hand: HandDescription) -> HandDescription:
    """The same hand without visual shapes."""
    links = tuple(replace(link, visual=()) for link in hand.links)
    return replace(hand, palm=replace(hand.palm, visual=()), links=links)
