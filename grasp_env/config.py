"""Every setting of the environment, as one frozen record of numbers and names."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from grasp_env import ranges
from grasp_env._check import as_array, as_list, as_text, choice, is_a, positive, together, whole
from grasp_env._files import as_path
from grasp_env.errors import InvalidInputError, UnknownSettingError, shown
from grasp_env.force import METHODS, RULES
from grasp_env.sim.engine import Engine, engine_of
from grasp_env.sim.hand.description import HANDS, HandDescription
from grasp_env.sim.objects.description import SHAPES
from grasp_env.task.disturbance import DISTURBANCES, Disturbance
from grasp_env.task.motion import MOTION_SIZES, MOTIONS
from grasp_env.task.tasks import TASKS, Task

RANDOM = ("shape", "size", "mass", "friction")
CONTROLLERS = ("optimised", "constant_squeeze", "pd")
ACTION_MODES = ("initial_force", "contact_force", "none")
WRENCHES = ("measured", "estimated", "none")
_REAL = ranges.Range(-1e9, 1e9)
"""Of any number here; in the units of the settings nothing is larger."""
_REAL_POSITIVE = ranges.Range(1e-9, 1e9)
_MOST_TICKS = 1_000_000
"""Of an episode, which is planned as a whole: 0.7 kB each."""
_MOST_PIXELS = 8192
_POSITIVE = {
    "force_weight": ranges.FORCE_WEIGHT, "barrier_weight": ranges.BARRIER_WEIGHT, "tolerance": ranges.TOLERANCE,
    **dict.fromkeys((
        "object_mass", "friction", "friction_margin", "agent_rate", "random_time", "action_scale", "max_contact_gap", "impulse_time",
        "impulse_interval", "tilt_period", "motion_period", "payload_factor", "push_time", "estimator_time", "position_bandwidth",
        "rotation_bandwidth", "force_rate", "squeeze", "pd_stiffness", "duration", "motion_size", "max_drift", "max_tilt",
        "render_force", "render_moment",
    ), _REAL_POSITIVE),
}  # fmt: skip
_NAMES: dict[str, tuple[str, ...]] = {
    "shape": SHAPES, "task": tuple(TASKS), "motion": tuple(MOTIONS), "wrench": WRENCHES, "controller": CONTROLLERS,
    "initial_force": (*RULES, "previous"), "action_mode": ACTION_MODES, "method": METHODS, "disturbance": tuple(DISTURBANCES),
}  # fmt: skip
_HINTS = {
    "hand": ", or give a HandDescription, such as HandDescription.from_urdf('my_hand.urdf')",
    "disturbance": ", or give a function f(times, rng, settings) -> (T, 6) wrenches [N, N m]",
    "initial_force": "; a rule(grasp, wrench) of your own is handed to the environment: gym.make(..., initial_force=rule)",
}
_LENGTHS = {"disturbance_value": 6, "gravity": 3}
_SIGNED = ("friction_error", "disturbance_scale")
_RANGES = ("size_range", "mass_range", "friction_range")


@dataclass(frozen=True)
class EnvConfig:
    """Settings of `FourFingerGrasp-v0`; each is a keyword of `gym.make`.

    Attributes:
        hand: "four_finger", "three_finger", "five_finger", "four_finger_4dof", "allegro", "leap", or a `HandDescription`, such as
            `HandDescription.from_urdf(path)`. Those that are not `placed` are put around the object by `place_hand`.
        shape: "cuboid", "cylinder", "sphere", "capsule", or "mesh" (`mesh`).
        size: [m] of the object: cuboid (x, y, z); cylinder, capsule (diameter, height), upright; sphere (diameter,). Empty:
            0.1 m each way. Of a mesh: (scale,), 0.001 for a file in millimetres.
        mesh: path of a closed convex mesh (.obj, .stl, .ply, .off) for shape "mesh".
        object_mass: [kg]. friction: of the object; the contacts' is this times the hand's `tip_friction`, 1 in the built-in ones.
        torsional_friction: [m] of the object, times the hand's `tip_friction`: above 0 contacts are soft, and two fingers can
            hold. Forces on soft contacts are solved by Newton within all limits at every control tick, whatever the `method`.
        contact_points: (N, 3) places of the tips on the object's surface [m], object frame, in the hand's order; empty: chosen.
        randomise: what is drawn anew at each reset: any of "shape" (another shape has another size, too), "size", "mass",
            "friction".
        size_range, mass_range, friction_range: [m], [kg], [1] from which they are drawn, uniformly.
        task: "hold", "move", "payload" or "six_directions"; see `grasp_env.task`.
        duration: [s] until truncation; None: the task's own.
        disturbance: the external wrench besides gravity: "none", "constant" (`disturbance_value`), "paper_path" (the paper's
            W_ext(t)), "random" (Ornstein-Uhlenbeck), "impulses", "tilting_gravity", or any function f(times, rng, settings)
            -> (T, 6), see `grasp_env.task.Disturbance`; None: the task's own.
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
            mean contact forces of a tick), or "none" (pose feedback alone). The hand always knows gravity for its own weight.
        wrench_delay: control ticks by which the measured wrench comes late.
        estimator_time: [s] time constant of the estimate: against tactile noise; light objects drift by what it lags.
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
        engine: that simulates: "bullet", "mujoco" (the extra of that name), or its settings, `BulletEngine(...)`,
            `MujocoEngine(...)` of `grasp_env.sim`; None: PyBullet where it is installed, otherwise MuJoCo.
        agent_rate, control_rate, physics_rate: [Hz]; each must divide the next. None: the engine's own, 250 of Bullet, 1000 of MuJoCo.
        position_bandwidth, rotation_bandwidth: [rad/s] of the object-pose feedback, critically damped; at most 0.3 / `sensor_delay`.
        iteration_cost: reward per iteration. force_cost: reward per newton of total normal force. held_reward: per
            step with the object held. failure_cost: once, when it is lost.
        max_drift: [m]. max_tilt: [rad]. Beyond either, measured from where it should be, the object counts as lost; None: 0.02 m,
            0.35 rad, or the task's own.
        max_contact_gap: [s] without force closure before the grasp counts as lost.
        render_size: (width, height) of pictures [pixels].
        render_force, render_moment: [N], [N m] that pictures have room for: what fixes the scale of their arrows; None: the largest
            that an episode's plan asks for, of all episodes so far.

    Raises:
        UnknownNameError: a task, shape, ... of no such name; the message lists those that exist.
        InvalidInputError: values out of range; all faults are told at once.

    Example:
        >>> config = EnvConfig(task="move", motion="lift", friction=0.6)
        >>> config.override(friction=0.8).friction
        0.8
    """

    hand: Any = "four_finger"
    shape: str = "cuboid"
    size: tuple[float, ...] = ()
    mesh: str = ""
    object_mass: float = 0.2
    friction: float = 0.4
    torsional_friction: float = 0.0
    contact_points: tuple[tuple[float, float, float], ...] = ()
    randomise: tuple[str, ...] = ()
    size_range: tuple[float, float] = (0.07, 0.12)
    mass_range: tuple[float, float] = (0.05, 0.5)
    friction_range: tuple[float, float] = (0.3, 0.8)
    task: str = "hold"
    duration: float | None = None
    disturbance: str | Disturbance | None = None
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
    estimator_time: float = 0.005
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
    engine: Any | None = None
    agent_rate: int = 50
    control_rate: int = 250
    physics_rate: int | None = None
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
    render_force: float | None = None
    render_moment: float | None = None

    def __post_init__(self) -> None:
        # tuples survive JSON and hashing; lists from a JSON file become tuples
        checked = together(*(lambda item=item: self._checked(item.name, str(item.type)) for item in fields(self)))
        for item, value in zip(fields(self), checked, strict=True):
            object.__setattr__(self, item.name, value)
        if not self.friction_error > -1.0:
            raise InvalidInputError(f"friction_error must be above -1, got {self.friction_error}")
        for slow, fast in (("agent_rate", "control_rate"), ("control_rate", "physics_rate")):
            low, high = getattr(self, slow), getattr(self, fast) or engine_of(self.engine, quiet=True).rate
            if high < low or high % low:
                raise InvalidInputError(f"{fast} must be a multiple of {slow}, got {high} and {low}")
        for seconds in ("duration", "sensor_delay"):
            if (getattr(self, seconds) or 0.0) * self.control_rate > _MOST_TICKS:
                raise InvalidInputError(
                    f"{seconds} must be at most {_MOST_TICKS / self.control_rate:g} s, {_MOST_TICKS} control ticks, got "
                    f"{getattr(self, seconds)} s: make episodes shorter, or lower control_rate"
                )
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
                f"task 'six_directions' pushes by itself, got disturbance={shown(self.disturbance)}: leave it out, or use task 'hold'"
            )

    def _checked(self, name: str, kind: str) -> Any:
        """A setting as it is kept: what it must be follows from its name, or from its annotated type."""
        value: Any = getattr(self, name)
        if getattr(self, name) is None and "None" in kind:
            return None
        if name == "hand":
            return value if is_a(value, HandDescription) else choice(value, name, HANDS, _HINTS[name])
        if name == "engine":
            return value if is_a(value, Engine) else engine_of(value).name
        if name in _NAMES:
            if name == "disturbance" and as_text(value) is None and callable(value):
                return value
            return choice(value, name, _NAMES[name], _HINTS.get(name, ""))
        if name == "mesh":
            return "" if as_text(value) == "" else str(as_path(value, InvalidInputError, name))
        if name == "randomise":
            named = [value] if is_a(value, str) else as_list(value)
            if named is None:
                raise InvalidInputError(
                    f"randomise must be a list of some of {', '.join(RANDOM)}, () for nothing, got {shown(value)}"
                )
            return tuple(choice(each, name, RANDOM) for each in named)
        if name in _RANGES:
            low, high = as_array(value, (2,), name, _REAL).tolist()
            if not 0.0 < low <= high:
                raise InvalidInputError(f"{name} must be (low, high) with 0 < low <= high, got {(low, high)}")
            return low, high
        if name == "contact_points":
            points = as_array(value, None, name, _REAL)
            return tuple(map(tuple, as_array(points, (None, 3), name).tolist())) if points.size else ()
        if name == "render_size":
            width, height = as_array(value, (2,), name).tolist()
            if not (min(width, height) >= 16 and max(width, height) <= _MOST_PIXELS):
                raise InvalidInputError(
                    f"render_size must be (width, height) of at least 16 pixels, at most {_MOST_PIXELS}, got {shown(value)}"
                )
            return int(width), int(height)
        if kind.startswith("tuple"):
            row = np.atleast_1d(as_array(value, None, name, _REAL))
            return tuple(as_array(row, (_LENGTHS.get(name),), name).tolist())
        kind = kind.removesuffix(" | None")
        if kind == "int":
            return whole(value, name, 1 if name in _POSITIVE else 0, ranges.ITERATIONS)
        if name in _POSITIVE:
            return positive(value, name, _POSITIVE[name])
        least = -_REAL.high if name in _SIGNED else 0.0
        found = as_array(value, (), name).item()
        if not least <= found <= _REAL.high:
            raise InvalidInputError(
                f"{name} must be {'' if name in _SIGNED else '>= 0 and '}up to {_REAL.high:g}, got {shown(value)}"
            )
        return found

    def resolved(self) -> EnvConfig:
        """A copy in which what is None has its value: the task's own, or the default said above."""
        task = TASKS[self.task]
        engine = engine_of(self.engine)
        return self.override(
            engine=engine.name if self.engine is None else self.engine,
            physics_rate=self.physics_rate or engine.rate,
            duration=self._duration(task) if self.duration is None else self.duration,
            disturbance=task.disturbance if self.disturbance is None else self.disturbance,
            motion_size=MOTION_SIZES[self.motion] if self.motion_size is None else self.motion_size,
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
            UnknownSettingError: no setting of that name.
        """
        known = [item.name for item in fields(self) if item.init]
        for name in settings:
            if name not in known:
                raise UnknownSettingError(name, known)
        return replace(self, **settings)
