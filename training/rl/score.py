"""Held-out episodes that score a policy: the same for the paper, a learned start, the previous solution and every agent."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from grasp_env.force import InitialForceRule
from policies.agent_files import ENV_ID
from policies.controllers import Policy
from training.data.episodes import episode


def score(
    policy: Policy, settings: dict[str, Any], seeds: range, initial_force: InitialForceRule | None = None
) -> dict[str, np.ndarray]:
    """What the episodes of these seeds come to, deterministic; one environment serves them all.

    Args:
        policy: the agent, or a `ZeroPolicy`.
        settings: of the environment.
        seeds: of the episodes.
        initial_force: a start rule that the settings cannot name.

    Returns:
        By episode (n,): "held" (to the end, inside the task's limits), "steps", "return", "mean_iterations", "squeeze" (mean total
        commanded normal force [N]), "drift" (largest [m]); and "iterations" (total steps,), in order.
    """
    rule: dict[str, Any] = {} if initial_force is None else {"initial_force": initial_force}
    env = gym.make(f"grasp_env:{ENV_ID}", **{**settings, **rule})
    rows: list[tuple[float, ...]] = []
    iterations: list[int] = []
    try:
        for seed in seeds:
            steps = list(episode(env, seed, policy))
            infos, spent = [step.info for step in steps], [int(step.info["iterations"]) for step in steps]
            squeeze = [float(info["commanded_force"][:, 0].sum()) for info in infos]
            held = bool(infos[-1]["is_success"]) and not infos[-1]["failure"]
            total, drift = sum(step.reward for step in steps), max(float(info["drift"]) for info in infos)
            rows.append((held, len(steps), total, sum(spent) / len(steps), sum(squeeze) / len(steps), drift))
            iterations += spent
    finally:
        env.close()
    names = ("held", "steps", "return", "mean_iterations", "squeeze", "drift")
    out = dict(zip(names, np.array(rows, dtype=float).T, strict=True))
    return {**out, "iterations": np.array(iterations)}
