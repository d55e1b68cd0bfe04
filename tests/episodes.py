"""Episodes of the environment, for the tests that look at what happened in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from grasp_env.config import EnvConfig
from grasp_env.sim.objects.description import SHAPES_WITHOUT_MESH, ObjectDescription

ENV = "grasp_env:FourFingerGrasp-v0"
NO_SPRINGS = {"grip_stiffness": 0.0, "grip_damping": 0.0}
"""Settings of a controller whose commanded forces are the optimal ones alone."""


def episode(
    steps: int | None = 20, seed: int = 3, action: np.ndarray | None = None, **settings: Any
) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Observations (the first is reset's) and infos of the steps of an episode; steps None: all."""
    env = gym.make(ENV, **settings)
    try:
        zero = np.zeros(env.action_space.shape or (), dtype=np.float32)
        out = [env.reset(seed=seed)[0]]
        infos = []
        while steps is None or len(infos) < steps:
            obs, reward, terminated, truncated, info = env.step(zero if action is None else action)
            assert np.isfinite(obs).all()
            assert np.isfinite(reward)
            assert env.observation_space.contains(obs)
            out.append(obs)
            infos.append({**info, "terminated": terminated, "truncated": truncated})
            if terminated or truncated:
                break
        return np.array(out), infos
    finally:
        env.close()


def random_object(
    rng: np.random.Generator, shapes: Sequence[str] = SHAPES_WITHOUT_MESH
) -> ObjectDescription:
    """An object of one of some shapes, drawn in the ranges of `randomize`."""
    rules = {
        "shape": lambda rng: shapes[rng.integers(len(shapes))],
        "size": True,
        "mass": True,
        "friction": True,
    }
    return EnvConfig().override(randomize=rules).drawn(rng).object
