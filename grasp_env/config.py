"""Every setting of the environment, as one frozen record of numbers and names."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from grasp_env._check import as_array, positive
from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import METHODS, RULES
from grasp_env.sim.hand import HANDS, HandDescription
from grasp_env.sim.objects import SHAPES
from grasp_env.task import DISTURBANCES, MOTIONS, TASKS, Task

RANDOM = ("shape", "size", "mass", "friction")
CONTROLLERS = ("optimised", "constant_squeeze", "pd")
ACTION_MODES = ("initial_force", "contact_force", "none")
WRENCHES = ("measured", "estimated", "none")
_POSITIVE = (
    "object_mass", "friction", "friction_margin", "force_weight", "barrier_weight", "tolerance", "agent_rate", "random_time",
    "action_scale", "max_contact_gap", "impulse_time", "impulse_interval", "tilt_period", "motion_period",
    "payload_factor", "push_time", "estimator_time", "position_bandwidth", "rotation_bandwidth", "force_rate", "squeeze",
    "pd_stiffness",
)  # fmt: skip
_SIGNED = ("friction_error", "disturbance_scale")
_RANGES = ("size_range", "mass_range", "friction_range")


@dataclass(frozen=True)
class EnvConfig:
    """Settings of `FourFingerGrasp-v0`; each is a keyword of `gym.make`.

    Attributes:
        hand: "four_finger", "three_finger", "five_finger", "four_finger_4dof", or a `HandDescription`.
        shape: "cuboid", "cylinder", "sphere", "capsule", or "mesh" (`mesh`).
        size: [m] of the object: cuboid (x, y, z); cylinder, capsule (diameter, height), upright; sphere (diameter,). Empty:
            0.1 m each way. Of a mesh: (scale,), 0.001 for a file in millimetres.
        mesh: path of a closed convex mesh (.obj, .stl, .ply, .off) for shape "mesh".
        object_mass: [kg]. friction: of the object; the contacts' is this times the hand's `tip_friction`, 1 in the built-in ones.
        contact_points: (N, 3) places of the tips on the object's surface [m], object frame, in the hand's order; empty: chosen.
        randomise: what is drawn anew at each reset: any of "shape" (another shape has another size, too), "size", "mass",
            "friction".
        size_range, mass_range, friction_range: [m], [kg], [1] from which they are drawn, uniformly.
        task: "hold", "move", "payload" or "six_directions"; see `grasp_env.task`.
        duration: [s] until truncation; None: the task's own.
        disturbance: the external wrench besides gravity: "none", "constant" (`disturbance_value`), "paper_path" (the paper's
            W_ext(t)), "random" (Ornstein-Uhlenbeck), "impulses", "tilting_gravity"; None: the task's own.
        disturbance_value: [N, N m] of "constant"; the paper's by default.
        disturbance_scale: factor on "constant" and "paper_path"; None: 1 for "constant", 0.1 for "paper_path". W_ext peaks
            at 1 N m about z, which takes 153 N of normal force and 9 N m at the joints; a tenth keeps them near 1 N m,
            what motors of a hand this size give (the simulated joints allow 12 N m).
        random_force, random_moment, random_time: [N], [N m] standard deviation per axis of "random", its correlation time [s].
        impulse_force, impulse_moment: [N], [N m] peak of "impulses", half sines of `impulse_time` [s] in random directions, on
            average every `impulse_interval` [s].
        tilt_angle, tilt_period: [rad], [s] of "tilting_gravity".
        motion: of task "move": "lift", "shake" or "rotate". motion_size: [m], for rotate [rad]; None: 0.015 m, 0.3 rad.
        motion_period: [s] of one motion.
        payload_factor: by which the mass grows in task "payload", at `payload_time` [s]; the controller is not told.
        push_per_mass, push_time: [N/kg], [s] of task "six_directions".
        wrench: what the controller knows of the external wrench: "measured", "estimated" (from the object's motion and the
            forces of the last physics step), or "none" (pose feedback alone). The hand always knows gravity for its own weight.
        wrench_delay: control ticks by which the measured wrench comes late.
        estimator_time: [s] time constant of the estimate.
        sensor_delay: [s] between measurement and torque, for everything; rounded up to control ticks.
        tactile_noise: relative standard deviation of each measured contact force's components.
        pose_noise: [m] standard deviation of the measured object position, per axis.
        force_noise: relative standard deviation of the torques that the motors give.
        friction_error: relative error of the friction that the controller believes in; 0.25 is a quarter too much.
        friction_margin: the solver's friction is `friction_margin` times the believed one, so that force errors do not slip.
        controller: "optimised" (the paper), "constant_squeeze" (a fixed internal force and the least-norm balance), "pd" (tips held
            at their places by springs).
        squeeze: [N] total normal force of the last two.
        pd_stiffness, pd_damping: [N/m], [N s/m] of each tip under "pd".
        initial_force: name of the start rule ("linear_combination", "single_value", "lagrange", "previous", ...).
        method: of the force optimisation.
        iteration_budget: most iterations per optimisation (what real time allows); None: `max_iterations`.
        force_weight, barrier_weight, tolerance, max_iterations: see `grasp_env.force.optimize_force`.
        force_rate: [N/s] by which the internal force may change; balance is restored at once.
        action_mode: "initial_force", "contact_force" or "none"; see the environment.
        action_scale: [N] at action 1.
        gravity: (3,) [m/s^2] in the world frame; y points up.
        agent_rate, control_rate, physics_rate: [Hz]; each must divide the next.
        position_bandwidth, rotation_bandwidth: [rad/s] of the object-pose feedback, critically damped; at most 0.3 / `sensor_delay`.
        iteration_cost: reward per iteration. force_cost: reward per newton of total normal force. held_reward: per
            step with the object held. failure_cost: once, when it is lost.
        max_drift: [m]. max_tilt: [rad]. Beyond either, measured from where it should be, the object counts as lost; None: 0.02 m,
            0.35 rad, or the task's own.
        max_contact_gap: [s] without force closure before the grasp counts as lost.
        render_size: (width, height) of pictures [pixels].
    """

    hand: Any = "four_finger"
    shape: str = "cuboid"
    size: tuple[float, ...] = ()
    mesh: str = ""
    object_mass: float = 0.2
    friction: float = 0.4
    contact_points: tuple[tuple[float, float, float], ...] = ()
    randomise: tuple[str, ...] = ()
    size_range: tuple[float, float] = (0.07, 0.12)
    mass_range: tuple[float, float] = (0.05, 0.5)
    friction_range: tuple[float, float] = (0.3, 0.8)
    task: str = "hold"
    duration: float | None = None
    disturbance: str | None = None
    disturbance_value: tuple[float, ...] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    disturbance_scale: float | None = None
    random_force: float = 0.6
    random_moment: float = 0.02
    random_time: float = 0.3
    impulse_force: float = 5.0
    impulse_moment: float = 0.1
    impulse_time: float = 0.05
    impulse_interval: float = 0.5
    tilt_angle: float = 0.7
    tilt_period: float = 2.0
    motion: str = "lift"
    motion_size: float | None = None
    motion_period: float = 1.0
    payload_factor: float = 2.0
    payload_time: float = 1.0
    push_per_mass: float = 10.0
    push_time: float = 2.0
    wrench: str = "measured"
    wrench_delay: int = 0
    estimator_time: float = 0.02
    sensor_delay: float = 0.0
    tactile_noise: float = 0.0
    pose_noise: float = 0.0
    force_noise: float = 0.0
    friction_error: float = 0.0
    friction_margin: float = 0.85
    controller: str = "optimised"
    squeeze: float = 40.0
    pd_stiffness: float = 800.0
    pd_damping: float = 4.0
    initial_force: str = "linear_combination"
    method: str = "reduced_flow"
    iteration_budget: int | None = None
    force_weight: float = 1.0
    barrier_weight: float = 0.01
    tolerance: float = 1e-4
    max_iterations: int = 5000
    force_rate: float = 1000.0
    action_mode: str = "initial_force"
    action_scale: float = 5.0
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    agent_rate: int = 50
    control_rate: int = 250
    physics_rate: int = 250
    position_bandwidth: float = 30.0
    rotation_bandwidth: float = 60.0
    iteration_cost: float = 0.01
    force_cost: float = 0.01
    held_reward: float = 1.0
    failure_cost: float = 100.0
    max_drift: float | None = None
    max_tilt: float | None = None
    max_contact_gap: float = 0.1
    render_size: tuple[int, int] = (480, 480)

    def __post_init__(self) -> None:
        if not isinstance(self.hand, HandDescription) and self.hand not in HANDS:
            raise UnknownNameError("hand", self.hand, HANDS, ", or give a HandDescription")
        names = {
            "shape": SHAPES, "task": tuple(TASKS), "motion": tuple(MOTIONS), "wrench": WRENCHES,
            "controller": CONTROLLERS, "initial_force": (*RULES, "previous"), "action_mode": ACTION_MODES, "method": METHODS,
        }  # fmt: skip
        for name, allowed in names.items():
            if getattr(self, name) not in allowed:
                raise UnknownNameError(name, getattr(self, name), allowed)
        if self.disturbance is not None and self.disturbance not in DISTURBANCES:
            raise UnknownNameError("disturbance", self.disturbance, DISTURBANCES)
        self._check_tuples()
        for name in _POSITIVE:
            positive(getattr(self, name), name)
        for item in fields(self):
            value: Any = getattr(self, item.name)
            if value is None and "None" in str(item.type):
                continue
            kind = str(item.type).removesuffix(" | None")
            if kind == "int" and (not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 0):
                raise InvalidInputError(f"{item.name} must be an integer >= 0, got {value!r}")
            least = -np.inf if item.name in _SIGNED else 0.0
            if kind == "float" and as_array(getattr(self, item.name), (), item.name) < least:
                raise InvalidInputError(f"{item.name} must be >= 0, got {value!r}")
        if not self.friction_error > -1.0:
            raise InvalidInputError(f"friction_error must be above -1, got {self.friction_error}")
        for slow, fast in (("agent_rate", "control_rate"), ("control_rate", "physics_rate")):
            low, high = getattr(self, slow), getattr(self, fast)
            if high < low or high % low:
                raise InvalidInputError(f"{fast} must be a multiple of {slow}, got {high} and {low}")
        for name in ("duration", "motion_size", "max_drift", "max_tilt"):
            if getattr(self, name) is not None:
                positive(getattr(self, name), name)
        if self.shape == "mesh" and not self.mesh:
            raise InvalidInputError("shape 'mesh' needs mesh='path of an .obj, .stl, .ply or .off file'")
        if self.shape == "mesh" and {"shape", "size"} & set(self.randomise):
            raise InvalidInputError(
                "a mesh keeps its shape and size: randomise=('mass', 'friction'), or leave shape='mesh' out"
            )
        if self.contact_points and {"shape", "size"} & set(self.randomise):
            raise InvalidInputError(
                "contact_points belong to one shape and size: leave them out where these are randomised"
            )
        if self.task == "six_directions" and self.disturbance not in (None, "none"):
            raise InvalidInputError(
                f"task 'six_directions' pushes by itself, got disturbance={self.disturbance!r}: leave it out, or use task 'hold'"
            )

    def _check_tuples(self) -> None:
        # tuples survive JSON and hashing; lists from a JSON file become tuples
        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("disturbance_value", tuple(as_array(self.disturbance_value, (6,), "disturbance_value").tolist()))
        keep("gravity", tuple(as_array(self.gravity, (3,), "gravity").tolist()))
        keep("size", tuple(as_array(np.atleast_1d(self.size), (None,), "size").tolist()))
        points = (
            as_array(self.contact_points, (None, 3), "contact_points") if len(self.contact_points) else np.empty((0, 3))
        )
        keep("contact_points", tuple(tuple(row) for row in points.tolist()))
        for name in _RANGES:
            low, high = as_array(getattr(self, name), (2,), name).tolist()
            if not 0.0 < low <= high:
                raise InvalidInputError(f"{name} must be (low, high) with 0 < low <= high, got {(low, high)}")
            keep(name, (low, high))
        width, height = (int(number) for number in as_array(self.render_size, (2,), "render_size").tolist())
        if min(width, height) < 16:
            raise InvalidInputError(
                f"render_size must be (width, height) of at least 16 pixels, got {self.render_size}"
            )
        keep("render_size", (width, height))
        if isinstance(self.randomise, str):
            keep("randomise", (self.randomise,))
        keep("randomise", tuple(self.randomise))
        for name in self.randomise:
            if name not in RANDOM:
                raise UnknownNameError("randomise", name, RANDOM)

    @property
    def scale(self) -> float:
        """The factor on the disturbance in force."""
        if self.disturbance_scale is not None:
            return self.disturbance_scale
        return 0.1 if self.disturbance == "paper_path" else 1.0

    def resolved(self) -> EnvConfig:
        """A copy in which what is None has its value: the task's own, or the default said above."""
        task = TASKS[self.task]
        return self.override(
            duration=self._duration(task) if self.duration is None else self.duration,
            disturbance=task.disturbance if self.disturbance is None else self.disturbance,
            motion_size=(0.3 if self.motion == "rotate" else 0.015) if self.motion_size is None else self.motion_size,
            max_drift=(task.drift_limit if task.drift_limit < 1.0 else 0.02)
            if self.max_drift is None
            else self.max_drift,
            max_tilt=(task.tilt_limit if task.tilt_limit < 4.0 else 0.35) if self.max_tilt is None else self.max_tilt,
        )

    def _duration(self, task: Task) -> float:
        return 6.0 * self.push_time if self.task == "six_directions" else task.duration

    def override(self, **settings: Any) -> EnvConfig:
        """A copy with some settings replaced.

        Raises:
            UnknownNameError: no setting of that name.
        """
        known = [item.name for item in fields(self) if item.init]
        for name in settings:
            if name not in known:
                raise UnknownNameError("setting", name, known)
        return replace(self, **settings)
