"""Roll-outs of the simulated hand: what happened at every step, for every scenario and start."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.errors import GraspError
from grasp_env.force import InitialForceRule, Objective
from grasp_env.force.initial import rule_name
from policies.controllers import Policy
from training.data.episodes import episode
from training.runs.words import shortened
from training.trials.arrays import PATH_SCALE, RANDOM_SCENARIOS, SCENARIOS

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
        steps_taken = list(episode(env, seed, policy))
        out = {name: np.array([step.info[name] for step in steps_taken]) for name in (*_SCALARS, *_ARRAYS)}
        rewards, failure = [step.reward for step in steps_taken], steps_taken[-1].info["failure"]
        return {**out, "reward": np.array(rewards), "failure": np.array(failure)}
    finally:
        env.close()


def settings() -> dict[str, Any]:
    """What the environment of the roll-outs is when nothing is said, for a report."""
    config = EnvConfig().resolved()
    names = ("agent_rate", "control_rate", "physics_rate", "friction_margin")
    return {**{name: getattr(config, name) for name in names}, "path_scale": PATH_SCALE}


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
        "<scenario>/<start>/<episode>/<column>" arrays; of an episode that did not begin, "failure" alone.
    """
    out: dict[str, np.ndarray] = {}
    for k in range(episodes if scenario in RANDOM_SCENARIOS else 1):
        for key, rule in rules.items():
            try:
                rows = roll_out(scenario, rule, seed + k, steps, objective=objective)
            except GraspError as error:  # the hand cannot even close its fingers with this rule
                why = str(error).replace(repr(rule_name(rule)), repr(key))  # whoever gave it knows it by that name
                rows = {"failure": np.array(f"does not begin: {shortened(why, 120)}")}
            out.update({f"{scenario}/{key}/{k}/{column}": value for column, value in rows.items()})
    return out
