"""Steps per second of environments alone, with an acting agent, and with a training one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from training.rl.agent import build, first_seed, make_envs
from training.rl.rl_config import RLConfig

ROUNDS, STEPS = 3, 2048
"""Number of measurements, and of steps of all environments together in each."""


def speeds(config: RLConfig) -> Iterator[dict[str, Any]]:
    """Yield rows "environment alone", "with inference" and "with training", one for each round."""
    config = replace(config, warmup=1).resolved()  # so that SAC learns from the first step on
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

        training()  # warm-up, which also resets the environments
        for case, work in (
            ("environment alone", alone),
            ("with inference", acting),
            ("with training", training),
        ):
            for _ in range(ROUNDS):
                begun = time.perf_counter()
                work()
                yield {"case": case, "per_second": STEPS / (time.perf_counter() - begun)}
    finally:
        envs.close()
