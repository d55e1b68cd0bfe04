"""The reward: object held, minus iterations, minus force spent. No second solve is made for it."""

from __future__ import annotations

from grasp_env.config import EnvConfig


def reward_terms(config: EnvConfig, held: bool, iterations: int, total_normal_force: float) -> dict[str, float]:
    """The terms that add up to the step's reward.

    Args:
        config: the prices.
        held: whether the object is still held.
        iterations: of the force optimisation in this step.
        total_normal_force: [N] of the optimised force.
    """
    return {
        "reward/held": config.held_reward if held else -config.failure_cost,
        "reward/iterations": -config.iteration_cost * iterations,
        "reward/force": -config.force_cost * total_normal_force,
    }
