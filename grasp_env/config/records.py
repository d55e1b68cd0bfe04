"""The small records of `EnvConfig`: sensors, solver, controller, agent, reward, episode limits, pictures."""

from __future__ import annotations

from dataclasses import dataclass

from grasp_env import ranges
from grasp_env.force import METHODS, RULES, InitialForceRule
from grasp_env.ranges import Range
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Kind, Settings, integer, numbers, one_of, real, setting

CONTROLLERS = ("optimized", "constant_squeeze", "pd")
ACTION_MODES = ("initial_force", "contact_force", "none")
_PIXELS = numbers(2, Range(16, 8192))


@dataclass(frozen=True)
class Sensors(Settings):
    """What the controller knows, how late and how exactly.

    Example:
        >>> Sensors(wrench="estimated", delay=0.01).delay
        0.01
    """

    wrench: str = setting(
        "measured", one_of(("measured", "estimated", "none")),
        "What is known of the external wrench: measured, estimated from the object's motion and the mean contact forces of a tick, or "
        "nothing, which leaves pose feedback alone. The hand always knows gravity for its own weight.",
    )  # fmt: skip
    wrench_delay: int = setting(0, integer(0), "Control ticks by which the measured wrench comes late.")
    estimator_time: float = setting(
        0.005, real(POSITIVE), "Time constant of the estimate, against tactile noise; light objects drift by what it lags.",
        unit="s",
    )  # fmt: skip
    delay: float = setting(
        0.0, real(NOT_NEGATIVE), "Between measurement and torque, for everything; rounded up to control ticks.",
        unit="s", random=True,
    )  # fmt: skip
    tactile_noise: float = setting(
        0.0, real(NOT_NEGATIVE), "Relative standard deviation of each measured contact force's components.", random=True
    )
    pose_noise: float = setting(
        0.0, real(NOT_NEGATIVE), "Standard deviation of the measured object position, per axis.", unit="m", random=True
    )


@dataclass(frozen=True)
class Solver(Settings):
    """The force optimization of an agent's step; see `grasp_env.force.optimize_force`.

    Example:
        >>> Solver(method="newton", initial_force="previous").method
        'newton'
    """

    method: str = setting("reduced_flow", one_of(METHODS), "Method of the optimization.")
    initial_force: str | InitialForceRule = setting(
        "linear_combination", one_of((*RULES, "previous"), "a rule(grasp, wrench) -> (N, 3) forces [N]", callable),
        "Start rule: its name, or any function.",
    )  # fmt: skip
    force_weight: float = setting(1.0, real(ranges.FORCE_WEIGHT), "Weight of the forces in Phi.")
    barrier_weight: float = setting(
        0.01, real(ranges.BARRIER_WEIGHT), "Weight of the barrier in Phi: more of it holds further from slipping.", unit="N^2"
    )  # fmt: skip
    tolerance: float = setting(1e-4, real(ranges.TOLERANCE), "Relative gap to the certified bound.")
    max_iterations: int = setting(5000, integer(0), "Most iterations of one optimization: what real time allows.")


@dataclass(frozen=True)
class Controller(Settings):
    """From forces to joint torques.

    Example:
        >>> Controller(kind="pd", pd_stiffness=500.0).pd_damping
        4.0
    """

    kind: str = setting(
        "optimized", one_of(CONTROLLERS),
        "The paper's optimized forces; a fixed internal force and the least-norm balance; or tips held at their places by springs.",
    )  # fmt: skip
    rate: int = setting(250, integer(1), "Control ticks per second; a multiple of `agent.rate`.", unit="Hz")
    position_bandwidth: float = setting(
        30.0, real(POSITIVE), "Feedback of the object's position, critically damped; at most 0.3 / `sensors.delay` is used.",
        unit="rad/s",
    )  # fmt: skip
    rotation_bandwidth: float = setting(60.0, real(POSITIVE), "The same of its orientation.", unit="rad/s")
    friction_margin: float = setting(
        0.85, real(POSITIVE), "Factor on the believed friction that the solver may use, so that force errors do not slip."
    )  # fmt: skip
    friction_error: float = setting(
        0.0, real(Range(-1.0 + 1e-9, 1e9)), "Relative error of the friction that the controller believes in; 0.25 is a quarter too much.",
        random=True,
    )  # fmt: skip
    force_rate: float = setting(
        1000.0, real(POSITIVE), "By how much the internal force may change; balance is restored at once.", unit="N/s"
    )
    force_noise: float = setting(
        0.0, real(NOT_NEGATIVE), "Relative standard deviation of the torques that the motors deliver.", random=True
    )
    motor_strength: float = setting(
        1.0, real(POSITIVE), "Factor on the commanded torques as the motors deliver them.", random=True
    )
    squeeze: float = setting(
        40.0, real(POSITIVE), "Total normal force of the controllers that do not optimize.", unit="N"
    )
    pd_stiffness: float = setting(800.0, real(POSITIVE), "Stiffness of each tip under `pd`.", unit="N/m")
    pd_damping: float = setting(4.0, real(NOT_NEGATIVE), "Damping of each tip under `pd`.", unit="N s/m")


@dataclass(frozen=True)
class Agent(Settings):
    """How an agent acts and what it observes.

    Example:
        >>> Agent(action_mode="contact_force", action_scale=8.0).rate
        50
    """

    rate: int = setting(50, integer(1), "Agent steps per second.", unit="Hz")
    action_mode: str = setting(
        "initial_force", one_of(ACTION_MODES), "Adjusts the solver's start, gives the contact forces, or is ignored."
    )
    action_scale: float = setting(5.0, real(POSITIVE), "Force at action 1.", unit="N")
    observation: str = setting("vector", one_of(("vector", "dict")), "One vector, or a dict of named parts.")
    info: str = setting(
        "all",
        one_of(("all", "numbers")),
        "Everything, or numbers only, as arrays: for readers that make tensors of them.",
    )


@dataclass(frozen=True)
class Reward(Settings):
    """Prices of a step.

    Example:
        >>> Reward(failure_cost=10.0).held
        1.0
    """

    held: float = setting(1.0, real(NOT_NEGATIVE), "Per step with the object held.")
    iteration_cost: float = setting(0.01, real(NOT_NEGATIVE), "Per iteration of the optimization.")
    force_cost: float = setting(0.01, real(NOT_NEGATIVE), "Per newton of total normal force.", unit="1/N")
    failure_cost: float = setting(100.0, real(NOT_NEGATIVE), "Once, when the object is lost.")

    def terms(self, held: bool, iterations: int, total_normal_force: float) -> dict[str, float]:
        """The terms that add up to a step's reward. No second solve is made for them.

        Args:
            held: whether the object is still held.
            iterations: of the force optimization in this step.
            total_normal_force: [N] of the optimized force.
        """
        return {
            "reward/held": self.held if held else -self.failure_cost,
            "reward/iterations": -self.iteration_cost * iterations,
            "reward/force": -self.force_cost * total_normal_force,
        }


@dataclass(frozen=True)
class EpisodeLimits(Settings):
    """When an episode ends.

    Example:
        >>> EpisodeLimits(duration=1.0).max_contact_gap
        0.1
    """

    duration: float | None = setting(None, real(POSITIVE), "Time until truncation.", unit="s", none="the task's own")
    max_drift: float | None = setting(
        None, real(POSITIVE), "Distance from where it should be at which the object counts as lost, usually 0.02 m.", unit="m",
        none="the task's own",
    )  # fmt: skip
    max_tilt: float | None = setting(
        None, real(POSITIVE), "Rotation at which the object counts as lost, usually 0.35 rad.", unit="rad", none="the task's own"
    )  # fmt: skip
    max_contact_gap: float = setting(
        0.1, real(POSITIVE), "Time without force closure before the grasp counts as lost.", unit="s"
    )


@dataclass(frozen=True)
class Pictures(Settings):
    """What `render` draws.

    Example:
        >>> Pictures(size=(320, 240)).size
        (320, 240)
    """

    size: tuple[int, int] = setting(
        (480, 480),
        Kind(lambda value, name: tuple(map(int, _PIXELS.take(value, name))), _PIXELS.text),
        "Width and height.",
        unit="pixels",
    )
    force: float | None = setting(
        None, real(POSITIVE), "Force that pictures have room for, which fixes the scale of their arrows.", unit="N",
        none="the largest that an episode's plan asks for, of all episodes so far",
    )  # fmt: skip
    moment: float | None = setting(None, real(POSITIVE), "The same for moments.", unit="N m", none="as of `force`")
