"""Settings of `grasp rl`: light to import, also the command line's options."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from grasp_env._check import choice, instance, number, whole
from grasp_env.errors import InvalidInputError
from training.results.run import check_counts

HELD_OUT_SEED = 1_000_000
"""First seed of the episodes that score agents; training draws its seeds from 2**30 on."""
CURVE_SEED = 2_000_000
"""First seed of the episodes along a learning curve."""


@dataclass(frozen=True)
class RLConfig:
    """How an agent is trained.

    Attributes:
        algorithm: ppo or sac, stable-baselines3's.
        env: JSON of the environment's settings, as keywords of `gym.make`: {"hand": "allegro", "shape": "sphere", "size": [0.06]}.
            Unless it says otherwise, the default cuboid under a random wrench, with the paper's start and flow.
        action: initial_force (adjusts the solver's start; zero is the paper) or contact_force (no solver).
        steps: environment steps per seed, rounded up to whole updates.
        seed: of everything random in training.
        seeds: several, one sub-folder each; empty: `seed` alone.
        envs: environments side by side, in one process (a process each was no faster on two cores).
        episodes: held-out ones that score the agents, the same for all.
        curve_points: scores along the learning curve, besides the one before training.
        curve_episodes: of each.
        checkpoint_every: steps between checkpoints; interrupts and the end save one, too.
        rollout: steps between the updates of ppo.
        warmup: steps of sac with actions at random, before its first update.
        buffer: transitions that sac keeps.
        learning_rate: of Adam; 0: 1e-3 for ppo, 5e-4 for sac.
        gamma: discount; negative: 0 for initial_force, where an action changes the iterations of its own step only, 0.97 for
            contact_force.
        deviation: of the first exploration, in actions of [-1, 1]; 0: 0.1 (0.5 N) for initial_force, 0.3 for contact_force.
        quick: a small version that ends in a minute and says that it is quick.
    """

    algorithm: Literal["ppo", "sac"] = "ppo"
    action: Literal["initial_force", "contact_force"] = "initial_force"
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
        choice(self.action, "action", ("initial_force", "contact_force"))
        for seed in instance(self.seeds, tuple, "seeds"):
            whole(seed, "seeds", 0)
        for name in ("learning_rate", "gamma", "deviation"):
            number(getattr(self, name), name)
        if min(self.seed, *self.seeds, 0) < 0 or len(set(self.seeds)) != len(self.seeds):
            raise InvalidInputError(f"seeds must be different integers >= 0, got {self.seeds or self.seed}")
        if not 0.0 <= self.learning_rate < 1.0 or not self.gamma < 1.0 or not 0.0 <= self.deviation <= 1.0:
            raise InvalidInputError(
                "learning_rate must be in [0, 1), gamma below 1, deviation in [0, 1], "
                f"got {self.learning_rate}, {self.gamma}, {self.deviation}"
            )

    def resolved(self) -> RLConfig:
        """The settings in force: what was left open has its value; `quick` shrinks everything but the protocol."""
        force = self.action == "initial_force"
        full = replace(
            self,
            seeds=tuple(self.seeds) or (self.seed,),
            learning_rate=self.learning_rate or {"ppo": 1e-3, "sac": 5e-4}[self.algorithm],
            gamma=self.gamma if self.gamma >= 0.0 else (0.0 if force else 0.97),
            deviation=self.deviation or (0.1 if force else 0.3),
        )
        if not self.quick:
            return full
        steps = {"ppo": 8_192, "sac": 3_000}[self.algorithm]
        return replace(
            full, steps=min(full.steps, steps), seeds=full.seeds[:1], episodes=min(full.episodes, 4), curve_points=3,
            curve_episodes=2,
        )  # fmt: skip

    @property
    def env_settings(self) -> dict[str, Any]:
        """The environment's settings, as `EnvConfig.to_dict`.

        Raises:
            InvalidInputError: `env` is no JSON of settings, or these make no environment.
        """
        from grasp_env.config import EnvConfig  # it needs the extra sim

        try:
            given = json.loads(self.env)
        except ValueError as error:
            raise InvalidInputError(f'env is not JSON ({error}); give settings as {{"shape": "sphere"}}') from None
        if "action_mode" in instance(given, dict, "env"):
            raise InvalidInputError(
                f"env has action_mode {given['action_mode']!r}: leave it out, action={self.action!r} says it"
            )
        return EnvConfig().override(**{"disturbance": "random", **given, "action_mode": self.action}).to_dict()

    @property
    def sizes(self) -> dict[str, int]:
        """Fingers and joints of the hand, and the numbers that an agent is shown and gives."""
        from grasp_env.config import as_config
        from grasp_env.env.observation import action_size, bounds

        hand = as_config(self.env_settings).hand_description
        fingers, joints = hand.finger_count, hand.joint_count
        shown, given = len(bounds(fingers, joints)), action_size(self.action, fingers)
        return {"fingers": fingers, "joints": joints, "observation_size": shown, "action_size": given}
