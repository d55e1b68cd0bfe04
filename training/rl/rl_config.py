"""Settings of `grasp rl`, which are also its options; this module imports no torch."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import choice, instance, number, whole
from training.data.environment import environment
from training.evaluation.results.run import check_counts

if TYPE_CHECKING:
    from grasp_env.config import EnvConfig


@dataclass(frozen=True)
class Usual:
    """Usual settings of a training in an action mode.

    Attributes:
        gamma: discount.
        deviation: initial standard deviation of the exploration.
        rates: learning rates of Adam by algorithm.
        settings: settings of the environment.
    """

    gamma: float
    deviation: float
    rates: dict[str, float]
    settings: dict[str, Any] = field(default_factory=dict)


ACTIONS: dict[str, Usual] = {
    # an action affects only the iterations of its own step
    "initial_force": Usual(0.0, 0.1, {"ppo": 1e-3, "sac": 5e-4}),
    "residual": Usual(0.95, 0.1, {"ppo": 3e-4, "sac": 5e-4}),
    # a fingertip slides slowly: its fault comes long after the grip that caused it
    "grip": Usual(0.97, 0.3, {"ppo": 3e-4, "sac": 5e-4}),
    # an episode ends at the first fault, which costs all later rewards; a further cost hides how
    # long the object was held before it
    "contact_force": Usual(0.95, 0.1, {"ppo": 1e-3, "sac": 5e-4}, {"reward.fault_cost": 0.0}),
}
"""Action modes of agents, and their usual settings."""
_BY_OPTION = {"action_mode": "action"}
"""Settings of the environment that options set."""
HELD_OUT_SEED = 1_000_000
"""First seed of the episodes that score agents; the seeds of training are at least 2**30."""
CURVE_SEED = 2_000_000
"""First seed of the episodes along a learning curve."""


@dataclass(frozen=True)
class RLConfig:
    """Settings of a training.

    Attributes:
        algorithm: ppo or sac of stable-baselines3.
        env: an environment by name, UncertainGrasp or FragileGrasp, or JSON of settings, as
            keywords of `gym.make`: {"hand": "allegro", "shape": "sphere", "size": [0.06]}. The
            default is the cuboid under a random wrench, with the paper's start and flow.
        action: empty: that of the environment. Else initial_force (adjusts the solver's start; zero
            is the paper's), residual (changes the solver's forces), grip (sets its margin) or
            contact_force (no solver).
        steps: environment steps per seed, rounded up to whole updates.
        seed: seed of everything random in training.
        seeds: several seeds, with one sub-folder each; empty: `seed` alone.
        envs: number of environments in parallel, in one process.
        episodes: number of held-out episodes that score the agents.
        curve_points: scores along the learning curve, besides the one before training.
        curve_episodes: episodes of each such score.
        checkpoint_every: steps between checkpoints; interrupts and the end save one, too.
        rollout: ppo: steps between updates.
        warmup: sac: steps with random actions before the first update.
        buffer: sac: transitions in the replay buffer.
        learning_rate: learning rate of Adam, for ppo falling linearly to a tenth; 0: 5e-4 for sac,
            for ppo 3e-4 for grip and residual, 1e-3 for the others.
        gamma: discount; negative: 0 for initial_force, where an action affects only the iterations
            of its own step, 0.97 for grip, 0.95 for the others.
        deviation: initial standard deviation of the exploration, for actions in [-1, 1]; 0: 0.3 for
            grip, 0.1 (0.5 N) for the others.
        quick: a small version that ends within a minute; its report is marked as quick.
    """

    algorithm: Literal["ppo", "sac"] = "ppo"
    action: Literal["", "initial_force", "residual", "grip", "contact_force"] = ""
    env: str = "{}"
    steps: int = 150_000
    seed: int = 0
    seeds: tuple[int, ...] = ()
    envs: int = 8
    episodes: int = 50
    curve_points: int = 20
    curve_episodes: int = 5
    checkpoint_every: int = 20_000
    rollout: int = 2048
    warmup: int = 1000
    buffer: int = 100_000
    learning_rate: float = 0.0
    gamma: float = -1.0
    deviation: float = 0.0
    quick: bool = False

    def __post_init__(self) -> None:
        counts = {field.name: 1 for field in fields(RLConfig) if field.type == "int"}
        check_counts(self, counts | {"warmup": 0, "seed": 0})
        choice(self.algorithm, "algorithm", ("ppo", "sac"))
        choice(self.action, "action", ("", *ACTIONS))
        for seed in instance(self.seeds, tuple, "seeds"):
            whole(seed, "seeds", 0)
        for name in ("learning_rate", "gamma", "deviation"):
            number(getattr(self, name), name)
        if len(set(self.seeds)) != len(self.seeds):
            raise InvalidInputError(f"seeds must be different integers >= 0, got {self.seeds}")
        in_range = 0.0 <= self.learning_rate < 1.0 and 0.0 <= self.deviation <= 1.0
        if not in_range or not self.gamma < 1.0:
            raise InvalidInputError(
                "learning_rate must be in [0, 1), gamma below 1, deviation in [0, 1], "
                f"got {self.learning_rate}, {self.gamma}, {self.deviation}"
            )

    def resolved(self) -> RLConfig:
        """Return the settings with every default filled in, and smaller counts if `quick`."""
        action = self.action or self._environment().action_mode
        usual = ACTIONS[action]
        full = replace(
            self,
            action=action,
            seeds=tuple(self.seeds) or (self.seed,),
            learning_rate=self.learning_rate or usual.rates[self.algorithm],
            gamma=self.gamma if self.gamma >= 0.0 else usual.gamma,
            deviation=self.deviation or usual.deviation,
        )
        if not self.quick:
            return full
        return replace(
            full,
            steps=min(full.steps, {"ppo": 8_192, "sac": 3_000}[self.algorithm]),
            seeds=full.seeds[:1],
            episodes=min(full.episodes, 4),
            curve_points=3,
            curve_episodes=2,
        )

    @property
    def env_settings(self) -> dict[str, Any]:
        """Settings of the environment, as from `EnvConfig.to_dict`.

        Raises:
            UnknownNameError: `env` is no environment's name.
            InvalidInputError: it is not JSON either, or holds invalid settings.
        """
        return self._environment().to_dict()

    def _environment(self) -> EnvConfig:
        if not self.action:  # that of the environment
            return environment(self.env, elsewhere=_BY_OPTION)
        config = environment(self.env, ACTIONS[self.action].settings, _BY_OPTION)
        return config.override(action_mode=self.action)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of fingers and joints of the hand, and sizes of observation and action."""
        from grasp_env.config.env import as_config
        from grasp_env.env.actions import MODES
        from grasp_env.env.observation import bounds

        config = as_config(self.env_settings)
        mode = config.action_mode
        fingers = config.hand_description.finger_count
        joints = config.hand_description.joint_count
        return {
            "fingers": fingers,
            "joints": joints,
            "observation_size": len(bounds(fingers, joints, mode)),
            "action_size": MODES[mode].size(fingers),
        }
