"""Held-out episodes that score a policy: the same for the paper, a learned start, the previous solution and every agent."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from grasp_env.force import InitialForceRule
from policies.agent_files import ENV_ID
from policies.controllers import Policy


def score(
    policy: Policy,
    settings: dict[str, Any],
    seeds: range,
    initial_force: InitialForceRule | None = None,
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
            observation, info = env.reset(seed=seed)
            done, total, squeeze, drift, spent = False, 0.0, 0.0, 0.0, []
            while not done:
                action, _ = policy.predict(observation, deterministic=True)
                observation, reward, terminated, truncated, info = env.step(action)
                done = terminated or truncated
                total += float(reward)
                squeeze += float(info["commanded_force"][:, 0].sum())
                drift = max(drift, float(info["drift"]))
                spent.append(int(info["iterations"]))
            held = bool(info["is_success"]) and not info["failure"]
            steps = len(spent)
            rows.append((float(held), float(steps), total, sum(spent) / steps, squeeze / steps, drift))
            iterations += spent
    finally:
        env.close()
    names = ("held", "steps", "return", "mean_iterations", "squeeze", "drift")
    out = dict(zip(names, np.array(rows).T, strict=True))
    return {**out, "iterations": np.array(iterations)}
