"""MuJoCo as a `Simulator`."""

from __future__ import annotations

from typing import Any

import numpy as np

from grasp_env.errors import InvalidInputError, SimulationError, UnknownNameError
from grasp_env.inputs.arguments import Array, instance
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.engine import MujocoEngine
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.mjcf import OBJECT, link_name, scene_mjcf
from grasp_env.sim.mujoco_api import mujoco
from grasp_env.sim.objects.description import ObjectDescription
from grasp_env.sim.simulator import CLOSED, Simulator

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_MIN_FORCE = 1e-9  # force below which a contact counts as open [N]


class Mujoco(Simulator):
    """A hand around an object in its own MuJoCo model; see `Simulator`.

    It has no window; pictures have a model of their own.

    Attributes:
        model, data: MuJoCo's model and data; each `load` makes new ones. None after `close`.
    """

    def __init__(self, hand: HandDescription, gui: bool = False, visuals: bool = False) -> None:
        if gui:
            raise InvalidInputError(
                "engine='mujoco' opens no window: use render_mode='rgb_array', `grasp live` in a browser, or engine='bullet'"
            )
        self._hand, self._closed = hand, False
        self.model: Any = None
        self.data: Any = None

    def load(self, config: SceneConfig, angles: Array) -> None:
        """See `Simulator`."""
        if self._closed:
            raise SimulationError(CLOSED)
        engine = instance(config.engine, MujocoEngine, "engine")
        text = scene_mjcf(self._hand, config.object, config.gravity, 1.0 / engine.rate, engine)
        try:
            self.model = model = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            raise SimulationError(
                f"MuJoCo cannot build hand {self._hand.name!r} with this object: {error}"
            ) from error
        self.data = data = mujoco.MjData(model)
        names = [link_name(index) for index in range(self._hand.joint_count)]
        joints = [model.joint(name) for name in names]
        self._angles = np.array([joint.qposadr[0] for joint in joints])
        self._rates = np.array([joint.dofadr[0] for joint in joints])
        self._body = model.body(OBJECT).id
        self._shapes = np.flatnonzero(model.geom_bodyid == self._body)
        free = model.body_jntadr[self._body]
        start = int(model.jnt_qposadr[free])
        self._position, self._turn = slice(start, start + 3), slice(start + 3, start + 7)
        start = int(model.jnt_dofadr[free])
        self._linear, self._angular = slice(start, start + 3), slice(start + 3, start + 6)
        links = {model.body(name).id: float(index) for index, name in enumerate(names)}
        self._links = np.array([links.get(int(body), -1.0) for body in model.geom_bodyid])
        self._steps = config.substeps
        self._states = {}
        self._recorded: list[tuple[Array, ...]] = []  # contacts of every step of the last `advance`
        self._contacts: Array | None = np.empty(0)  # None: to be computed from `_recorded`
        self._rotation = np.zeros(9)
        data.qpos[self._angles] = angles
        mujoco.mj_forward(model, data)

    def advance(self, torques: list[float], wrench: list[float] | None) -> None:
        """See `Simulator`."""
        model = self.model
        data = self._open_data()
        data.qfrc_applied[self._rates] = torques
        if wrench is None:
            data.xfrc_applied[self._body] = 0.0
        self._recorded = []
        self._contacts = None
        for _ in range(self._steps):
            if wrench is not None:
                rotation = self._object_rotation()
                data.xfrc_applied[self._body, :3] = rotation @ wrench[:3]
                data.xfrc_applied[self._body, 3:] = rotation @ wrench[3:]
            mujoco.mj_step(model, data)
            self._record_contacts()

    def read(self) -> Array:
        """See `Simulator`."""
        data = self._open_data()
        state, rates = data.qpos, data.qvel
        w, x, y, z = state[self._turn]
        return np.concatenate(
            [
                state[self._angles],
                rates[self._rates],
                state[self._position],
                (x, y, z, w),
                rates[self._linear],
                self._object_rotation() @ rates[self._angular],
                self._object_contacts(),
            ]
        )

    def self_contacts(self) -> list[tuple[int, int]]:
        """See `Simulator`."""
        self._open_data()
        if not self._recorded:
            return []
        shapes, _, _, forces = self._recorded[-1]
        rows = (forces[:, 0] > _MIN_FORCE) & ~np.isin(shapes, self._shapes).any(axis=1)
        links: Array = self._links[shapes[rows].astype(int)]
        pairs = np.sort(links, axis=1).astype(int).tolist()
        return sorted({(first, second) for first, second in pairs})

    def set_gravity(self, gravity: Array) -> None:
        """See `Simulator`."""
        self._open_data()
        self.model.opt.gravity[:] = gravity

    def set_joint_friction(self, torques: list[float]) -> None:
        """See `Simulator`."""
        self._open_data()
        self.model.dof_frictionloss[self._rates] = torques

    def set_object(self, item: ObjectDescription) -> None:
        """See `Simulator`."""
        self._open_data()
        model = self.model
        model.body_mass[self._body], model.body_inertia[self._body] = item.mass, item.moments
        friction = np.multiply((item.friction, item.torsional_friction), self._hand.tip_friction)
        model.geom_friction[self._shapes, :2] = friction
        # updates constants that depend on masses, and writes to its data
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def keep(self, name: str) -> None:
        """See `Simulator`."""
        data = self._open_data()
        state = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, data, state, _STATE)
        self._states[name] = state, self._object_contacts()

    def reset(self, name: str) -> None:
        """See `Simulator`."""
        data = self._open_data()
        if name not in self._states:
            raise UnknownNameError("kept state", name, self._states)
        state, self._contacts = self._states[name]
        mujoco.mj_setState(self.model, data, state, _STATE)

    def close(self) -> None:
        """See `Simulator`."""
        self.model = self.data = None
        self._closed = True

    def _open_data(self) -> Any:
        if self.data is None:
            raise SimulationError(CLOSED)
        return self.data

    def _object_rotation(self) -> Array:
        """Return the rotation (3, 3) to the world frame; MuJoCo's is that before the last step."""
        mujoco.mju_quat2Mat(self._rotation, self.data.qpos[self._turn])
        return self._rotation.reshape(3, 3)

    def _record_contacts(self) -> None:
        """Copy the data of all contacts, as the next step overwrites them."""
        contacts = self.data.contact
        forces = np.empty((self.data.ncon, 6))
        for index, force in enumerate(forces):
            mujoco.mj_contactForce(self.model, self.data, index, force)
        record = contacts.geom.copy(), contacts.pos.copy(), contacts.frame.copy(), forces
        self._recorded.append(record)

    def _object_contacts(self) -> Array:
        """Return the object's contacts in the last `advance`, (7n,): link, position and force.

        The forces act on the object and are divided by the number of steps.
        """
        if self._contacts is None:
            shapes, points, frames, forces = map(np.concatenate, zip(*self._recorded, strict=True))
            of_object = np.isin(shapes, self._shapes)
            rows = of_object.any(axis=1) & (forces[:, 0] > _MIN_FORCE)
            # the contact's frame belongs to the first shape, and the force acts on the second
            second = of_object[:, 1]
            local = np.where(second, 1.0, -1.0)[:, None] / len(self._recorded) * forces[:, :3]
            world = np.einsum("ni,nij->nj", local, frames.reshape(-1, 3, 3))
            links = self._links[np.where(second, shapes[:, 0], shapes[:, 1])]
            self._contacts = np.column_stack([links, points, world])[rows].reshape(-1)
        return self._contacts
