"""Compares the zero policy's return with that of policies that lose the object, in many settings: `python tests/env/reward_trial.py`.

GRASP_HANDS: a folder with the hands of the repository dexsuite/dex-urdf, whose hands are tried, too.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from grasp_env.config.records import MAX_COST
from grasp_env.errors import GraspError, GraspWarning
from grasp_env.sim import HANDS, HandDescription
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH

BALL = {"shape": "sphere", "size": (0.06,), "friction": 0.7, "mass": 0.15}
CUBE = {"shape": "cuboid", "size": (0.05, 0.05, 0.05), "friction": 0.7, "mass": 0.15}
METHODS = ("reduced_flow", "full_flow", "newton", "conic")
TASKS = (
    {"task": "move", "disturbance": "none"},
    {"task": "payload"},
    {"task": "six_directions", "disturbance": "none"},
)
PUBLIC = (
    "allegro_hand/allegro_hand_right", "leap_hand/leap_hand_right", "barrett_hand/bhand_model", "dclaw_gripper/dclaw_gripper",
    "schunk_hand/schunk_svh_hand_right", "shadow_hand/shadow_hand_right", "inspire_hand/inspire_hand_right",
    "ability_hand/ability_hand_right",
)  # fmt: skip
Policy = Callable[[np.random.Generator, int], np.ndarray]
POLICIES: dict[str, tuple[str, Policy]] = {
    "zero": ("initial_force", lambda rng, size: np.zeros(size)),
    "random start": ("initial_force", lambda rng, size: rng.uniform(-1.0, 1.0, size)),
    "largest start": ("initial_force", lambda rng, size: np.ones(size)),
    "let go": ("contact_force", lambda rng, size: -np.ones(size)),
    "equal forces": ("contact_force", lambda rng, size: np.zeros(size)),
    "random forces": ("contact_force", lambda rng, size: rng.uniform(-1.0, 1.0, size)),
}
"""Action mode and action of each policy."""


class Tried(NamedTuple):
    """A policy in a setting: mean return of its episodes, its shortest one as a share of the whole, how they ended."""

    setting: str
    policy: str
    mean: float
    shortest: float
    failures: str


def settings() -> Iterator[tuple[str, dict[str, Any]]]:
    """Everything that is tried, by name."""
    for hand, shape, method in product(HANDS, SHAPES_WITHOUT_MESH, METHODS):
        yield f"{hand} {shape} {method}", {"hand": hand, "shape": shape, "method": method}
    for hand, (name, item), method in product(("allegro", "leap"), (("ball", BALL), ("cube", CUBE)), METHODS):
        yield f"{hand} {name} {method}", {"hand": hand, **item, "method": method}
    for hand, task in product(HANDS, TASKS):
        yield f"{hand} {task['task']}", {"hand": hand, **task}
    if "GRASP_HANDS" in os.environ:
        for file, (name, item), method in product(PUBLIC, (("ball", BALL), ("cube", CUBE)), METHODS):
            hand = HandDescription.from_urdf(Path(os.environ["GRASP_HANDS"]) / f"{file}.urdf")
            yield f"{file.split('/')[0]} {name} {method}", {"hand": hand, **item, "method": method}


def tried(name: str, given: dict[str, Any], policies: dict[str, tuple[str, Policy]], seeds: range) -> Iterator[Tried]:
    """The policies in one setting, under the random wrench unless it says otherwise."""
    for policy, (mode, act) in policies.items():
        env = gym.make("grasp_env:FourFingerGrasp-v0", **{"disturbance": "random", **given}, action_mode=mode)
        size = env.action_space.shape[0]  # type: ignore[index]
        rng, returns, lengths, failures = np.random.default_rng(0), [], [], set()
        for seed in seeds:
            env.reset(seed=seed)
            total, steps, over, info = 0.0, 0, False, dict[str, Any]()
            while not over:
                _, reward, terminated, truncated, info = env.step(act(rng, size).astype(np.float32))
                total, steps, over = total + float(reward), steps + 1, terminated or truncated
            returns.append(total)
            assert env.spec is not None
            assert env.spec.max_episode_steps is not None
            lengths.append(steps / env.spec.max_episode_steps)
            failures.add(info["failure"])
        env.close()
        yield Tried(name, policy, float(np.mean(returns)), min(lengths), "/".join(sorted(failures)) or "held")


def faults(rows: list[Tried]) -> list[str]:
    """Finds contradictions to the reward's promise in the rows of one setting, whose first is the zero policy's."""
    zero = rows[0]
    found = [] if zero.mean > 0.0 else [f"{zero.setting}: the zero policy earns {zero.mean:.1f}"]
    return found + [
        f"{row.setting}: {row.policy} earns {row.mean:.1f}, zero {zero.mean:.1f}"
        for row in rows[1:]
        if row.shortest < 1.0 - MAX_COST and "held" not in row.failures and row.mean >= zero.mean
    ]


def main() -> int:
    """Prints every row, then what is wrong; 1 where something is."""
    warnings.simplefilter("ignore", GraspWarning)
    every, wrong, refused = list[Tried](), list[str](), list[str]()
    for name, given in settings():
        policies = POLICIES if given.get("method", "reduced_flow") == "reduced_flow" else {"zero": POLICIES["zero"]}
        try:
            rows = list(tried(name, given, policies, range(2)))
        except GraspError as error:
            refused.append(f"{name}: {error}")
            continue
        every, wrong = every + rows, wrong + faults(rows)
        print(
            *(f"{row.setting:45} {row.policy:14} {row.mean:8.1f} {row.shortest:6.2f} {row.failures}" for row in rows),
            sep="\n",
            flush=True,
        )
    zeros = sorted(row.mean for row in every if row.policy == "zero")
    lost = [row for row in every if row.policy == "zero" and row.shortest < 1.0]
    print(
        f"\n{len(zeros)} settings, zero policy's return {zeros[0]:.1f} to {zeros[-1]:.1f}; {len(lost)} where it loses the object"
    )
    print(*refused, *wrong, sep="\n")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
