"""`FourFingerGrasp-v0`: a four-finger hand in PyBullet whose grasp forces are optimised at every step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from grasp_env import observation
from grasp_env._check import as_wrench
from grasp_env.config import EnvConfig
from grasp_env.control import ForceLoop, rotation_vector
from grasp_env.disturbance import Disturbance
from grasp_env.errors import (
    GraspError,
    InvalidInputError,
    SimulationError,
    UnknownNameError,
)
from grasp_env.force.initial import InitialForceRule
from grasp_env.reward import reward_terms
from grasp_env.sim import Camera, Scene, SceneConfig


class FourFingerGrasp(gym.Env[NDArray[np.float32], NDArray[np.float32]], EzPickle):
    """A thumb and three fingers hold a 0.1 m cuboid while an external wrench acts on it.

    ## Step
    Contacts are read from the simulator, G is built from them, the wrench to balance is external wrench + gravity +
    object-pose feedback, the initial force is the start rule's (by default the paper's linear combination of 12 offline
    optima) plus the action, the reduced gradient flow optimises it, and the forces become joint torques. The agent
    acts at 50 Hz; pose feedback and torques run at 250 Hz, physics at 500 Hz (see `EnvConfig`).

    ## Action space
    `Box(-1, 1, (6,), float32)`: an adjustment of the initial force along six internal forces (null-space coordinates,
    times `action_scale` newtons); beyond +-1 it is clipped. The six directions are squeezes along the lines between two contacts
    (thumb-middle, thumb-left, thumb-right, middle-left, middle-right, left-right), orthonormalised, and move
    continuously with the contacts. Zero is the paper. An adjusted start is repaired: the force of least Phi between
    the linear combination and it.

    ## Observation space
    `Box(-bound, bound, (59,), float32)`, clipped:

    | index | name | unit | frame | bound |
    |---|---|---|---|---|
    | 0-2 | wrench to balance: force | N | object | 200 |
    | 3-5 | wrench to balance: moment | N m | object | 20 |
    | 6-8 | object position error | m | world | 1 |
    | 9-11 | object orientation error | rad | world | 3.2 |
    | 12-14 | object linear velocity | m/s | world | 10 |
    | 15-17 | object angular velocity | rad/s | world | 50 |
    | 18-29 | contact displacement from nominal | m | object | 0.2 |
    | 30-41 | commanded force (normal, o, t) | N | contact | 500 |
    | 42-53 | measured force (normal, o, t) | N | contact | 500 |
    | 54-57 | touching | 1 | - | 1 |
    | 58 | solver friction | 1 | - | 10 |

    ## Reward
    `held_reward` while the object is held (or `-failure_cost` once), `- iteration_cost * iterations`,
    `- force_cost * total normal force`; each term stands in `info["reward/..."]`.

    ## Episode end
    Terminated when the object is lost (`info["failure"]`: "dropped", "contact_lost", "force_optimisation" or
    "simulation_diverged"). Truncation is the time limit's: 100 steps = 2 s under `gym.make`.

    ## Info
    The same keys at every reset and step: `iterations`, `trials`, `status` (a `Status`, "none" at reset, "failed"), `objective`, `optimality_gap`,
    `cone_margin` of the optimisation; `wrench` (6,), `commanded_force` (4, 3), `measured_force` (4, 3), `force_error`
    [N], `touching` (4,), `slip` [m/s], `slip_distance` [m], `drift` [m], `tilt` [rad], `peak_torque` [N m],
    `repaired_controls`, `time` [s], `failure`, `is_success`, and the reward terms.

    ## Reset options
    `options={"wrench": (6,)}` replaces the episode's external wrench by a constant one [N, N m].

    Args:
        render_mode: None, "rgb_array" or "human" (needs a display).
        initial_force: the name of a start rule or any rule(grasp, wrench) -> (4, 3); None: `config.initial_force`.
        config: all settings; None: the defaults.
        **settings: single settings of `EnvConfig` to replace.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("grasp_env:FourFingerGrasp-v0", wrench="paper_path")
        >>> obs, info = env.reset(seed=0)
        >>> obs, reward, terminated, truncated, info = env.step(np.zeros(6, dtype=np.float32))
        >>> info["status"], bool(info["touching"].all())
        ('optimal', True)
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        initial_force: str | InitialForceRule | None = None,
        config: EnvConfig | None = None,
        **settings: Any,
    ) -> None:
        EzPickle.__init__(self, render_mode, initial_force, config, **settings)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise UnknownNameError("render_mode", render_mode, self.metadata["render_modes"])
        if not isinstance(config, EnvConfig | None):
            raise InvalidInputError(
                f"config must be an EnvConfig or None, got {config!r}; single settings are keywords"
            )
        self.config = (config or EnvConfig()).override(**settings)
        self.metadata = {**self.metadata, "render_fps": self.config.agent_rate}
        self.render_mode = render_mode
        limit = observation.bounds()
        self.observation_space = gym.spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (6,), dtype=np.float32)
        self._loop = ForceLoop(self.config, self.config.initial_force if initial_force is None else initial_force)
        scene = SceneConfig(
            object_mass=self.config.object_mass,
            friction=self.config.friction,
            gravity=self.config.gravity,
            physics_rate=self.config.physics_rate,
        )
        self._scene: Scene | None = Scene(scene, gui=render_mode == "human")
        self._camera: Camera | None = None
        self._nominal = np.array(scene.contact_points)
        self._disturbance = Disturbance(self.config.override(wrench="none"), np.random.default_rng(0))
        self._started = False
        self._settle()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Back to the settled grasp, with a new disturbance; see the class."""
        super().reset(seed=seed)
        scene = self._open_scene()
        self._disturbance = Disturbance(self.config, self.np_random)
        for name, value in (options or {}).items():
            if name != "wrench":
                raise UnknownNameError("reset option", name, ("wrench",))
            given = tuple(as_wrench(value, "options['wrench']").tolist())
            constant = self.config.override(wrench="constant", wrench_value=given, wrench_scale=1.0)
            self._disturbance = Disturbance(constant, self.np_random)
        scene.reset()
        self._loop.reset()
        self._ticks = 0
        self._apart = np.zeros(4)
        self._slip_distance = 0.0
        self._failure = ""
        self._peak_torque = 0.0
        self._started = True
        self._loop.wrench = self._loop.wrench_to_balance(scene.state(), self._told())
        self._observed = self._observe(scene)
        return self._observed, self._info(scene, reward_terms(self.config, True, 0, 0.0))

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One agent step; see the class.

        Raises:
            InvalidInputError: an action of the wrong shape or not finite.
            SimulationError: before `reset`, after `close`, or after the episode ended.
        """
        scene = self._open_scene()
        if not self._started:
            raise SimulationError("step before reset: call reset() first")
        if self._failure:
            raise SimulationError(f"the episode ended ({self._failure}): call reset()")
        adjustment = self._adjustment(action)
        try:
            self._loop.optimise(scene, self._told(), adjustment)
        except GraspError:
            self._failure = "force_optimisation"
        else:
            self._simulate(scene)
        if not self._failure:
            self._failure = self._lost(scene)
        solution = self._loop.solution
        terms = reward_terms(
            self.config,
            not self._failure,
            solution.iterations if solution else self.config.max_iterations,
            solution.total_normal_force if solution else 0.0,
        )
        if self._failure != "simulation_diverged":
            self._observed = self._observe(scene)
        info = self._info(scene, terms)
        if self.render_mode == "human":
            self.render()
        return self._observed, float(sum(terms.values())), bool(self._failure), False, info

    def render(self) -> NDArray[np.uint8] | None:
        """An (H, W, 3) picture in "rgb_array" mode; the window of "human" mode draws itself."""
        scene = self._open_scene()
        if self.render_mode != "rgb_array":
            return None
        if self._camera is None:
            self._camera = Camera(scene)
        return self._camera.capture()

    @property
    def scene(self) -> Scene:
        """The simulation, for cameras and measurements."""
        return self._open_scene()

    def close(self) -> None:
        """Frees the simulator; twice is fine."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None
            self._camera = None

    def _settle(self) -> None:
        scene = self._open_scene()
        external = np.zeros(6)
        # a rule that does not fit this grasp says so itself, before the hand moves
        self._loop.optimizer.solve(self._loop.wrench_to_balance(scene.state(), external))
        self._loop.reset()
        every = self.config.physics_rate // self.config.control_rate
        solve_every = self.config.physics_rate // self.config.agent_rate
        tick = 0
        torques = np.zeros(12)

        def controller(current: Scene) -> NDArray[np.float64]:
            nonlocal tick, torques
            if tick % solve_every == 0:
                self._loop.optimise(current, external)
            if tick % every == 0:
                torques = self._loop.torques(current, external)
            tick += 1
            return torques

        try:
            scene.settle(controller)
        except GraspError as error:
            raise SimulationError(
                f"the hand could not close on the object: {error}; lower friction_margin (now "
                f"{self.config.friction_margin}), raise barrier_weight, or make the object lighter"
            ) from error

    def _simulate(self, scene: Scene) -> None:
        config = self.config
        dt = 1.0 / config.control_rate
        try:
            for _ in range(config.control_rate // config.agent_rate):
                external = self._disturbance.at(self._ticks)
                torques = self._loop.torques(scene, self._told())
                peak = min(float(np.abs(torques).max()), scene.config.hand.torque_limit)
                self._peak_torque = max(self._peak_torque, peak)
                for _ in range(config.physics_rate // config.control_rate):
                    scene.step(torques, external)
                contacts = scene.contacts()
                self._apart = np.where(contacts.touching, 0.0, self._apart + dt)
                self._slip_distance += float(contacts.slip[contacts.touching].max(initial=0.0)) * dt
                self._ticks += 1
        except SimulationError:
            self._failure = "simulation_diverged"

    def _told(self) -> NDArray[np.float64]:
        """What the controller knows of the external wrench now; nothing of it before the episode starts."""
        tick = self._ticks - self.config.wrench_delay
        return self._disturbance.at(tick) if self.config.wrench_known and tick >= 0 else np.zeros(6)

    def _lost(self, scene: Scene) -> str:
        state = scene.state()
        drift = float(np.linalg.norm(state.position))
        if drift > self.config.max_drift or np.linalg.norm(rotation_vector(state.rotation)) > self.config.max_tilt:
            return "dropped"
        return "contact_lost" if self._apart.max() > self.config.max_contact_gap else ""

    def _adjustment(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (6,) or not np.isfinite(values).all():
            raise InvalidInputError(f"action must be 6 finite numbers in [-1, 1], got {np.asarray(action).tolist()}")
        return self.config.action_scale * np.clip(values, -1.0, 1.0)

    def _observe(self, scene: Scene) -> NDArray[np.float32]:
        state, contacts = scene.state(), scene.contacts()
        measured = self._loop.grasp.to_contact_frame(contacts.forces)
        return observation.build(
            self._loop.wrench,
            state.position,
            rotation_vector(state.rotation),
            state.linear_velocity,
            state.angular_velocity,
            contacts.points - self._nominal,
            self._loop.force,
            measured,
            contacts.touching.astype(np.float64),
            self._loop.friction[0],
        )

    def _info(self, scene: Scene, terms: dict[str, float]) -> dict[str, Any]:
        diverged = self._failure == "simulation_diverged"
        solution = self._loop.solution
        measured, touching, slip = np.zeros((4, 3)), np.zeros(4, dtype=bool), 0.0
        drift = tilt = 0.0
        if not diverged:
            state, contacts = scene.state(), scene.contacts()
            measured = self._loop.grasp.to_contact_frame(contacts.forces)
            touching, slip = contacts.touching.copy(), float(contacts.slip.max())
            drift = float(np.linalg.norm(state.position))
            tilt = float(np.linalg.norm(rotation_vector(state.rotation)))
        error = np.abs(measured - self._loop.force).max() if solution is not None and not diverged else 0.0
        return {
            "iterations": solution.iterations if solution else 0,
            "trials": solution.trials if solution else 0,
            "status": solution.status.value if solution else ("failed" if self._failure else "none"),
            "objective": solution.objective if solution else 0.0,
            "optimality_gap": min(solution.optimality_gap, 1e9) if solution else 0.0,
            "cone_margin": solution.cone_margin if solution else 0.0,
            "wrench": self._loop.wrench.copy(),
            "commanded_force": self._loop.force.copy(),
            "measured_force": measured,
            "force_error": float(error),
            "touching": touching,
            "slip": slip,
            "slip_distance": self._slip_distance,
            "drift": drift,
            "tilt": tilt,
            "peak_torque": self._peak_torque,
            "repaired_controls": self._loop.repaired,
            "time": self._ticks / self.config.control_rate,
            "failure": self._failure,
            "is_success": not self._failure,
            **terms,
        }

    def _open_scene(self) -> Scene:
        if self._scene is None:
            raise SimulationError("the environment is closed: make a new one")
        return self._scene
