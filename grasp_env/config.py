"""Every setting of the environment, as one frozen record of numbers and names."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from grasp_env._check import as_array, positive
from grasp_env.errors import InvalidInputError, UnknownNameError
from grasp_env.force import METHODS

WRENCHES = ("none", "constant", "paper_path", "random")


@dataclass(frozen=True)
class EnvConfig:
    """Settings of `FourFingerGrasp-v0`; each is a keyword of `gym.make`.

    Attributes:
        wrench: the external wrench besides gravity: "none", "constant" (`wrench_value`), "paper_path" (the paper's
            W_ext(t)), "random" (an Ornstein-Uhlenbeck disturbance).
        wrench_value: [N, N m] of "constant"; the paper's by default.
        wrench_scale: factor on "constant" and "paper_path"; None: 1 for "constant", 0.1 for "paper_path". W_ext peaks
            at 1 N m about z, which takes 153 N of normal force and 9 N m at the joints; a tenth keeps them near 1 N m,
            what motors of a hand this size give (the simulated joints allow 12 N m).
        wrench_delay: control steps by which the controller is told the external wrench late.
        wrench_known: whether the controller is told the external wrench; if not, only the pose feedback sees it.
        random_force, random_moment: [N], [N m] standard deviation per axis of "random".
        random_time: [s] its correlation time.
        gravity: (3,) [m/s^2] in the world frame; y points up.
        object_mass: [kg].
        friction: coefficient of the simulated contacts.
        friction_margin: the solver's friction is `friction_margin * friction`, so that force errors do not slip.
        initial_force: name of the start rule ("linear_combination", "single_value", "lagrange", "previous", ...).
        method: of the force optimisation.
        force_weight, barrier_weight, tolerance, max_iterations: see `grasp_env.force.optimize_force`.
        action_scale: [N] of null-space coordinate at action 1.
        agent_rate, control_rate, physics_rate: [Hz]; each must divide the next.
        position_gain, rotation_gain: [N/m], [N m/rad] of the object-pose feedback, critically damped.
        iteration_cost: reward per iteration. force_cost: reward per newton of total normal force. held_reward: per
            step with the object held. failure_cost: once, when it is lost.
        max_drift: [m]. max_tilt: [rad]. Beyond either the object counts as lost.
        max_contact_gap: [s] a finger may be without contact before the grasp counts as lost.
    """

    wrench: str = "constant"
    wrench_value: tuple[float, ...] = (1.0, 0.5, -0.6, -0.1, 0.2, 0.0)
    wrench_scale: float | None = None
    wrench_delay: int = 0
    wrench_known: bool = True
    random_force: float = 0.6
    random_moment: float = 0.02
    random_time: float = 0.3
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    object_mass: float = 0.2
    friction: float = 0.4
    friction_margin: float = 0.85
    initial_force: str = "linear_combination"
    method: str = "reduced_flow"
    force_weight: float = 1.0
    barrier_weight: float = 0.01
    tolerance: float = 1e-4
    max_iterations: int = 5000
    action_scale: float = 5.0
    agent_rate: int = 50
    control_rate: int = 250
    physics_rate: int = 500
    position_gain: float = 200.0
    rotation_gain: float = 2.0
    iteration_cost: float = 0.01
    force_cost: float = 0.01
    held_reward: float = 1.0
    failure_cost: float = 100.0
    max_drift: float = 0.02
    max_tilt: float = 0.35
    max_contact_gap: float = 0.1

    def __post_init__(self) -> None:
        if self.wrench not in WRENCHES:
            raise UnknownNameError("wrench", self.wrench, WRENCHES)
        if self.method not in METHODS:
            raise UnknownNameError("method", self.method, METHODS)
        # tuples survive JSON and hashing; lists from a JSON file become tuples
        object.__setattr__(self, "wrench_value", tuple(as_array(self.wrench_value, (6,), "wrench_value").tolist()))
        object.__setattr__(self, "gravity", tuple(as_array(self.gravity, (3,), "gravity").tolist()))
        for name in (
            "object_mass", "friction", "friction_margin", "force_weight", "barrier_weight", "tolerance", "agent_rate",
            "random_time", "action_scale", "max_drift", "max_tilt", "max_contact_gap",
        ):  # fmt: skip
            positive(getattr(self, name), name)
        for item in fields(self):
            value = getattr(self, item.name)
            if item.type == "int" and (not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 0):
                raise InvalidInputError(f"{item.name} must be an integer >= 0, got {value!r}")
            if item.type == "float" and as_array(value, (), item.name) < 0.0:
                raise InvalidInputError(f"{item.name} must be >= 0, got {value!r}")
        for slow, fast in (("agent_rate", "control_rate"), ("control_rate", "physics_rate")):
            low, high = getattr(self, slow), getattr(self, fast)
            if high < low or high % low:
                raise InvalidInputError(f"{fast} must be a multiple of {slow}, got {high} and {low}")
        if self.wrench_scale is not None:
            as_array(self.wrench_scale, (), "wrench_scale")

    @property
    def scale(self) -> float:
        """The factor on the wrench in force."""
        if self.wrench_scale is not None:
            return self.wrench_scale
        return 0.1 if self.wrench == "paper_path" else 1.0

    def override(self, **settings: Any) -> EnvConfig:
        """A copy with some settings replaced.

        Raises:
            UnknownNameError: no setting of that name.
        """
        known = [item.name for item in fields(self)]
        for name in settings:
            if name not in known:
                raise UnknownNameError("setting", name, known)
        return replace(self, **settings)
