"""Roll-outs of the simulated hand: what happened at every step, for every scenario and start."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from grasp_env.force import InitialForceRule, Objective
from policies.controllers import Policy, ZeroPolicy
from training.trials.arrays import RANDOM_SCENARIOS, SCENARIOS

_SCALARS = (
    "iterations", "trials", "drift", "tilt", "slip", "slip_distance", "force_error", "peak_torque", "time",
    "optimality_gap",
)  # fmt: skip
_ARRAYS = ("commanded_force", "measured_force", "wrench", "touching")


def roll_out(
    scenario: str,
    initial_force: str | InitialForceRule,
    seed: int,
    steps: int = 100,
    policy: Policy | None = None,
    objective: Objective | None = None,
) -> dict[str, np.ndarray]:
    """One episode through the public environment.

    Args:
        scenario: a key of `SCENARIOS`.
        initial_force: the environment's start rule.
        seed: of the episode.
        steps: agent steps at 50 Hz, after which the environment truncates.
        policy: the agent; None: no adjustment.
        objective: Phi of the hand's solver; None: the default.

    Returns:
        Arrays over the steps taken: the scalars and arrays of `info`, "reward", and "failure" (a string, "" if held).
    """
    objective = objective or Objective()
    env = gym.make(
        "grasp_env:FourFingerGrasp-v0",
        initial_force=initial_force,
        force_weight=objective.force_weight,
        barrier_weight=objective.barrier_weight,
        duration=steps / 50,
        **SCENARIOS[scenario],
    )
    try:
        policy = policy or ZeroPolicy()
        observation, info = env.reset(seed=seed)
        rows: list[dict[str, Any]] = []
        rewards = []
        done = False
        while not done:
            action, _ = policy.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            rows.append(info)
            rewards.append(float(reward))
            done = terminated or truncated
        out = {name: np.array([row[name] for row in rows]) for name in (*_SCALARS, *_ARRAYS)}
        return {**out, "reward": np.array(rewards), "failure": np.array(info["failure"])}
    finally:
        env.close()


def roll_out_scenario(
    scenario: str,
    rules: dict[str, str | InitialForceRule],
    episodes: int,
    seed: int,
    objective: Objective,
    steps: int = 100,
) -> dict[str, np.ndarray]:
    """A scenario from every start: a deterministic one once, a random one `episodes` times with paired seeds.

    Returns:
        "<scenario>/<start>/<episode>/<column>" arrays.
    """
    out: dict[str, np.ndarray] = {}
    for episode in range(episodes if scenario in RANDOM_SCENARIOS else 1):
        for key, rule in rules.items():
            rows = roll_out(scenario, rule, seed + episode, steps, objective=objective)
            out.update({f"{scenario}/{key}/{episode}/{column}": value for column, value in rows.items()})
    return out
