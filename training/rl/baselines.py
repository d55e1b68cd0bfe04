"""Policies that learn nothing in the environment, by the action mode of the agents beside them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from grasp_env.config import EnvConfig
from grasp_env.config.env import as_config
from grasp_env.env.actions import MODES
from policies import LearnedInitialForce, ZeroPolicy
from policies.controllers import Policy, RandomPolicy
from training.rl.rl_config import RLConfig

MARGINS = (0.85, 0.75, 0.6, 0.5, 0.4, 0.3)
"""Fixed friction margins of the controller."""
SQUEEZES = (10.0, 20.0, 30.0, 40.0, 60.0, 80.0)
"""Fixed sums of normal forces [N]."""


@dataclass(frozen=True)
class Baseline:
    """A policy that learns nothing.

    Attributes:
        changes: changes to the settings of the agents' environment.
        policy: class of the policy.
        learned: the shipped learned start replaces the start rule.
    """

    changes: dict[str, Any] = field(default_factory=dict)
    policy: type[ZeroPolicy] = ZeroPolicy
    learned: bool = False

    def made(self, config: RLConfig) -> tuple[Policy, EnvConfig]:
        """Return policy and settings beside an agent."""
        # where an agent needs no solver, its baselines have one, for the same rewards
        mode = "grip" if config.action == "grip" else "initial_force"
        settings = as_config(config.env_settings).override(action_mode=mode)
        settings = settings.override(**self.changes)
        if self.learned:
            settings = settings.override(initial_force=LearnedInitialForce.pretrained())
        size = MODES[settings.action_mode].size(settings.hand_description.finger_count)
        return self.policy(size), settings


STARTS = {
    "zero": Baseline(),
    "learned": Baseline(learned=True),
    "previous": Baseline({"initial_force": "previous"}),
}
"""Starts of the solver: the paper's, the shipped model, the previous solution."""
GRIPS = {
    "zero": Baseline(),
    "random": Baseline(policy=RandomPolicy),
    **{
        f"margin {margin:g}": Baseline({"controller.friction_margin": margin}) for margin in MARGINS
    },
    **{
        f"margin {margin:g}, no preload": Baseline(
            {"controller.friction_margin": margin, "controller.preload": 0.0}
        )
        for margin in MARGINS
    },
    **{
        f"squeeze {squeeze:g} N": Baseline(
            {
                "controller.kind": "constant_squeeze",
                "controller.squeeze": squeeze,
                "agent.action_mode": "none",
            }
        )
        for squeeze in SQUEEZES
    },
}
"""Fixed grips: those of the settings, of a margin, and constant squeezes."""


def baselines(config: RLConfig) -> dict[str, Baseline]:
    """Return the baselines beside an agent, by name."""
    return GRIPS if config.action == "grip" else STARTS
