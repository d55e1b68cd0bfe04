"""Steps per second of an environment alone, with an agent that acts, and with one that trains: measured alone, in this process."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from training.rl.agent import build, first_seed, make_envs
from training.rl.settings import RLConfig

ROUNDS, STEPS = 3, 2048
"""How often each is measured, and how many steps of all environments together are taken each time."""


def speeds(config: RLConfig) -> Iterator[dict[str, Any]]:
    """Rows "environment alone", "with inference" and "with training", one for each round, of an agent that `config` describes."""
    config = replace(config, warmup=1).resolved()  # SAC learns from the first step on
    envs = make_envs(config.env_settings, config.envs, config.gamma)
    try:
        agent = build(config, envs, 0)
        envs.seed(first_seed(0, 0))
        shape: Any = envs.action_space.shape
        idle = np.zeros((config.envs, *shape), dtype=np.float32)

        def alone() -> None:
            for _ in range(STEPS // config.envs):
                envs.step(idle)

        def acting() -> None:
            seen: Any = envs.reset()
            for _ in range(STEPS // config.envs):
                seen = envs.step(agent.predict(seen)[0])[0]

        def training() -> None:
            agent.learn(STEPS, reset_num_timesteps=False)

        training()  # warm; and the environments are reset
        for case, work in (("environment alone", alone), ("with inference", acting), ("with training", training)):
            for _ in range(ROUNDS):
                begun = time.perf_counter()
                work()
                yield {"case": case, "per_second": STEPS / (time.perf_counter() - begun)}
    finally:
        envs.close()
