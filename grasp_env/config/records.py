"""The small records of `EnvConfig`, such as sensors, solver, controller and reward."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from grasp_env.errors import InvalidInputError
from grasp_env.force.initial import InitialForceRule
from grasp_env.force.objective import Objective
from grasp_env.force.options import METHODS
from grasp_env.force.rules import RULES
from grasp_env.force.saved import is_saved
from grasp_env.inputs import ranges
from grasp_env.inputs.ranges import FRICTION_MARGIN, LEAST_NORMAL_FORCE, Range
from grasp_env.settings import (
    NOT_NEGATIVE,
    POSITIVE,
    Kind,
    Settings,
    integer,
    numbers,
    one_of,
    real,
    setting,
    truth,
)

CONTROLLERS = ("optimized", "constant_squeeze", "pd")
ACTION_MODES = ("initial_force", "residual", "grip", "contact_force", "none")
COSTS = ("iterations", "force", "torque", "force_change")
"""Costs of a step in the reward, and their weights in `RewardSettings`."""
MAX_COST = 0.9
"""Largest share of the reward for holding that the costs of a step may take."""
WEIGHT = Range(0.0, MAX_COST)
ROUNDING = 1e-12
"""Rounding of the sum of the weights."""
_RULES = one_of(
    (*RULES, "previous"),
    "the path of a model that `grasp fit` saved, or a rule(grasp, wrench) -> (N, 3) forces [N]",
    callable,
)


def _start(value: Any, name: str) -> Any:
    path = os.fspath(value) if isinstance(value, os.PathLike) else value
    if isinstance(path, str) and (path is not value or is_saved(path)):
        return path
    return _RULES.take(value, name)


START = Kind(_start, _RULES.text)
"""Kind of a setting that holds a start rule."""
_PIXELS = numbers(2, Range(16, 8192))


@dataclass(frozen=True)
class SensorSettings(Settings):
    """Measurements of the controller, their delay and their noise.

    Example:
        >>> SensorSettings(wrench="estimated", delay=0.01).delay
        0.01
    """

    wrench: str = setting(
        "measured",
        one_of(("measured", "estimated", "none")),
        "Source of the external wrench: measured, estimated from the object's motion and the mean contact forces of a tick, or none, "
        "with pose feedback alone. The hand always knows gravity for its own weight.",
    )
    wrench_delay: int = setting(0, integer(0), "Delay of the measured wrench in control ticks.")
    estimator_time: float = setting(
        0.005,
        real(POSITIVE),
        "Time constant of the estimate, against tactile noise; its lag lets light objects drift.",
        unit="s",
    )
    delay: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Delay of the measured object and contacts, rounded up to control ticks.",
        unit="s",
        random=True,
    )
    joint_delay: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "The same of the joints, which encoders measure sooner than vision and touch.",
        unit="s",
        random=True,
    )
    tactile_noise: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Relative standard deviation of each measured contact force's components.",
        random=True,
    )
    pose_noise: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Standard deviation of the measured object position, per axis.",
        unit="m",
        random=True,
    )


@dataclass(frozen=True)
class SolverSettings(Settings):
    """Force optimisation of an agent's step; see `grasp_env.force.optimize_force`.

    Example:
        >>> SolverSettings(method="newton", initial_force="previous").method
        'newton'
    """

    method: str = setting("reduced_flow", one_of(METHODS), "Method of the optimisation.")
    initial_force: str | InitialForceRule = setting(
        "linear_combination",
        START,
        "Start rule: its name, a fitted model's path, or any function.",
    )
    force_weight: float = setting(
        1.0,
        real(ranges.FORCE_WEIGHT),
        "Weight of forces in Phi, and of normal forces under `conic`.",
    )
    barrier_weight: float = setting(
        Objective.barrier_weight,
        real(ranges.BARRIER_WEIGHT),
        "Weight of the barrier in Phi: a larger one keeps the forces further from slipping. `conic` has no barrier.",
        unit="N^2",
    )
    tolerance: float = setting(
        1e-4, real(ranges.TOLERANCE), "Relative certified gap at which the optimisation ends."
    )
    max_iterations: int = setting(
        5000, integer(0), "Largest number of iterations of one optimisation."
    )

    def agree(self) -> None:
        """Raise an error for a barrier of `conic`, which has none."""
        if self.method == "conic" and self.barrier_weight != Objective.barrier_weight:
            raise InvalidInputError(
                f"solver.method 'conic' has no barrier, got solver.barrier_weight={self.barrier_weight:g}: take solver.method='newton', "
                "or leave solver.barrier_weight out"
            )


@dataclass(frozen=True)
class ControllerSettings(Settings):
    """Controller: from contact forces to joint torques.

    Example:
        >>> ControllerSettings(kind="pd", pd_stiffness=500.0).pd_damping
        4.0
    """

    kind: str = setting(
        "optimized",
        one_of(CONTROLLERS),
        "Optimised forces; a constant internal force plus the least-norm balance; or springs that hold the tips in place.",
    )
    rate: int = setting(
        250, integer(1), "Control ticks per second; a multiple of `agent.rate`.", unit="Hz"
    )
    position_bandwidth: float = setting(
        30.0,
        real(POSITIVE),
        "Bandwidth of the feedback of the object's position, critically damped; limited to 0.3 / `sensors.delay`.",
        unit="rad/s",
    )
    rotation_bandwidth: float = setting(
        60.0, real(POSITIVE), "The same for its orientation.", unit="rad/s"
    )
    friction_margin: float = setting(
        0.85,
        real(FRICTION_MARGIN),
        "Share of the assumed friction that forces may use, so that errors of the friction cause no slip: `Margin.friction`. Contacts "
        "are planned for this share of the friction, and at most for 0.85 of it.",
    )
    preload: float = setting(
        0.0,
        real(LEAST_NORMAL_FORCE),
        "Normal force of each finger that does not count for friction, so that errors of the wrench cause no slip: `Margin.preload`.",
        unit="N",
    )
    grip_stiffness: float = setting(
        1500.0,
        real(NOT_NEGATIVE),
        "Stiffness of the spring from each touching fingertip to its place on the object's target pose; softer where `rate` and "
        "`sensors.joint_delay` demand.",
        unit="N/m",
    )
    grip_damping: float = setting(
        16.0, real(NOT_NEGATIVE), "Damping of these springs, likewise.", unit="N s/m"
    )
    grip_force: float = setting(
        10.0, real(NOT_NEGATIVE), "Largest force of each of these springs.", unit="N"
    )
    friction_error: float = setting(
        0.0,
        real(Range(-1.0 + 1e-9, 1e9)),
        "Relative error of the friction that the controller assumes in an episode; 0.25: a quarter too much.",
        random=True,
    )
    force_rate: float = setting(
        1000.0,
        real(POSITIVE),
        "Largest rate of change of the internal force; balance is restored at once.",
        unit="N/s",
    )
    torque_rate: float = setting(
        250.0,
        real(POSITIVE),
        "Largest rate of change of a torque, as a share of its limit per second.",
        unit="1/s",
    )
    squeeze: float = setting(
        40.0, real(POSITIVE), "Total normal force of controllers that do not optimise.", unit="N"
    )
    pd_stiffness: float = setting(
        800.0, real(POSITIVE), "Stiffness of each tip under `pd`.", unit="N/m"
    )
    pd_damping: float = setting(
        4.0, real(NOT_NEGATIVE), "Damping of each tip under `pd`.", unit="N s/m"
    )

    def ticks(self, time: float) -> int:
        """Return a time [s] in whole control ticks, rounded up."""
        return math.ceil(time * self.rate - 1e-9)


@dataclass(frozen=True)
class MotorSettings(Settings):
    """Motors of the hand, and errors that the controller does not know.

    A motor delivers `strength` * (1 + noise + drift + gain error) of the commanded torque, within
    its limit, and its joint has Coulomb friction. The draws of noise, drift and gain error differ
    from joint to joint. Errors begin with the episode, when the hand already holds the object. The
    inertia of rotors belongs to the hand: see `HandDescription.with_rotors`.

    Example:
        >>> MotorSettings(noise=0.05, friction=0.01).noise_time
        0.004
    """

    strength: float = setting(
        1.0, real(POSITIVE), "Delivered torque as a share of the commanded one.", random=True
    )
    noise: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Relative standard deviation of fast errors, drawn anew every `noise_time`.",
        random=True,
    )
    noise_time: float = setting(
        0.004,
        real(NOT_NEGATIVE),
        "Time between two draws, rounded up to control ticks; 0: at every tick.",
        unit="s",
    )
    drift: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Relative standard deviation of slow errors, an Ornstein-Uhlenbeck process.",
        random=True,
    )
    drift_time: float = setting(0.3, real(POSITIVE), "Its correlation time.", unit="s")
    gain_error: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Relative standard deviation of each motor's gain, constant in an episode.",
        random=True,
    )
    friction: float = setting(
        0.0,
        real(NOT_NEGATIVE),
        "Coulomb friction of each joint with a motor, in N for a sliding one.",
        unit="N m",
        random=True,
    )


@dataclass(frozen=True)
class AgentSettings(Settings):
    """Actions and observations of an agent.

    Example:
        >>> AgentSettings(action_mode="contact_force", action_scale=8.0).rate
        50
    """

    rate: int = setting(50, integer(1), "Agent steps per second.", unit="Hz")
    action_mode: str | None = setting(
        None,
        one_of(ACTION_MODES),
        "Action: an adjustment of the solver's start, a change of its forces, its margin, the contact forces without a solver, or "
        "ignored.",
        none="initial_force; grip for a hand of two fingers",
    )
    action_scale: float = setting(5.0, real(POSITIVE), "Force at action 1.", unit="N")
    observation: str = setting(
        "vector", one_of(("vector", "dict")), "One vector, or a dict of named parts."
    )
    info: str = setting(
        "all", one_of(("all", "numbers")), "Contents of info: all, or numbers only, as arrays."
    )

    @property
    def sets_forces(self) -> bool:
        """True if the agent sets the contact forces itself, without the solver."""
        return self.action_mode == "contact_force"


@dataclass(frozen=True)
class RewardSettings(Settings):
    """Reward of a step: `held` * (1 - c), with c the weighted sum of the costs, each from 0 to 1.

    A step without the object held pays nothing. The weights add up to at most `MAX_COST`, so a step
    with the object held always pays. A large weight of the force may still make a light grip that
    fails earn more than a tight one that holds; then raise `fault_cost`.

    Example:
        >>> RewardSettings(iterations=0.8)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: the weights of the reward's costs (iterations 0.8, force
            0.1, torque 0.1, ... at most 0.9 ...
    """

    held: float = setting(
        1.0, real(POSITIVE), "Reward of a step with the object held, before the costs."
    )
    iterations: float = setting(
        0.5,
        real(WEIGHT),
        "Weight of the method's iterations over `iteration_scale`; rewards starts near the optimum.",
    )
    force: float = setting(
        0.1,
        real(WEIGHT),
        "Weight of the share of the normal forces above the least that balances the wrench; rewards a light grip.",
    )
    torque: float = setting(
        0.1,
        real(WEIGHT),
        "Weight of the step's largest torque as a share of its limit; rewards distance from saturated motors.",
    )
    force_change: float = setting(
        0.1,
        real(WEIGHT),
        "Weight of the change of the commanded forces, as a share of those before and after; rewards calm fingers.",
    )
    iteration_scale: float = setting(
        200.0, real(POSITIVE), "Iterations that cost the whole weight; more cost the same."
    )
    fault_cost: float = setting(
        10.0,
        real(NOT_NEGATIVE),
        "Cost of the step of the first fault that lasts, such as the loss of the object.",
    )

    def agree(self) -> None:
        """Raise an error if the costs could exceed the reward for holding."""
        if not sum(weights := [getattr(self, name) for name in COSTS]) <= MAX_COST + ROUNDING:
            listed = ", ".join(
                f"{name} {weight:g}" for name, weight in zip(COSTS, weights, strict=True)
            )
            raise InvalidInputError(
                f"the weights of the reward's costs ({listed}) add up to {sum(weights):g}, allowed is at most {MAX_COST:g}, so that "
                "holding the object always pays: lower one of them"
            )

    def terms(
        self, held: bool, iterations: float, costs: Sequence[float], breaks: bool = False
    ) -> dict[str, float]:
        """Return the terms that add up to the reward of a step.

        Args:
            held: the object is held.
            iterations: of the method.
            costs: those of `COSTS` other than `iterations`, 0 to 1.
            breaks: the first fault that lasts has occurred.
        """
        used = min(1.0, iterations / self.iteration_scale)
        shares = (used, *costs) if held else (0.0,) * len(COSTS)
        paid = self.held if held else 0.0 - self.fault_cost * breaks
        charged = {
            f"reward/{name}": 0.0 - self.held * getattr(self, name) * share
            for name, share in zip(COSTS, shares, strict=True)
        }
        return {"reward/held": paid, **charged}


@dataclass(frozen=True)
class EpisodeLimits(Settings):
    """Limits that end an episode, and those that decide whether the object is held.

    The faults `max_slide`, `max_overlap`, `max_stray` and `max_force` last for the episode. The
    object may get back within `max_imbalance` and `max_speed`.

    Example:
        >>> EpisodeLimits(duration=1.0).max_contact_gap
        0.1
    """

    duration: float | None = setting(
        None, real(POSITIVE), "Time until truncation.", unit="s", none="the task's own"
    )
    max_drift: float | None = setting(
        None,
        real(POSITIVE),
        "Distance from the desired position at which the object counts as lost, usually 0.02 m.",
        unit="m",
        none="the task's own",
    )
    max_tilt: float | None = setting(
        None,
        real(POSITIVE),
        "Angle from the desired orientation at which the object counts as lost, usually 0.35 rad.",
        unit="rad",
        none="the task's own",
    )
    max_contact_gap: float = setting(
        0.1, real(POSITIVE), "Time without force closure before the grasp counts as lost.", unit="s"
    )
    max_slide: float = setting(
        3e-3, real(NOT_NEGATIVE), "Distance that a fingertip may have slid on the object.", unit="m"
    )
    max_overlap: float = setting(
        5e-4, real(NOT_NEGATIVE), "Largest penetration of a fingertip into the object.", unit="m"
    )
    max_stray: float = setting(
        0.1,
        real(NOT_NEGATIVE),
        "Largest force on the object by parts other than fingertips, as a share of the load: external force and weight, at least the weight.",
    )
    max_force: float | None = setting(
        None,
        real(POSITIVE),
        "Largest force of a fingertip on the object, which breaks beyond it.",
        unit="N",
        none="no limit",
    )
    max_imbalance: float = setting(
        0.5,
        real(NOT_NEGATIVE),
        "Largest share of the load that the measured contact forces may leave unbalanced, as a mean over an agent's step.",
    )
    max_speed: float = setting(
        0.2,
        real(NOT_NEGATIVE),
        "Largest speed of the object against its target motion, at the contacts.",
        unit="m/s",
    )
    end_at_fault: bool | None = setting(
        None,
        truth(),
        "End the episode at the first fault that lasts.",
        none="True if an agent sets the contact forces",
    )


@dataclass(frozen=True)
class PictureSettings(Settings):
    """Pictures that `render` draws.

    Example:
        >>> PictureSettings(size=(320, 240)).size
        (320, 240)
    """

    size: tuple[int, int] = setting(
        (480, 480),
        Kind(lambda value, name: tuple(map(int, _PIXELS.take(value, name))), _PIXELS.text),
        "Width and height.",
        unit="pixels",
    )
    force: float | None = setting(
        None,
        real(POSITIVE),
        "Largest force that a picture has room for; it sets the scale of the arrows.",
        unit="N",
        none="the largest of the plans of all episodes so far",
    )
    moment: float | None = setting(
        None, real(POSITIVE), "The same for moments.", unit="N m", none="as of `force`"
    )
