"""The reward: object held, minus iterations, minus force spent. No second solve is made for it."""

from __future__ import annotations

from grasp_env.config import Reward


def reward_terms(prices: Reward, held: bool, iterations: int, total_normal_force: float) -> dict[str, float]:
    """The terms that add up to the step's reward.

    Args:
        prices: of the environment.
        held: whether the object is still held.
        iterations: of the force optimisation in this step.
        total_normal_force: [N] of the optimised force.
    """
    return {
        "reward/held": prices.held if held else -prices.failure_cost,
        "reward/iterations": -prices.iteration_cost * iterations,
        "reward/force": -prices.force_cost * total_normal_force,
    }
