"""Scores of a policy on held-out episodes, as rows."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from grasp_env.config import EnvConfig
from grasp_env.config.env import as_config
from policies.agent_files import ENV_ID
from policies.controllers import Policy
from training.data.episodes import EpisodeStep, episode


def score(
    policy: Policy, settings: EnvConfig | dict[str, Any], seeds: range
) -> list[dict[str, Any]]:
    """Play the episodes of some seeds with deterministic actions and return their rows.

    Returns:
        A row for each step with "seed", "step", "reward" and, if a solver runs, "iterations". The
        last row of an episode also has the columns of `outcome`.
    """
    config = as_config(settings)
    solver = not config.agent.sets_forces
    env = gym.make(f"grasp_env:{ENV_ID}", config=config)
    rows: list[dict[str, Any]] = []
    try:
        for seed in seeds:
            steps = list(episode(env, seed, policy))
            for k, step in enumerate(steps):
                rows.append({"seed": seed, "step": k, "reward": step.reward})
                if solver:
                    rows[-1]["iterations"] = int(step.info["iterations"])
            rows[-1] |= outcome(steps, solver)
    finally:
        env.close()
    return rows


def outcome(steps: list[EpisodeStep], solver: bool = True) -> dict[str, Any]:
    """Return return, hold and means of an episode; held: to the end, within the task's limits."""
    infos = [step.info for step in steps]
    count = len(infos)
    held = bool(infos[-1]["is_success"])
    force = sum(float(info["commanded_force"][:, 0].sum()) for info in infos)
    iterations = sum(int(info["iterations"]) for info in infos) / count if solver else None
    return {
        "held": held,
        "failure": infos[-1]["fault"] or None,
        "return": sum(step.reward for step in steps),
        "mean_iterations": iterations,
        "commanded_force": force / count,
        "torque_share": sum(float(info["torque_share"]) for info in infos) / count,
        "drift": 1e3 * max(float(info["drift"]) for info in infos) if held else None,
        "end_drift": 1e3 * float(infos[-1]["drift"]),
    }
