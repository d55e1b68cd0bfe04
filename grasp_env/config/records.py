"""The small records of `EnvConfig`: sensors, solver, controller, agent, reward, episode limits, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from grasp_env import ranges
from grasp_env.errors import InvalidInputError
from grasp_env.force import METHODS, RULES, InitialForceRule
from grasp_env.ranges import Range
from grasp_env.settings import NOT_NEGATIVE, POSITIVE, Kind, Settings, integer, numbers, one_of, real, setting

CONTROLLERS = ("optimized", "constant_squeeze", "pd")
ACTION_MODES = ("initial_force", "contact_force", "none")
COSTS = ("iterations", "force", "torque", "force_change")
"""Costs of a step in the reward; each name is a weight of `Reward` and, after "reward/", a term."""
MAX_COST = 0.9
"""Largest share of what a step pays for holding that its costs may take."""
WEIGHT = Range(0.0, MAX_COST)
ROUNDING = 1e-12
"""Rounding by which a sum of weights may exceed its limit."""
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
    """The reward of a step: `held` * (1 - c), with c the weighted sum of the costs, each from 0 to 1.

    The weights add up to at most `MAX_COST`, so that a step with the object held always pays more than 0: whatever the object, the
    hand, the method and the discount, holding on pays more than letting go.

    Example:
        >>> Reward(iterations=0.8, force=0.0, torque=0.0, force_change=0.0).failure_cost
        0.0
        >>> Reward(iterations=0.8)
        Traceback (most recent call last):
        grasp_env.errors.InvalidInputError: the weights of the reward's costs (iterations 0.8, force 0.1, torque 0.1, ... at most 0.9 ...
    """

    held: float = setting(1.0, real(POSITIVE), "Reward of a step with the object held, before the costs.")
    iterations: float = setting(
        0.5,
        real(WEIGHT),
        "Weight of the method's iterations as a share of `iteration_scale`; it buys starts near the optimum.",
    )
    force: float = setting(
        0.1, real(WEIGHT),
        "Weight of the share of the commanded normal forces above the least that balances the wrench; it buys a light grip.",
    )  # fmt: skip
    torque: float = setting(
        0.1, real(WEIGHT),
        "Weight of the step's largest torque as a share of its limit; it buys distance from saturated motors.",
    )  # fmt: skip
    force_change: float = setting(
        0.1, real(WEIGHT),
        "Weight of the change of the commanded forces in the step, as a share of the forces before and after; it buys calm fingers.",
    )  # fmt: skip
    iteration_scale: float = setting(
        200.0, real(POSITIVE), "Iterations that cost the whole weight, and beyond which more cost no more."
    )
    failure_cost: float = setting(0.0, real(NOT_NEGATIVE), "Cost of the step in which the object is lost.")

    def agree(self) -> None:
        """Holding always pays."""
        if not sum(weights := [getattr(self, name) for name in COSTS]) <= MAX_COST + ROUNDING:
            told = ", ".join(f"{name} {weight:g}" for name, weight in zip(COSTS, weights, strict=True))
            raise InvalidInputError(
                f"the weights of the reward's costs ({told}) add up to {sum(weights):g}, allowed is at most {MAX_COST:g}, so that "
                "holding the object always pays: lower one of them"
            )

    def terms(self, held: bool, iterations: float, costs: Sequence[float]) -> dict[str, float]:
        """The terms that add up to a step's reward.

        Args:
            held: whether the object is still held; a step that loses it pays -`failure_cost` and nothing else.
            iterations: of the method in this step.
            costs: the others of `COSTS`, in their order, from 0 to 1.
        """
        shares = (min(1.0, iterations / self.iteration_scale), *costs) if held else (0.0,) * len(COSTS)
        paid = self.held if held else 0.0 - self.failure_cost
        charged = {
            f"reward/{name}": 0.0 - self.held * getattr(self, name) * share
            for name, share in zip(COSTS, shares, strict=True)
        }
        return {"reward/held": paid, **charged}


@dataclass(frozen=True)
class EpisodeLimits(Settings):
    """When an episode ends, and what counts as held: an episode that breaks one of the last three goes on, but is no success.

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
    max_slide: float = setting(
        3e-3,
        real(NOT_NEGATIVE),
        "Way that a touching fingertip may have slid from where it was on the object.",
        unit="m",
    )
    max_overlap: float = setting(5e-4, real(NOT_NEGATIVE), "Depth that a fingertip may reach in the object.", unit="m")
    max_stray: float = setting(
        0.1, real(NOT_NEGATIVE),
        "Force on the object by parts that are no fingertips, as a share of the load: external force and weight, the weight at least.",
    )  # fmt: skip


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
