"""`FourFingerGrasp-v0`: a simulated hand with grasp forces that are optimised at every step."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grasp_env.inputs.extras import need

with need("sim"):
    import gymnasium as gym
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.utils import EzPickle

    from grasp_env._spec import ENV_ID, FINISH, IDS, GraspSpec

from grasp_env.config import EnvConfig
from grasp_env.config.env import as_config, keywords_to_json
from grasp_env.control.loop import NOTHING, ForceLoop
from grasp_env.control.structure import finger_structure
from grasp_env.env.actions import MODES
from grasp_env.env.annotate import Annotator
from grasp_env.env.faults import lasting_fault, passing_fault
from grasp_env.env.motors import Motors
from grasp_env.env.observation import Observer
from grasp_env.env.plan import Plan, make_plan
from grasp_env.env.stage import Stage
from grasp_env.errors import GraspError, InvalidInputError, SimulationError, shown
from grasp_env.force import ForceSolution
from grasp_env.inputs.arguments import Array, as_array, as_wrench, choice, instance, warn, whole
from grasp_env.sim import Scene
from grasp_env.sim.engine import class_of
from grasp_env.sim.grasping.record import HandGrasp
from grasp_env.sim.picture.annotation import LONGEST, Annotation
from grasp_env.sim.picture.camera import Camera, CameraConfig
from grasp_env.sim.picture.overlay import room
from grasp_env.sim.picture.painter import Painter
from grasp_env.task.disturbance import name_of

NO_COSTS = (0.0, 0.0, 0.0)
"""Costs of force, torque and change of force at reset and after a fault."""


class FourFingerGrasp(gym.Env[Any, NDArray[np.float32]], EzPickle):
    """Simulated hand that holds an object against wrenches, or moves it along a given motion.

    ## Step
    The agent acts at 50 Hz, the controller at 250 Hz, the physics at that rate or faster. A control
    tick reads the contacts of the fingers that touch. The wrench to balance is the external wrench
    plus gravity plus pose feedback, minus the wrench that accelerates the object along its target
    motion. The ticks differ in how they find the forces:

    - First tick of a step: the initial force comes from the start rule (by default the paper's
      linear combination of 12 offline optima) plus the action. The method optimises it: by default
      the reduced gradient flow, on soft contacts Newton, because the flows do not support them.
    - Other ticks: Newton from the last command, or the conic solver if `method` is "conic".
      `info["followed"]` counts the iterations.

    The forces become joint torques. A spring and damper hold each touching fingertip at its place
    on the object's target pose, see `controller.grip_stiffness`; where such a spring pulls for
    long, the preload of the finger grows to at most 1 N. A finger without contact reaches for its
    place. When a finger slips off or lands, the forces of all others restore
    balance at the next tick. Any further change of a force component is limited to
    `controller.force_rate` [N/s], unless the torque limits require more.

    Torques stay within the motors' limits, reduced by the torques that carry the links' weight. If
    a force needs more, Newton within the limits continues from it in the same control tick
    (`info["limited"]` counts its iterations). There are two fallbacks; in both the episode goes on:

    - No force within the margin balances the wrench: forces inside the friction cones that do, or
      else those with the smallest imbalance, are commanded. So are they where balance would need
      forces far above the last ones and the load.
    - Such forces exist, but none within the torque limits: the one that exceeds the limits least is
      commanded, and its torques are clipped to the limits (`info["saturated"]`).

    The motors of a finger with missing or coupled joints control only some components of its force.
    Its rigid links carry the others passively, as the physics engine determines.

    The grasp is simulated: the fingers close on a supported object, and the support is then
    removed. At the start of an episode the contact forces balance the weight within 1 %, as a mean
    over up to 50 ms. If
    `HandDescription.placed` is False and no `contact_points` are given, the environment first
    searches for a pose of the palm from which the hand can hold the object.

    ## Tasks
    `Hold()` against `disturbance`, `Move(motion)`, `Payload()` (the mass grows), `SixDirections()`
    (pushes of 10 N/kg). A disturbance is a record such as `RandomWrench()`, its name, or any
    function; see `grasp_env.task.Disturbance`.

    ## Action space
    `Box(-1, 1, float32)`, clipped; `agent.action_mode` gives its meaning and shape:

    - "initial_force" (3N - 6,): an adjustment of the initial force along internal forces
      (null-space coordinates, times `action_scale` newtons). The six directions of the four-finger
      hand are squeezes along the lines between two contacts (thumb-middle, thumb-left, thumb-right,
      middle-left, middle-right, left-right), orthonormalised. They move continuously with the
      contacts; with fewer contacts they are projected. The solver starts from the point with the
      smallest Phi on the segment from the start rule's force to the adjusted one.
    - "residual" (3N,): a change of the solver's forces, `action_scale` newtons along normal, o and
      t of each finger. Commanded are the forces nearest to their sum that balance the wrench within
      the margin, as far as the motors can. Zero is the solver's force.
    - "grip" (2,): the margin of the solver. The first number goes from all of the friction at -1
      through `controller.friction_margin` at 0 to a share of 0.2 at 1; the second from a preload of
      0 through `controller.preload` to `action_scale` newtons more.
    - "contact_force" (3N,): the contact forces themselves, without a solver: per finger normal in
      [0, 2 `action_scale`], o and t in +-`action_scale`.
    - "none" (1,): ignored.

    `gym.make` warns if "initial_force" leaves an agent nothing to improve, as with `conic`, which
    has no start, and Newton, whose iteration count hardly depends on the start.

    ## Observation space
    `Box(-bound, bound, (83,), float32)` for the four-finger hand, clipped:

    | index | key | name | unit | frame | bound |
    |---|---|---|---|---|---|
    | 0-2 | `force` | wrench to balance: force | N | object | 200 |
    | 3-5 | `moment` | wrench to balance: moment | N m | object | 20 |
    | 6-8 | `position` | object position minus the desired one | m | world | 1 |
    | 9-11 | `orientation` | object orientation against the desired one | rad | world | 3.2 |
    | 12-14 | `linear_velocity` | object linear velocity minus the desired one | m/s | world | 10 |
    | 15-17 | `angular_velocity` | object angular velocity minus the desired one | rad/s | world | 50 |
    | 18-29 | `contact_points` | contact point | m | object | 0.5 |
    | 30-41 | `normals` | inward normal | 1 | object | 1 |
    | 42-53 | `commanded_force` | commanded force (normal, o, t) | N | contact | 500 |
    | 54-65 | `measured_force` | measured force (normal, o, t) | N | contact | 500 |
    | 66-69 | `touching` | touching | 1 | - | 1 |
    | 70-81 | `joint_angles` | joint angle | rad | - | 7 |
    | 82 | `friction` | solver friction | 1 | - | 10 |

    With the action mode "grip" there are 2N more, so that an agent feels the grip:

    | key | name | unit | frame | bound |
    |---|---|---|---|---|
    | `tangential_share` | tangential over normal measured force | 1 | - | 10 |
    | `slid` | distance that the fingertip slid on the object | m | - | 0.1 |

    `observation="dict"` gives a `Dict` of the same numbers by their keys.

    ## Reward
    `reward.held` * (1 - c) in a step after which the object is held, that is if
    `info["is_success"]`; otherwise 0. c is the sum of four costs, each from 0 to 1 and times its
    weight in `RewardSettings`:

    - `iterations`: min(1, iterations of the method / `iteration_scale`); 1 if the contacts cannot
      balance the wrench.
    - `force`: 1 - s_min / s, where s is the sum of the commanded normal forces and s_min the
      smallest sum that balances the wrench with all of the true friction; 1 if no forces balance
      it.
    - `torque`: the largest |torque| / limit of a joint in the step.
    - `force_change`: sum |f - f0| / sum (|f| + |f0|) over the components of the commanded forces f
      after and f0 before the step.

    The weights add up to at most 0.9, so every such step pays more than 0. The step of the first
    fault that lasts pays -`fault_cost`, by default -10. The terms `info["reward/held"]`,
    `info["reward/iterations"]`, ... add up to the reward.

    ## Episode end
    An episode is terminated when the object is lost, or at the first fault that lasts if
    `limits.end_at_fault`, which is the default of the action mode "contact_force".
    `info["failure"]` is the reason, such a fault or:

    - "dropped": it is beyond `limits.max_drift` or `limits.max_tilt` from its target pose.
    - "closure_lost": no forces balanced the wrench for longer than `limits.max_contact_gap`.
    - "force_optimisation": the optimisation failed, for example in a user's start rule.
    - "simulation_diverged": the simulator's state is no longer finite or the object is far away.

    An episode is truncated after `limits.duration`, by default that of the task (hold 2 s, move and
    payload 4 s, six_directions 12 s).

    `is_success` means that the object is held. `info["fault"]` is the first reason why it is not,
    "" if it is: the `failure`, or

    - faults that last for the rest of the episode: "slid" (`limits.max_slide`), "overlap"
      (`limits.max_overlap`), "stray_force" (`limits.max_stray`), "crushed" (`limits.max_force`);
    - faults that may pass: "drifted" (beyond the task's own limits), "not_carried" (in this step
      the fingertips left more than `limits.max_imbalance` of the load unbalanced, or fewer than two
      pushed), "moving" (`limits.max_speed`).

    ## Info
    Every reset and step returns the same keys:

    | key | shape | unit | meaning |
    |---|---|---|---|
    | `iterations`, `trials` | | 1 | accepted and tried iterations of the method in the step |
    | `status` | | str | the solver's `Status`; "none" at reset, without optimisation, and if the method found no force; "failed" if the step failed before there was a status |
    | `objective`, `optimality_gap` | | 1 | objective and certified relative gap |
    | `cone_margin` | | N | smallest distance to a friction cone |
    | `force_closure` | | bool | the contacts could balance the wrench, or nearly all of it, at the last tick |
    | `contacts`, `contact_changes` | | 1 | number of fingers in contact, and of its changes since reset |
    | `wrench` | (6,) | N, N m | wrench to balance, object frame |
    | `commanded_force`, `measured_force` | (N, 3) | N | contact forces, contact frames; commanded are the optimal ones and the springs |
    | `force_error` | | N | largest component of their difference |
    | `touching` | (N,) | bool | fingers that touch |
    | `stray_force` | | N | force of links other than fingertips on the object |
    | `slip` | | m/s | highest tangential speed of a fingertip on the object |
    | `slip_distance` | | m | largest distance since reset that a fingertip slid on the object |
    | `overlap` | | m | largest penetration of a fingertip since reset |
    | `stray_share` | | 1 | largest `stray_force` since reset, as a fraction of the load |
    | `peak_force` | | N | largest force of a fingertip on the object since reset |
    | `imbalance` | | 1 | force that the fingertips lacked to move the object as desired, a mean over the step, as a fraction of the load |
    | `speed` | | m/s | bound on the speed of the contacts against the desired motion |
    | `drift`, `tilt` | | m, rad | distance and angle of the object from its target pose |
    | `peak_torque` | | N m | largest absolute torque since reset |
    | `followed` | | 1 | iterations at the control ticks after the step's first |
    | `limited` | | 1 | iterations of Newton within the torque limits |
    | `torque_margin` | | N m | smallest distance of a torque from its limit in the step |
    | `torque_share` | | 1 | largest absolute torque of the step as a fraction of its limit |
    | `saturated` | | bool | torques were clipped: no force within the limits balances the wrench |
    | `structure_share` | (N,) | 1 | fraction of each finger's force that its motors cannot produce, for the loads of this episode; one warning if above 0.65 |
    | `time` | | s | time since reset |
    | `object_mass`, `object_friction` | | kg, 1 | mass; friction coefficient between object and fingertips |
    | `object_shape`, `object_size` | | str, m | shape and largest extent |
    | `redrawn` | | 1 | number of random objects rejected at this reset because the hand could not hold them |
    | `failure`, `fault`, `is_success` | | str, str, bool | see "Episode end" |
    | `reward/held`, ... | | 1 | terms of the reward |

    `agent={"info": "numbers"}` leaves the strings out and makes arrays of all numbers, as torchrl
    needs.

    `force_closure` is always True where forces are not optimised: with the controllers
    "constant_squeeze" and "pd" and the action mode "contact_force". "pd" commands no forces: its
    `commanded_force` and the force terms are 0.

    ## Reset options
    `options={"wrench": (6,)}` replaces the episode's external wrench by a constant one [N, N m].

    Args:
        render_mode: None, "rgb_array" or "human" (needs a display).
        config: all settings, an `EnvConfig` or its dict or JSON; None: the defaults.
        **settings: changes to `config`: fields of `EnvConfig`, each as a record or a dict of its
            settings, and the plain keywords `shape`, `size`, `mass`, `friction`, `method`,
            `initial_force`, `duration`, `action_mode` and `observation`.

    Attributes:
        config: the settings, resolved.
        episode: the settings of the current episode, including drawn ones.
        step_limit: number of steps after which episodes are truncated.

    Raises:
        UnknownNameError, UnknownSettingError: see `EnvConfig.override`.
        InvalidInputError: a value out of range, contacts off the surface or out of reach, a mesh
            that cannot be closed.
        SimulationError: the hand cannot hold the object, or there is no display for a window.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("grasp_env:FourFingerGrasp-v0", disturbance="paper_path")
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
        config: EnvConfig | dict[str, Any] | str | None = None,
        **settings: Any,
    ) -> None:
        EzPickle.__init__(self, render_mode, config, **settings)
        if render_mode is not None:
            choice(render_mode, "render_mode", self.metadata["render_modes"])
        self.config = config = as_config(config).override(**settings).resolved()
        self.metadata = {**self.metadata, "render_fps": config.agent.rate}
        self.render_mode = render_mode
        self._loop = ForceLoop(config, config.solver.initial_force)
        self._stage: Stage | None = self._new_stage()
        hand = self._stage.kinematics.hand
        tips, joints = hand.finger_count, hand.joint_count
        self._torque_limits = hand.torque_limits
        self._annotator = Annotator(config, hand)
        self._observer = Observer(tips, joints, config.action_mode)
        vector = gym.spaces.Box(-self._observer.bound, self._observer.bound, dtype=np.float32)
        self._as_dict = config.agent.observation == "dict"
        blocks: dict[str, gym.Space[Any]] = {
            block.key: gym.spaces.Box(-block.bound, block.bound, (block.size,))
            for block in self._observer.fields
        }
        self.observation_space = gym.spaces.Dict(blocks) if self._as_dict else vector
        self._mode = MODES[config.action_mode]
        self._action_shape = (self._mode.size(tips),)
        self.action_space = gym.spaces.Box(-1.0, 1.0, self._action_shape, dtype=np.float32)
        self._ticks_per_step = config.controller.rate // config.agent.rate
        limits = config.limits
        assert limits.duration is not None
        assert limits.max_drift is not None
        assert limits.max_tilt is not None
        self._max_drift = limits.max_drift
        self._max_tilt = limits.max_tilt
        self.step_limit = max(1, round(limits.duration * config.agent.rate))
        self._camera: Camera | None = None
        self._window: Painter | None = None
        self._started = self._ended = self._warned = False
        self._spec: EnvSpec | None = None
        self._failure = self._fault = ""
        self._broken = False

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.config.task.name}, {name_of(self.config.disturbance)}, {self._loop!r})"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Return to the settled grasp, with a new disturbance and new randomised settings.

        Args:
            seed: seed of everything that is drawn; None: the generator continues.
            options: None, or {"wrench": (6,)}; see the class.
        """
        super().reset(seed=None if seed is None else whole(seed, "seed", 0))
        if self._stage is None:
            self._stage = self._new_stage()
        stage = self._stage
        scene, constant = stage.scene, None
        for name, value in instance({} if options is None else options, dict, "options").items():
            choice(name, "reset option", ("wrench",))
            constant = as_wrench(value, "options['wrench']")
        self._started = False
        scene.set_joint_friction(0.0)
        stage.set(self.np_random)
        self.episode = episode = stage.episode
        self._nominal_gravity = np.array(episode.gravity)
        self._measured_wrench = episode.sensors.wrench == "measured"
        plan = make_plan(episode, self.np_random, scene.config.object.mass)
        if constant is not None:
            plan = replace(plan, wrench=np.tile(constant, (len(plan), 1)))
        self._plan = plan
        if self.render_mode is not None:
            self._annotator.expect(plan, scene, self._loop.friction)
        self._wrenches, self._targets = list(plan.wrench), list(plan.target)
        self._pushes = plan.wrench.tolist() if plan.wrench.any() else [None] * len(plan)
        self._world_pushes = plan.push if plan.push.any() else None
        item = episode.object
        self._mass = item.mass
        self._object_info = {
            "object_friction": item.friction * scene.config.hand.tip_friction,
            "object_shape": item.shape,
            "object_size": max(item.extent),
            "redrawn": stage.redrawn,
        }
        self._gravity_differs = not (plan.gravity == self._nominal_gravity).all()
        self._mass_differs = not (plan.mass_factor == 1.0).all()
        self._last_row = len(plan) - 1
        self._loop.reset(self.np_random)
        self._motors = Motors(episode, self._torque_limits, int(self.np_random.integers(2**63)))
        scene.set_joint_friction(episode.motors.friction)
        self._tick, self._time_without_closure = 0, 0.0
        self._failure, self._ended, self._started = "", False, True
        self._plan_acts = (
            self._gravity_differs or self._mass_differs or self._world_pushes is not None
        )
        external, _ = self._apply_plan(scene, 0)
        self._observer.watch(scene.look(), self._loop)
        self._loop.rest(external, self._assumed_gravity(scene), self._targets[0])
        self._report_structure(scene, plan)
        terms = self.config.reward.terms(True, 0, NO_COSTS)
        self._observed = self._observe(scene)
        self._find_fault()
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info(scene, terms)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Run one agent step; see the class.

        Raises:
            InvalidInputError: the action has the wrong shape or is not finite.
            SimulationError: called before `reset`, after `close`, or after the end of the episode.
        """
        scene = self._stage_or_raise().scene
        if not self._started:
            raise SimulationError("step before reset: call reset() first")
        if self._ended:
            raise SimulationError(
                f"the episode ended ({self._failure or 'time is up'}): call reset()"
            )
        numbers = self._checked(action)
        try:
            self._simulate(scene, numbers)
            self._observed = self._observe(scene)
            self._failure = self._failure_cause()
        except SimulationError:
            self._failure = "simulation_diverged"
        except GraspError:
            self._failure = "force_optimisation"
        was_broken = self._broken
        self._find_fault()
        if self._broken and self.config.limits.end_at_fault:
            self._failure = self._fault
        loop = self._loop
        held = not self._fault
        iterations = loop.effort.iterations if loop.closure else math.inf
        costs = loop.costs() if held else NO_COSTS
        breaks = self._broken and not was_broken
        terms = self.config.reward.terms(held, iterations, costs, breaks)
        truncated = not self._failure and self._tick >= self.step_limit * self._ticks_per_step
        self._ended = bool(self._failure) or truncated
        info = self._info(scene, terms)
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(sum(terms.values())), bool(self._failure), truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return an (H, W, 3) picture in "rgb_array" mode; update the window in "human" mode.

        Without a `render_mode` it returns None with Gymnasium's warning.

        Raises:
            SimulationError: the environment is closed.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "You are calling render method without specifying any render mode. You can specify the render_mode at initialization, "
                f'e.g. gym.make("{self._spec.id if self._spec else ENV_ID}", render_mode="rgb_array")'
            )
            return None
        scene = self._stage_or_raise().scene
        annotation = self._annotation(scene)
        if self.render_mode == "human":
            if annotation is not None:
                painter = class_of(scene.config.engine, "painter")
                window: Painter = self._window or painter.of_scene(scene)
                window.show(annotation)
                self._window = window
            return None
        if self._camera is None:
            size = self.config.pictures.size
            margin, footer = room(*size)
            config = CameraConfig(*size, margin=margin, footer=footer, arrows=LONGEST)
            self._camera = Camera(scene, config)
        return self._camera.capture(annotation)

    @property
    def scene(self) -> Scene:
        """The simulation, for cameras and measurements."""
        return self._stage_or_raise().scene

    @property
    def grasp(self) -> HandGrasp:
        """How the hand holds the object: the palm's place, contacts and postures; it can be saved."""
        return self._stage_or_raise().grasp

    @property
    def solution(self) -> ForceSolution | None:
        """The method's last solution, of the fingers in contact; None without one."""
        return self._loop.solution

    @property
    def spec(self) -> EnvSpec | None:
        """The specification that `gym.make` used; `limits.duration` sets its `max_episode_steps`.

        `gym.make(EnvSpec.from_json(spec.to_json()))` makes the same environment again.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self._spec = None if spec is None else self._kept(spec)

    def _kept(self, spec: EnvSpec) -> GraspSpec:
        fitting = {item.name: getattr(spec, item.name) for item in fields(spec) if item.init}
        fitting["kwargs"], _ = keywords_to_json(spec.kwargs)
        return GraspSpec(**{**fitting, "max_episode_steps": self.step_limit})

    def truncate_after(self, steps: int) -> None:
        """Truncate episodes after `steps` agent steps, from the next reset on."""
        if steps == self.step_limit:
            return
        duration = whole(steps, "max_episode_steps", 1) / self.config.agent.rate
        stage = self._stage_or_raise()
        stage.config = stage.episode = self.config = self.config.override(duration=duration)
        self.step_limit = steps
        if self._spec is not None:
            kwargs = {**self._spec.kwargs, "duration": duration}
            self._spec = self._kept(replace(self._spec, kwargs=kwargs))

    def close(self) -> None:
        """Free the simulator; a second call does nothing, and `reset` opens it again."""
        if self._stage is not None:
            self._stage.scene.close()
            self._stage = self._camera = self._window = None

    def _simulate(self, scene: Scene, numbers: list[float]) -> None:
        loop = self._loop
        loop.begin_step()
        asked = NOTHING
        if any(numbers) or self._mode.asks_with_zeros:
            asked = self._mode.request(np.array(numbers), self.episode)
        assumed_gravity = self._assumed_gravity(scene)
        for k in range(self._ticks_per_step):
            tick = min(self._tick, self._last_row)
            external, push = self._wrenches[tick], self._pushes[tick]
            if self._plan_acts:
                external, push = self._apply_plan(scene, tick)
                assumed_gravity = self._assumed_gravity(scene)
            torques = loop.tick(external, assumed_gravity, self._targets[tick], k == 0, asked)
            scene.advance(torques if self._motors.ideal else self._motors(torques), push)
            self._tick += 1
            self._time_without_closure += loop.dt
            if loop.closure:
                self._time_without_closure = 0.0

    def _apply_plan(self, scene: Scene, tick: int) -> tuple[Array, list[float] | None]:
        """Apply the plan of a tick; return its wrench, object frame, and again for the simulator."""
        plan = self._plan
        if self._gravity_differs:
            scene.set_gravity(plan.gravity[tick])
        factor = plan.mass_factor
        if self._mass_differs and (tick == 0 or factor[tick] != factor[tick - 1]):
            scene.change_object(self._mass * float(factor[tick]))
        external = self._wrenches[tick]
        push = self._pushes[tick]
        if self._world_pushes is not None:
            external = external.copy()
            external[:3] += scene.look().rotation.T @ self._world_pushes[tick]
            push = external.tolist()
        return external, push

    def _assumed_gravity(self, scene: Scene) -> Array:
        """Return the gravity (3,) that the controller assumes: true if wrenches are measured."""
        return scene.gravity if self._measured_wrench else self._nominal_gravity

    def _failure_cause(self) -> str:
        outcome = self._outcome
        if outcome.drift > self._max_drift or outcome.tilt > self._max_tilt:
            return "dropped"
        gap = self.config.limits.max_contact_gap
        return "closure_lost" if self._time_without_closure > gap else ""

    def _find_fault(self) -> None:
        """Set why the object does not count as held, "" if it does, and whether this lasts."""
        self._fault = self._failure or lasting_fault(self._outcome, self.config)
        self._broken = bool(self._fault)
        if not self._broken:
            self._fault = passing_fault(self._outcome, self.config)

    def _checked(self, action: NDArray[np.float32]) -> list[float]:
        values = action
        plain = type(action) is np.ndarray and action.dtype.kind == "f"
        fault = ""
        if not (plain and action.itemsize <= 8):
            try:
                with np.errstate(all="ignore"):  # too large for a double
                    values = (
                        np.asarray(action, np.float64)
                        if plain
                        else as_array(action, None, "it", finite=False)
                    )
            except InvalidInputError as error:  # not numbers
                values = np.empty(0)
                fault = f" ({error})"
        # plain Python: faster than numpy for six numbers
        numbers = values.tolist() if values.shape == self._action_shape else ()
        if not numbers or not all(map(math.isfinite, numbers)):
            raise InvalidInputError(
                f"action must be of shape {self._action_shape}, finite numbers in [-1, 1], got {shown(action)}{fault}"
            )
        if min(numbers) >= -1.0 and max(numbers) <= 1.0:
            return numbers
        return [min(max(number, -1.0), 1.0) for number in numbers]

    def _observe(self, scene: Scene) -> NDArray[np.float32]:
        scene.look()
        observed, self._outcome = self._observer(self._targets[min(self._tick, self._last_row)])
        return observed

    def _observation(self) -> Any:
        return self._observer.named(self._observed) if self._as_dict else self._observed

    def _info(self, scene: Scene, terms: dict[str, float]) -> dict[str, Any]:
        outcome, failure = self._outcome, self._failure
        step_info = self._loop.step_info(outcome, self._observer.measured)
        if failure == "simulation_diverged":  # the last reading, without forces
            step_info |= {
                name: np.zeros_like(step_info[name]) for name in ("measured_force", "touching")
            }
            step_info |= dict.fromkeys(("force_error", "stray_force", "slip"), 0.0)
        info = {
            "status": self._loop.status or ("failed" if failure else "none"),
            **step_info,
            "time": self._tick * self._loop.dt,
            "object_mass": scene.config.object.mass,
            **self._object_info,
            "structure_share": self._share.copy(),
            "failure": failure,
            "fault": self._fault,
            "is_success": not self._fault,
            **terms,
        }
        if self.config.agent.info == "all":
            return info
        return {
            name: np.asarray(value) for name, value in info.items() if not isinstance(value, str)
        }

    def _annotation(self, scene: Scene) -> Annotation | None:
        """Return the annotation of a picture, or None before a reset and after a divergence."""
        if not self._started or self._failure == "simulation_diverged":
            return None
        return self._annotator(
            self._loop, scene, self._tick * self._loop.dt, self._outcome, self._failure
        )

    def _report_structure(self, scene: Scene, plan: Plan) -> None:
        """Compute `structure_share`; warn once about large ones."""
        snapshot = scene.look()
        gravity = plan.gravity[:: self._ticks_per_step]
        loads = plan.wrench[:: self._ticks_per_step].copy()
        loads[:, :3] += self._mass * gravity @ snapshot.rotation
        grasp = self._loop.grasp(snapshot.points, snapshot.normals)
        grasp = self._loop.margin.narrowed(grasp)
        structure = finger_structure(snapshot, scene.kinematics, grasp, loads)
        self._share = structure.share
        if not self._warned and (message := structure.warning(scene.config.hand.finger_names)):
            self._warned = True
            warn(message)

    def _stage_or_raise(self) -> Stage:
        if self._stage is None:
            raise SimulationError("the environment is closed: call reset() to open it anew")
        return self._stage

    def _new_stage(self) -> Stage:
        visible = self.render_mode == "human", self.render_mode is not None
        return Stage(self.config, self._loop, *visible)


def why_idle(config: EnvConfig) -> str:
    """Return why actions change nothing; "" if they do, or are off on purpose."""
    mode = config.action_mode
    if config.agent.sets_forces or mode == "none":
        return ""
    if config.controller.kind != "optimized":
        return f"controller.kind={config.controller.kind!r} does not optimise"
    if mode != "initial_force":
        return ""
    if config.solver.method == "conic":
        return "method='conic' has no start"
    if config.object.torsional_friction > 0.0:
        return (
            "on soft contacts Newton optimises, whose iteration count hardly depends on the start"
        )
    if config.solver.method == "newton":
        return "the iteration count of method='newton' hardly depends on the start"
    return ""


def finish(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Complete an environment with Gymnasium's wrappers: `gym.make` calls this last.

    Its `max_episode_steps` becomes the duration. Warn if actions change nothing.
    """
    inner, layer = env.unwrapped, env
    if not isinstance(inner, FourFingerGrasp):
        return env
    if reason := why_idle(inner.config):
        warn(
            f"an agent's actions change nothing: {reason}. Leave the method at 'reduced_flow' for an agent that adjusts its start, "
            "give it the forces with action_mode='contact_force', or say action_mode='none'"
        )
    _, registered = IDS.get(inner.spec.id if inner.spec else "", ("", None))
    while isinstance(layer, gym.Wrapper):
        if isinstance(layer, gym.wrappers.TimeLimit):
            # `layer.spec` has it, too, but keeps the old settings
            if layer._max_episode_steps == registered:  # a given `duration` counts for more
                layer._max_episode_steps = inner.step_limit
            else:
                inner.truncate_after(layer._max_episode_steps)
        layer = layer.env
    if inner.spec is not None:  # `gym.make` of this specification completes the environment, too
        inner.spec = replace(inner.spec, additional_wrappers=(FINISH,))
    return env
