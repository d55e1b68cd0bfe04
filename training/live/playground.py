"""The simulated hand, to be pulled at: advanced tick by tick, read as what is to be shown, without any page."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grasp_env._check import Array
from grasp_env.config import EnvConfig
from grasp_env.control.loop import ForceLoop
from grasp_env.env.stage import Stage
from grasp_env.errors import GraspError
from grasp_env.force import InitialForceRule
from grasp_env.sim.scene import Scene
from grasp_env.task.motion import resting_target
from training.live.question import Mood

STIFFNESS = 400.0
"""[N/m] of the spring between the object and the mouse."""
_GONE = 1.0
"""[m] from its place at which a lost object is no longer followed."""


@dataclass(frozen=True, eq=False)
class View:
    """What of the hand is to be shown; a copy, which later ticks leave alone.

    Attributes:
        mood, status, words: as of an `Answer`.
        points, inwards, forces: (N, 3) contacts [m], unit normals into the object, commanded forces on it [N], world frame.
        active: (N,) whether the finger is in contact, as far as the controller knows. friction: that it believes in.
        margins: (N,) friction * normal - |tangential| of the commanded forces [N]; 0 without contact.
        normals: (N, 2) commanded and measured normal force [N].
        frames, origins: (M, 3, 3), (M, 3) of the links, world frame [m].
        position, rotation: of the object, world frame.
        grip, push: (3,) where it is pulled [m] and with what force [N], world frame; zero: it is not.
        torque_margin: least distance of a joint's torque from its limit [N m].
        drift, tilt: [m], [rad] from where the object should be.
        iterations: of the last optimisation.
        time: simulated since the reset [s].
    """

    mood: Mood
    status: str
    words: str
    points: Array
    inwards: Array
    forces: Array
    active: NDArray[np.bool_]
    friction: float
    margins: Array
    normals: Array
    frames: Array
    origins: Array
    position: Array
    rotation: Array
    grip: Array
    push: Array
    torque_margin: float
    drift: float
    tilt: float
    iterations: int
    time: float


class Playground:
    """A hand that holds an object at rest, in simulation.

    Args:
        config: as of the environment; its task and disturbance are left out.
        initial_force: the start rule; None: the config's.
        most_push: of the spring [N].

    Attributes:
        lost: "" while the object is held, else how it was lost, in words.

    Raises:
        GraspError: the hand cannot hold the object.

    Example:
        >>> ground = Playground(EnvConfig())
        >>> ground.pull(np.zeros(3), np.array([0.1, 0.0, 0.0]))   # towards a mouse 0.1 m to the side
        >>> ground.advance(50)
        >>> view = ground.view()
        >>> view.status, bool(view.drift < 1e-3), view.push.round(1) + 0.0
        ('held', True, array([5., 0., 0.]))
        >>> ground.close()
    """

    def __init__(self, config: EnvConfig, initial_force: str | InitialForceRule | None = None, most_push: float = 5.0) -> None:  # fmt: skip
        self.config = replace(config, task="hold", disturbance="none", randomise=()).resolved()
        self._loop = ForceLoop(self.config, self.config.initial_force if initial_force is None else initial_force)
        self._stage = Stage(self.config, self._loop, False, False)
        self._rng = np.random.default_rng(0)
        self._every = self.config.control_rate // self.config.agent_rate
        self._target = resting_target(1)[0]
        self.most_push = most_push
        self.reset()

    @property
    def scene(self) -> Scene:
        """The simulation."""
        return self._stage.scene

    @property
    def dt(self) -> float:
        """Of a tick [s]."""
        return self._loop.dt

    def reset(self) -> None:
        """The hand holds the object at rest again, of the mass and friction it had first."""
        item = self._stage.item
        self._stage.set(self._rng)
        if self.scene.config.object.friction != item.friction:
            self._take(item.mass, item.friction)
        self._loop.reset(self._rng)
        self._begin()

    def change_object(self, mass: float, friction: float) -> None:
        """Another mass [kg] and friction from now on; the controller is told."""
        self._take(mass, friction)
        self._loop.rest(np.zeros(6), self.scene.gravity, self._target)

    def pull(self, grip: Array, to: Array) -> None:
        """A spring pulls the object at `grip` (3,), its frame [m], towards `to` (3,), world frame [m], until `release`."""
        self._grip, self._to = np.array(grip, dtype=float), np.array(to, dtype=float)

    def release(self) -> None:
        """Nothing pulls any more."""
        self._to = None

    def advance(self, ticks: int) -> None:
        """So many control ticks; nothing moves any more once the object is out of reach or the simulation has diverged."""
        loop, scene = self._loop, self.scene
        for _ in range(ticks):
            if self._ended:
                return
            wrench = self._pushed()
            try:
                due = self._tick % self._every == 0
                if due:
                    loop.begin_step()
                torques = loop.tick(wrench, scene.gravity, self._target, due)
                scene.advance(torques, wrench.tolist() if wrench.any() else None)
                snapshot = scene.look()
            except GraspError as error:
                self.lost, self._ended = f"The simulation ended: {error}", True
                return
            self._tick += 1
            self._open = 0.0 if loop.closure else self._open + loop.dt
            self._ended = bool(np.linalg.norm(snapshot.position) > _GONE)
            self._judge()

    def view(self) -> View:
        """What is to be shown now."""
        loop, snapshot = self._loop, self.scene.look()
        outcome = loop.outcome(self._target, self._error, self._measured)
        active = np.zeros(len(loop.force), dtype=bool)
        active[loop.fingers] = True
        force = np.where(active[:, None], loop.force, 0.0)
        rotation, position = snapshot.rotation.copy(), snapshot.position.copy()
        mood, status, words = self._said()
        return View(
            mood, status, words, snapshot.touch.copy(), snapshot.normals @ rotation.T,
            np.einsum("nij,nj->ni", rotation @ loop.frames, force), active, loop.friction,
            loop.friction * force[:, 0] - np.hypot(force[:, 1], force[:, 2]), np.column_stack([force[:, 0], self._measured[:, 0]]),
            snapshot.frames.copy(), snapshot.origins.copy(), position, rotation, position + rotation @ self._grip,
            rotation @ self._pushed()[:3], float(loop.effort.margin), outcome.drift, outcome.tilt, loop.iterations, self._tick * loop.dt,
        )  # fmt: skip

    def close(self) -> None:
        """Frees the simulator."""
        self.scene.close()

    def _begin(self) -> None:
        loop = self._loop
        self._tick, self._open, self._ended, self.lost = 0, 0.0, False, ""
        self._grip, self._to = np.zeros(3), None
        self._error, self._measured = np.zeros(12), np.zeros((len(loop.force), 3))
        loop.rest(np.zeros(6), self.scene.gravity, self._target)

    def _take(self, mass: float, friction: float) -> None:
        self.scene.change_object(mass, friction)
        self._loop.begin(self.scene)
        self._loop.settling = False

    def _pushed(self) -> Array:
        """The spring's wrench (6,) on the object [N, N m], object frame."""
        if self._to is None:
            return np.zeros(6)
        snapshot = self.scene.look()
        force = STIFFNESS * (self._to - snapshot.position - snapshot.rotation @ self._grip)
        force *= min(1.0, self.most_push / max(float(np.linalg.norm(force)), 1e-12))
        wrench = np.empty(6)
        wrench[:3] = snapshot.rotation.T @ force
        wrench[3:] = np.cross(self._grip, wrench[:3])
        return wrench

    def _judge(self) -> None:
        """Whether the object is lost; once it is, it stays so until the reset."""
        if self.lost:
            return
        outcome = self._loop.outcome(self._target, self._error, self._measured)
        assert self.config.max_drift is not None
        assert self.config.max_tilt is not None
        if outcome.drift > self.config.max_drift or outcome.tilt > self.config.max_tilt:
            self.lost = (
                f"It has moved {1e3 * outcome.drift:.0f} mm and turned {math.degrees(outcome.tilt):.0f} degrees from its place. "
                "Take hold again; then pull less, or raise the friction."
            )
        elif self._open > self.config.max_contact_gap:
            self.lost = "The fingers that still touch it cannot balance the load. Take hold again; then pull less, or raise the friction."  # fmt: skip

    def _said(self) -> tuple[Mood, str, str]:
        if self.lost:
            return Mood.BAD, "lost", self.lost
        if not self._loop.closure:
            return (
                Mood.WARNING,
                "slipping",
                "The fingers that touch cannot balance this load: each keeps what its cone allows.",
            )
        if self._loop.effort.saturated:
            return Mood.WARNING, "motors at their limit", "No force within the joints' torques balances this load: they give what they have."  # fmt: skip
        return Mood.GOOD, "held", "The fingers balance gravity and the pull, every commanded force inside its cone."
