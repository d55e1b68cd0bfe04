"""Simulated grasp: a torque-controlled hand around an object."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grasp_env import core
from grasp_env.errors import SimulationError
from grasp_env.inputs.arguments import Array, as_array
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.engine import class_of
from grasp_env.sim.hand.kinematics import HandKinematics
from grasp_env.sim.snapshot import Snapshot


class Scene:
    """A hand around an object in a simulator of its own.

    `look` returns views of arrays that the next reading overwrites: copy what you keep.

    Args:
        config: The scene.
        gui: Open a window; needs a display.
        visuals: Load the hand's visual shapes for pictures, which makes `load` five times slower.

    Attributes:
        simulator: The physics engine, for direct calls. With PyBullet it has `client`, the
            connection, and `world`, the numbers of the bodies. With MuJoCo it has `model` and
            `data`.
        kinematics: Kinematics of the hand.
        core: The compiled `core.Scene`, which holds the hand, the object and the last reading.
        gravity: Current gravity [m/s^2], (3,), world frame.

    Raises:
        InvalidInputError: A finger cannot reach its contact.
        MissingExtraError: The engine is not installed.
        SimulationError: There is no display for the window.

    Example:
        >>> scene = Scene(SceneConfig())
        >>> scene.look().angles.shape
        (12,)
        >>> scene.close()
    """

    def __init__(
        self, config: SceneConfig | None = None, gui: bool = False, visuals: bool = False
    ) -> None:
        self.config = config or SceneConfig()
        self.kinematics = HandKinematics(self.config.hand)
        angles = _start_angles(self.config, self.kinematics)
        self.visuals = visuals or gui
        self._options = {"gui": gui, "visuals": visuals}
        self.simulator: Any = class_of(self.config.engine, "simulator")(
            self.config.hand, **self._options
        )
        self._build(angles)
        self.keep()

    def __repr__(self) -> str:
        return f"Scene({self.config.hand.name} around a {self.config.object.shape}, {type(self.simulator).__name__})"

    @property
    def timestep(self) -> float:
        """Duration of one step [s]."""
        return self.config.substeps / self.config.engine.rate

    def load(self, config: SceneConfig) -> None:
        """Load another object, grasp or hand.

        All saved states are dropped. Unlike the constructor, `load` saves no "start" state: call
        `keep` before the next `reset`.

        Args:
            config: The new scene; its engine is ignored, and the present one stays.

        Raises:
            InvalidInputError: A finger cannot reach its contact; the scene is unchanged.
        """
        kinematics = (
            self.kinematics if config.hand == self.config.hand else HandKinematics(config.hand)
        )
        angles = _start_angles(config, kinematics)
        config = replace(config, engine=self.config.engine)
        if kinematics is not self.kinematics:
            simulator = class_of(config.engine, "simulator")(config.hand, **self._options)
            self.simulator.close()
            self.kinematics, self.simulator = kinematics, simulator
        self.config = config
        self._build(angles)

    def change_object(self, mass: float | None = None, friction: float | None = None) -> None:
        """Change the object's mass [kg], with its inertia, or friction; `reset` does not undo it."""
        item = self.config.object
        if mass is not None:
            inertia = item.inertia and tuple(np.multiply(item.inertia, mass / item.mass).tolist())
            item = replace(item, mass=mass, inertia=inertia)
        if friction is not None:
            item = replace(item, friction=friction)
        self.config = replace(self.config, object=item)
        self.core.mass = item.mass
        self.simulator.set_object(item)

    def set_gravity(self, gravity: Array) -> None:
        """Change gravity (3,) [m/s^2], world frame."""
        if not np.array_equal(gravity, self.gravity):
            self.gravity[:] = gravity
            self.core.set_gravity(gravity.tolist())
            self.simulator.set_gravity(gravity)
            self._core_is_current = False

    def set_joint_friction(self, torque: float) -> None:
        """Give each joint with a motor a Coulomb friction `torque` [N m], [N] for a sliding one.

        `reset` does not undo it, `load` does.
        """
        if torque != self._joint_friction:
            friction = np.zeros(self.config.hand.joint_count)
            friction[self.kinematics.motors] = torque
            self.simulator.set_joint_friction(friction.tolist())
            self._joint_friction = torque

    def keep(self, name: str = "start") -> None:
        """Save the current state for `reset`, in place of an earlier one of that name."""
        self.simulator.keep(name)
        self._core_is_current = False

    def reset(self, name: str = "start") -> None:
        """Restore a saved state exactly, contact forces included.

        Gravity and the object's mass, inertia and friction do not change.

        Raises:
            UnknownNameError: No state was saved under that name.
        """
        self.simulator.reset(name)
        self._core_is_current = False

    def step(self, torques: ArrayLike, external_wrench: ArrayLike | None = None) -> None:
        """Advance by one step, `substeps` steps of the engine.

        Args:
            torques: Joint torques [N m], (M,), clipped to the hand's limits.
            external_wrench: Force [N] and moment about the centre of mass [N m] on the object
                besides gravity, (6,), object frame. None for no wrench.

        Raises:
            InvalidInputError: An array has a wrong shape or a number that is not finite.
            SimulationError: The scene is closed.
        """
        limits = self.kinematics.torque_limits
        numbers = as_array(torques, (len(limits),), "torques")
        wrench = None
        if external_wrench is not None:
            wrench = as_array(external_wrench, (6,), "external_wrench").tolist()
        self.advance(np.clip(numbers, -limits, limits).tolist(), wrench)

    def advance(self, torques: list[float], wrench: list[float] | None) -> None:
        """Step without checks, for loops: `torques` within the limits, `wrench` as in `Simulator`."""
        self.simulator.advance(torques, wrench)
        self._core_is_current = False

    def look(self) -> Snapshot:
        """Return the current state of hand and object, and the contact forces of the last step.

        Raises:
            SimulationError: The simulation diverged, or the scene is closed.
        """
        reading = self.new_reading()
        if reading is not None and not self.core.read(reading):
            raise self.divergence_error(reading)
        return self._snapshot

    def new_reading(self) -> Array | None:
        """Return the simulator's reading if the core does not have it yet, else None.

        The caller must pass it to `core.read`: the next call returns None.
        """
        if self._core_is_current:
            return None
        reading = self.simulator.read()
        self._core_is_current = True
        return reading

    def close(self) -> None:
        """Free the simulator. Calling it again does nothing; any other call afterwards raises."""
        self.simulator.close()
        self._core_is_current = False

    def __reduce__(self) -> Any:
        raise SimulationError(
            "a simulation cannot be copied or pickled: both copies would drive one simulator; make a new Scene from its config"
        )

    def _build(self, angles: Array) -> None:
        self.simulator.load(self.config, angles)
        self._joint_friction = 0.0
        self.gravity = np.array(self.config.gravity, dtype=float)
        item = self.config.object
        self.core = core.Scene.make(
            self.kinematics.tree, item.surface, self.config.gravity, item.mass
        )
        self._snapshot = Snapshot(**self.core.arrays())
        self._core_is_current = False

    def divergence_error(self, reading: Array) -> SimulationError:
        """Return the error for a reading that `core.read` rejected; the next `look` reads again."""
        self._core_is_current = False
        body = reading[2 * len(self._snapshot.angles) :]
        return SimulationError(
            f"the simulation diverged: the object is at {body[:3].tolist()} m with velocity {body[7:10].tolist()} m/s; reset the "
            "scene, and use smaller torques or wrenches or a higher rate of the engine"
        )


def _start_angles(config: SceneConfig, kinematics: HandKinematics) -> Array:
    if config.start_angles:
        return np.array(config.start_angles)
    return kinematics.solve(config.nominal_tips())
